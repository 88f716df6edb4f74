"""Does each axis of a live robot move as it is commanded? By a small, slow motion of one axis after the other.

The motion passes the guards like any other. The same comparison takes a recording of any motion.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import SafetyStop
from bam_envs.core.robot import Initial, RobotState, SignalSpec
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import is_base, measured_places
from bam_train.deploy.contract_table import Check, check
from bam_train.deploy.robot_checks import FACTORS, driven

Array = NDArray[np.float64]
FAR = {"rad": 0.03, "m": 0.01, "m/s": 0.05, "rad/s": 0.1}
"""How far each axis moves, or how fast a base drives and turns, by the unit of its command."""
THERE, STAY = 1.0, 0.5
"""Time for the way there, as for the way back, and the time at rest after each [s]."""
_MOST_LAG = 0.5  # longest delay of the measured motion behind the commands [s]
_MOVED, _LEAST, _MOST = 0.3, 0.6, 1.6
"""Share of the commanded motion that counts as motion at all, and the least and most that is right."""


def wiggle(robot: SafeRobot, joints: Array | None) -> Iterator[Check]:
    """Move each axis a little and back; one line for each. The robot is halted afterwards.

    Args:
        robot: A connected robot, whose owner has allowed the motion.
        joints: The measured joints of an arm (k,) [rad], where it begins; None for a base.
    """
    spec, command = robot.spec, robot.spec.command
    signals, label = {} if joints is None else {"joint_position": joints[None]}, "the axes"
    try:
        state = robot.reset(np.zeros(1, np.int64), Initial(signals, np.zeros(1, np.int64)))
        commanded, measured = [state.command[0]], [_measured(spec, state)]
        for axis, goal in _goals(command, state.command[0], spec.period):
            label = axis
            state = robot.step(goal[None])
            commanded.append(goal)
            measured.append(_measured(spec, state))
    except SafetyStop as stop:
        yield check(f"motion of {label}", "as commanded", str(stop), fits=False)
        return
    finally:
        robot.halt()
    sent, seen = np.array(commanded), np.array(measured)
    if is_base(spec):
        sent, seen = np.cumsum(sent * spec.period, axis=0), driven(seen)
    yield from motion_checks(command, sent, seen, spec.period)


def motion_checks(command: SignalSpec, commanded: Array, measured: Array, period: float) -> Iterator[Check]:
    """One line for each axis that was commanded to move: whether it was that axis that moved, as far, and that way.

    Args:
        command: Labels and units of the axes.
        commanded: Commanded positions (k, m), one each period; of a base, how far it should have driven and turned.
        measured: Measured positions (k, m); NaN where nothing is measured.
        period: Time between two rows [s].
    """
    known = np.isfinite(measured.sum(axis=0))
    moved = [i for i in range(len(command.labels)) if np.ptp(commanded[:, i]) >= 0.2 * FAR[command.units[i]]]
    gains = _gains(commanded[:, moved], np.where(known, measured, 0.0), round(_MOST_LAG / period))
    for row, i in zip(gains, moved, strict=True):
        what, expected = f"motion of {command.labels[i]}", "as commanded"
        if not known[i]:
            yield check(what, expected, "it is not measured", fits=None)
            continue
        found = _wrong(command, i, row)
        yield check(what, expected, found or f"{row[i]:.2f} of what was commanded", fits=not found)


def _gains(commanded: Array, measured: Array, most_lag: int) -> Array:
    """Least squares: how far each measured axis moves for each commanded one, at the delay that fits best."""
    best, gains = math.inf, np.zeros((commanded.shape[1], measured.shape[1]))
    for lag in range(min(most_lag, len(commanded) - 2) + 1):
        sent, seen = commanded[: len(commanded) - lag], measured[lag:]
        sent, seen = sent - sent.mean(axis=0), seen - seen.mean(axis=0)
        solution = np.linalg.lstsq(sent, seen, rcond=None)[0]
        error = float(np.square(seen - sent @ solution).mean())
        if error < best:
            best, gains = error, solution
    return gains


def _wrong(command: SignalSpec, i: int, gains: Array) -> str:
    """What is wrong with the motion of axis `i`, for the gains (m,) of every axis; empty if nothing is."""
    unit, far = command.units[i].removesuffix("/s"), int(np.abs(gains).argmax())
    if abs(gains[far]) < _MOVED:
        return "it did not move"
    if far != i and abs(gains[i]) < _MOVED:
        return f"{command.labels[far]} moved instead"
    if gains[i] < 0:
        return "it moved the other way"
    if _LEAST <= gains[i] <= _MOST:
        return ""
    units = FACTORS.get(unit, {}).items()
    fits = (name for name, much in units if any(_LEAST <= one <= _MOST for one in (gains[i] / much, gains[i] * much)))
    hint = next((f" ({name}?)" for name in fits), "")
    return f"it moved {gains[i]:.2g} times as far{hint}"


def _goals(command: SignalSpec, start: Array, period: float) -> Iterator[tuple[str, Array]]:
    """Label of the axis that moves and command (m,), one each period: each axis goes a little way and comes back."""
    there, stay = math.ceil(THERE / period), math.ceil(STAY / period)
    way = (1 - np.cos(np.pi * np.arange(1, there + 1) / there)) / 2
    shares = np.concatenate([way, np.ones(stay), way[::-1], np.zeros(stay)])
    speeds = np.concatenate([np.ones(there), np.zeros(stay), -np.ones(there), np.zeros(stay)])
    for i, unit in enumerate(command.units):
        middle = (command.low[i] + command.high[i]) / 2
        far = FAR[unit] if start[i] <= middle or unit.endswith("/s") else -FAR[unit]
        for share in speeds if unit.endswith("/s") else shares:
            goal = start.copy()
            goal[i] += far * share
            yield command.labels[i], goal


def _measured(spec: Any, state: RobotState) -> Array:
    """The measured position of each axis (m,), NaN if not measured; of a base its pose (3,)."""
    if is_base(spec):
        pose: Array = state.signals["base_pose"][0]
        return pose
    measured = np.full(len(spec.command.labels), np.nan)
    for place, name, column in measured_places(spec, spec.command.units):
        measured[place] = state.signals[name][0, column]
    return measured
