"""Check that each axis of a live robot moves as commanded: from a recording, or with a small motion of each axis.

The commands of that motion pass the guards like any other.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import SafetyStop
from bam_envs.core.robot import Initial, RobotSpec, RobotState, SignalSpec
from bam_envs.live.robot_checks import FACTORS, Check, driven
from bam_envs.safety.first_motion import PROOF
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import is_base, measured_places
from bam_train.deploy.checkpoint_admission import SHADOW
from bam_train.recording.recording import Recording

Array = NDArray[np.float64]
FAR = {"rad": PROOF, "m": 0.01, "m/s": 0.05, "rad/s": 0.1}
"""Amplitude of the motion of each axis, a speed for a base, by the unit of its command."""
MOVE_TIME, REST_TIME = 1.0, 0.5
"""Duration of the motion of a gripper or base in each direction, and of the rest after it [s]."""
_MAX_LAG = 0.5  # maximum delay of the measured motion behind the commands [s]
_MOVED, _LEAST, _MOST = 0.3, 0.6, 1.6
"""Shares of the commanded motion: minimum that counts as motion, minimum and maximum of a correct motion."""
_HELD = 0.2
"""Minimum share of a correct motion of a gripper, which may hold an object."""
_FIT, _ENOUGH = 0.8, 0.2
"""Share of a motion that the commands must explain, and share of `FAR` from which a motion is compared."""


def wiggle(robot: SafeRobot, joints: Array | None) -> Iterator[Check]:
    """Move each axis a little and back, and yield a line for each. The robot is halted afterwards.

    Args:
        robot: A connected robot; the operator has allowed the motion.
        joints: The measured joints of an arm (k,) [rad]; None for a base.
    """
    spec, command, is_arm = robot.spec, robot.spec.command, joints is not None
    initial = Initial({} if joints is None else {"joint_position": joints[None]}, np.zeros(1, np.int64))
    label, states = "the joints" if is_arm else "the axes", list[RobotState]()
    try:
        proves = is_arm and robot.is_unproved  # and `reset` would do it with one joint only, if it was done before
        states += robot.prove(anew=True) if proves else []
        state = robot.reset(np.zeros(1, np.int64), initial)
        states += robot.prove(anew=True) if is_arm and not proves else [state]
        for axis, goal in _goals(command, states[-1].command[0], spec.period):
            label = axis
            states.append(robot.step(goal[None]))
    except SafetyStop as stop:
        yield Check(f"motion of {label}", "as commanded", str(stop), fits=False)
        return
    finally:
        robot.halt()
    yield from _compared(spec, [state.command[0] for state in states], [_measured(spec, state) for state in states])


def recorded_motion(path: Path, spec: RobotSpec, address: str, identity: str = "") -> Iterator[Check]:
    """Lines about the motion of each axis in the longest episode of a recording of the live robot at `address`.

    Robots are told apart by their `identity`, if that of both is known, else by their address. A recording of another
    robot, of a simulation, or of a shadow, which sends nothing, is refused.

    Raises:
        FormatError: There is no such recording, or it is of another robot.
    """
    recording = Recording.open(path)
    metadata = recording.metadata
    found = metadata.get("address", "") if metadata.get("robot") else "a simulation"
    wanted = address
    if found != "a simulation" and identity and metadata.get("identity"):
        wanted, found = identity, metadata["identity"]
    if SHADOW in metadata.get("marks", ""):
        found = "a shadow, which sends nothing"
    fits = found.rstrip("/") == wanted.rstrip("/")
    yield Check(f"recording {path.name}", wanted, found, fits=fits)
    episodes = recording.episodes()
    if not fits or not episodes:
        return
    states = recording.states(spec)
    longest = max(episodes, key=len)
    episode = states[longest.start : longest.stop]
    yield from _compared(spec, [state.command[0] for state in episode], [_measured(spec, state) for state in episode])


def _compared(spec: RobotSpec, commands: Sequence[Array], measured: Sequence[Array]) -> Iterator[Check]:
    """`motion_checks` of the commands and the measurement after each."""
    sent, seen = np.array(commands), np.array(measured)
    if is_base(spec):
        sent, seen = np.cumsum(sent * spec.period, axis=0), driven(seen, sent.shape[1])
    yield from motion_checks(spec.command, sent, seen, spec.period)


def motion_checks(command: SignalSpec, commanded: Array, measured: Array, period: float) -> Iterator[Check]:
    """Compare distance, direction and axis of each measured motion with the commanded one; yields a line for each axis.

    Args:
        command: Labels and units of the axes.
        commanded: Commanded positions (k, m), one row a period; for a base, distance driven [m] and angle turned [rad].
        measured: Measured positions (k, m); NaN where nothing is measured.
        period: Time between two rows [s].
    """
    moved = np.ptp(commanded, axis=0) >= [_ENOUGH * FAR[unit] for unit in command.units]
    for i, label in enumerate(command.labels):
        found: tuple[str, bool | None] = ("it was not commanded to move", None)
        if not np.isfinite(measured[:, i]).all():
            found = "it is not measured", None
        elif moved[i]:
            found = _motion(command, i, commanded, measured[:, i], moved, round(_MAX_LAG / period))
        yield Check(f"motion of {label}", "as commanded", found[0], fits=found[1])


def _motion(
    command: SignalSpec, i: int, commanded: Array, measured: Array, moved: NDArray[np.bool_], most_lag: int
) -> tuple[str, bool | None]:
    """How the measured axis `i` (k,) moved, for the commands to all axes (k, m); and whether that is correct."""
    gain, fit = _best_fit(commanded[:, i], measured, most_lag)
    unit = command.units[i].removesuffix("/s")
    others = {
        label: _best_fit(commanded[:, j], measured, most_lag)
        for j, label in enumerate(command.labels)
        if j != i and moved[j] and command.units[j] == command.units[i]
    }
    like = [label for label, (other, how_well) in others.items() if how_well >= max(_FIT, fit) and _fits(other, unit)]
    if np.ptp(measured) < _MOVED * np.ptp(commanded[:, i]) and not like:
        return "it did not move", False
    if fit < _FIT:
        return f"it moved as {like[0]} was commanded" if like else "it did not follow its commands", False
    if gain < 0:
        return "it moved the other way", False
    if _fits(gain, unit):
        return (f"{gain:.2f} of what was commanded", True) if not like else (f"as {like[0]} was commanded, too", None)
    units = FACTORS.get(unit, {}).items()
    hint = next((f" ({name}?)" for name, much in units if _fits(gain / much, unit) or _fits(gain * much, unit)), "")
    return f"it moved {gain:.2g} times as far{hint}", False


def _fits(gain: float, unit: str) -> bool:
    return (_HELD if unit == "m" else _LEAST) <= gain <= _MOST


def _best_fit(commanded: Array, measured: Array, most_lag: int) -> tuple[float, float]:
    """Least squares at the best delay: gain from commanded to measured motion, and the share explained (R^2)."""
    best = 0.0, -math.inf
    for lag in range(min(most_lag, len(commanded) - 2) + 1):
        sent, seen = commanded[: len(commanded) - lag], measured[lag:]
        sent, seen = sent - sent.mean(), seen - seen.mean()
        gain = float(sent @ seen) / max(float(sent @ sent), 1e-12)
        left = seen - gain * sent
        explained = 1.0 - float(left @ left) / max(float(seen @ seen), 1e-12)
        if explained > best[1]:
            best = gain, explained
    return best


def _goals(command: SignalSpec, start: Array, period: float) -> Iterator[tuple[str, Array]]:
    """Yield label and command (m,) of each period of gripper or base; axes move one after the other."""
    moving, resting = math.ceil(MOVE_TIME / period), math.ceil(REST_TIME / period)
    path = (1 - np.cos(np.pi * np.arange(1, moving + 1) / moving)) / 2
    shares = np.concatenate([path, np.ones(resting), path[::-1], np.zeros(resting)])
    speeds = np.concatenate([np.ones(moving), np.zeros(resting), -np.ones(moving), np.zeros(resting)])
    for i, unit in enumerate(command.units):
        if unit == "rad":
            continue  # `SafeRobot.prove` moves the joints
        middle = (command.low[i] + command.high[i]) / 2
        far = FAR[unit] if start[i] <= middle or unit.endswith("/s") else -FAR[unit]
        for share in speeds if unit.endswith("/s") else shares:
            goal = start.copy()
            goal[i] += far * share
            yield command.labels[i], goal


def _measured(spec: RobotSpec, state: RobotState) -> Array:
    """The measured position of each axis (m,), NaN if not measured; for a base its pose (3,)."""
    if is_base(spec):
        pose: Array = state.signals["base_pose"][0]
        return pose
    measured = np.full(len(spec.command.labels), np.nan)
    for place, name, column in measured_places(spec, spec.command.units):
        measured[place] = state.signals[name][0, column]
    return measured
