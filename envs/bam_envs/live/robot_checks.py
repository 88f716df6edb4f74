"""Checks of a live robot against a task, one line each: its topics, rates, ages, units, ranges and commands.

Pure functions of collected messages. A topic whose messages cannot be read is refused in its own line, and its signals
have no further lines.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bam_envs.core.errors import ProtocolError
from bam_envs.core.robot import RobotSpec, SignalSpec
from bam_envs.live.examination import Inspection, Reading
from bam_envs.live.state import SIMULATED_BEFORE
from bam_envs.ros.messages import Message, bare_type, has_header, number_at, same_type
from bam_envs.ros.profile_tables import Source
from bam_envs.safety.guards import MeasuredLimits

Array = NDArray[np.float64]
STATES_PER_COMMAND = 0.8
"""Minimum number of states per command."""
BEYOND = 0.05
"""Tolerance of a measured number outside its range, as a share of the range: for noise, and fingers that give."""
FACTORS = {"rad": {"degrees": math.degrees(1)}, "m": {"millimetres": 1000.0, "centimetres": 100.0}}
"""SI unit to other units and the factor by which numbers are greater in them."""
RATE_OFF = 0.1
"""Tolerance of a measured speed against the change of the measured position [unit/s], and as a share of it."""
AHEAD = 0.5
"""Least time by which a stamp is before its arrival that is reported [s]; clocks of a network differ by less."""
SPEED_OF = {"joint_velocity": "joint_position", "base_velocity": "base_pose"}
_SCAN_OFF, _RANGE_OFF = 0.02, 10.0  # relative tolerance of an angle, factor of tolerance of a range
_SHORTEST = 0.05  # minimum time over which a speed is compared [s]
_PAUSE = 3.0  # multiple of the usual time between two stamps from which on it is a pause


@dataclass(frozen=True)
class Check:
    """One line of an examination."""

    what: str
    expected: str
    found: str
    fits: bool | None = field(kw_only=True)
    """None if the robot's messages do not decide the line, which then does not refuse the robot."""
    passes: bool = False
    """Whether a busy computer or network changes the line, so that another look may find another value."""
    remedy: str = ""
    """What to do where the line does not fit; empty: correct the robot or its profile."""

    @property
    def verdict(self) -> str:
        """``"ok"``, ``"refused"`` or ``"unknown"``."""
        return "unknown" if self.fits is None else "ok" if self.fits else "refused"


def robot_checks(spec: RobotSpec, inspection: Inspection) -> Iterator[Check]:
    """The lines about topics, rates, ages, units, ranges and commands of a live robot."""
    names = [signal.name for signal in spec.signals]
    required = [reading for name, reading in inspection.readings.items() if name in names]
    lockstep, readable = inspection.is_lockstep, dict[str, Reading]()
    for topic in dict.fromkeys(reading.source.topic for reading in required):
        readings = [reading for reading in required if reading.source.topic == topic]
        source = readings[0].source
        problem = _unreadable(inspection, readings)
        yield Check(f"topic {topic}", source.type, problem or source.type, fits=not problem)
        if problem:
            continue
        readable |= {reading.source.signal: reading for reading in readings}
        if not lockstep:
            yield from _timing(spec, inspection, readings[0])
        yield from _scan_geometry(source, inspection.letters[topic][-1].message)
    for signal in spec.signals:
        if signal.name in readable:
            lines = list(_range(signal, readable[signal.name].values))
            yield from lines
            if lines[0].verdict == "refused":
                del readable[signal.name]
    for speed, position in SPEED_OF.items():
        if speed in readable and position in readable and not lockstep:
            simulated = inspection.info is not None and inspection.info.simulated
            yield _speed(readable[speed], readable[position], simulated)
    yield from _commands(inspection)
    if inspection.info is not None and lockstep and inspection.info.period is not None:
        period = inspection.info.period
        yield Check("robot's period", f"{spec.period:g} s", f"{period:g} s", fits=period == spec.period)


def _unreadable(inspection: Inspection, readings: Sequence[Reading]) -> str:
    """Why the messages of a topic cannot be used, or ""."""
    topic, expected = readings[0].source.topic, readings[0].source.type
    kind = expected if inspection.types is None else inspection.types[topic]
    if not kind:
        return f"nobody publishes {inspection.namespace}{topic}" if inspection.namespace else "nobody publishes it"
    if not same_type(kind, expected):
        return bare_type(kind)
    for reading in readings:
        if reading.error:
            return reading.error.removeprefix(f"{topic}: ").removesuffix(".")
        if not reading.count:
            return f"no message in {inspection.seconds:.1f} s"
    return ""


def _timing(spec: RobotSpec, inspection: Inspection, reading: Reading) -> Iterator[Check]:
    """Rate, age and stamps of the messages of a topic."""
    source, rate = reading.source, reading.rate
    allowed = source.max_age or inspection.profile.max_age
    least = 1 / allowed if source.max_age else max(1 / allowed, STATES_PER_COMMAND / spec.period)
    busy = inspection.busy and f"; {inspection.busy}"
    late: Any = {"passes": True, "remedy": busy and "end other programs on this computer, and run it again"}
    what = f"{rate:.3g} Hz" if rate else f"{reading.new} new in {inspection.seconds:.1f} s"
    what += "" if (fits := rate >= least) else busy
    yield Check(f"rate of {source.topic}", f"at least {least:.3g} Hz", what, fits=fits, **late)
    if fits:
        age = max(0.0, float(np.median(reading.delays)))
        found = f"{age:.3f} s{'' if (fits := age <= allowed) else busy}"
        yield Check(f"age of {source.topic}", f"at most {allowed:g} s", found, fits=fits, **late)
    found = ""  # of stamps that do not tell when a message was measured, from which its age would be judged
    if has_header(source.type) and None in reading.stamps:
        found = "0: ages are judged by arrival alone, and a driver that repeats old states is not noticed"
    clock = "this computer" if inspection.server_offset is None else "the bridge"
    behind = inspection.wall_ahead - (inspection.server_offset or 0.0)
    rows = zip(reading.stamps, reading.arrived, strict=True)
    ahead = [at - (arrived + behind) for at, arrived in rows if at and at >= SIMULATED_BEFORE]
    if ahead and np.median(ahead) > AHEAD:
        found = f"{np.median(ahead):.1f} s ahead of the clock of {clock}: set the clock of the robot"
    if found:
        yield Check(f"stamps of {source.topic}", "the time of the measurement", found, fits=None)


def _scan_geometry(source: Source, message: Message) -> Iterator[Check]:
    """The angles and the range of a scanner, where the profile has them."""
    for name, expected in source.constants.items():
        angle = name.startswith("angle_")
        if not angle and name != "range_max":
            continue
        what, wanted = f"{name} of {source.topic}", f"{expected:.4g} rad" if angle else f"about {expected:g} m"
        try:
            value = number_at(message, name, source.topic)
        except ProtocolError as error:
            yield Check(what, wanted, str(error).removeprefix(f"{source.topic}: ").removesuffix("."), fits=None)
            continue
        if angle:
            fits, hint = math.isclose(value, expected, rel_tol=_SCAN_OFF), " (degrees?)"
            other = math.isclose(math.radians(value), expected, rel_tol=_SCAN_OFF)
        else:
            fits, hint = expected / _RANGE_OFF < value < expected * _RANGE_OFF, " (millimetres?)"
            other = math.isclose(value / FACTORS["m"]["millimetres"], expected, rel_tol=_SCAN_OFF)
        yield Check(what, wanted, f"{value:.4g}{hint if other and not fits else ''}", fits=fits)


def _range(signal: SignalSpec, values: Array) -> Iterator[Check]:
    """The measured numbers of a signal are inside their range, and a quaternion has the length 1."""
    low, high = np.array(signal.low), np.array(signal.high)
    # Measured limits (G7) stop a robot at the first value outside these ranges, so there is no tolerance.
    room = (0.0 if signal.name in MeasuredLimits.SIGNALS else BEYOND) * (high - low)
    outside = ((values < low - room) | (values > high + room)).any(axis=0)
    unit = signal.units[0] if len(set(signal.units)) == 1 else ", ".join(signal.units)
    expected = f"{_span(low, high)} {unit}".removesuffix(" 1")
    if outside.any():
        at = int(np.flatnonzero(outside)[0])
        worst = float(values[np.abs(values[:, at]).argmax(), at])
        found = f"{signal.labels[at]} at {worst:.4g}{_other_unit(signal, values)}"
        expected = f"{signal.labels[at]} in {_span(low[at], high[at])} {signal.units[at]}".removesuffix(" 1")
    else:
        found = _span(values.min(axis=0), values.max(axis=0))
    yield Check(signal.name, expected, found, fits=not outside.any())
    if signal.name.endswith("quaternion") and not outside.any():
        lengths = np.linalg.norm(values, axis=1)
        worst = float(lengths[np.abs(lengths - 1.0).argmax()])
        yield Check(f"length of {signal.name}", "1", f"{worst:.3f}", fits=abs(worst - 1.0) <= BEYOND)


def _span(low: ArrayLike, high: ArrayLike) -> str:
    least, most = round(float(np.min(low)), 6), round(float(np.max(high)), 6)
    return f"{least + 0.0:.4g} to {most + 0.0:.4g}"


def _other_unit(signal: SignalSpec, values: Array) -> str:
    """``" (degrees?)"`` if the values, not all near 0, are inside their range in another unit; else ""."""
    low, high = np.array(signal.low), np.array(signal.high)
    for name, factor in FACTORS.get(signal.units[0], {}).items():
        si = values / factor
        if ((si >= low) & (si <= high)).all() and (np.abs(si) > BEYOND * (high - low)).any():
            return f" ({name}?)"
    return ""


def _speed(speed: Reading, position: Reading, simulated: bool) -> Check:
    """Compare the measured speeds with the change of the measured positions.

    Stamps say when both were measured, messages without one when they arrived. Pauses between stamps are left out:
    nothing is known of the motion in them, and the time of a simulation on a busy computer stands still.
    A simulated gripper at rest on an object may chatter: its measured speed is then not that of a motion. The time of a
    simulation on a busy computer also passes more slowly than the clock, and all its positions change by less.
    """
    name, both = position.source.signal, (speed, position)
    what, expected = f"{speed.source.signal} against {name}", f"equal within {RATE_OFF:g}"
    stamped = not any(None in one.stamps for one in both)
    times, at = (np.array(one.stamps if stamped else one.arrived, np.float64) for one in both)
    steps = np.diff(at)
    usual = np.median(steps[steps > 0]) if stamped and (steps > 0).any() else np.inf
    known = steps <= _PAUSE * usual
    if (duration := steps[known].sum()) < _SHORTEST:
        return Check(what, expected, "too few messages", fits=None)
    path = driven(position.values, speed.values.shape[1]) if name == "base_pose" else position.values
    speeds = np.stack([np.interp(at, times, column) for column in speed.values.T], axis=1)
    changed = np.diff(path, axis=0)[known].sum(axis=0) / duration
    measured = ((speeds[1:] + speeds[:-1]) / 2 * steps[:, None])[known].sum(axis=0) / duration
    off = np.abs(measured - changed) - RATE_OFF * np.abs(changed)
    worst = int(off.argmax())
    still = np.abs(changed).max() < RATE_OFF and (simulated or off[worst] <= RATE_OFF)
    if still:
        return Check(what, expected, "not shown at rest", fits=None)
    found = f"{measured[worst]:.3g} measured, {changed[worst]:.3g} from {name}"
    slower = float(measured @ changed / max(changed @ changed, RATE_OFF**2))
    near = np.abs(measured - slower * changed) <= RATE_OFF * (1 + np.abs(measured))
    if simulated and slower > 1 + RATE_OFF and near.all():
        found = f"{slower:.1f} times as fast as {name} changes: the simulation's computer is busy"
        return Check(what, expected, found, fits=None)
    return Check(what, expected, found, fits=bool(off[worst] <= RATE_OFF))


def driven(poses: Array, axes: int) -> Array:
    """Distance driven forwards, to the left if there are 3 `axes`, [m] and angle turned [rad] since the first pose.

    Shapes: (k, 3) -> (k, axes).
    """
    steps = np.diff(poses, axis=0)
    turned = np.angle(np.exp(1j * steps[:, 2]))
    heading = poses[:-1, 2] + turned / 2
    cos, sin = np.cos(heading), np.sin(heading)
    ways = [steps[:, 0] * cos + steps[:, 1] * sin, steps[:, 1] * cos - steps[:, 0] * sin][: axes - 1]
    return np.concatenate([np.zeros((1, axes)), np.cumsum(np.stack([*ways, turned], axis=1), axis=0)])


def _commands(inspection: Inspection) -> Iterator[Check]:
    """Each topic of a command has a subscriber, each action and service somebody who offers it, of that type."""
    for sink in inspection.sinks:
        kind = None if inspection.types is None else inspection.types[sink.address]
        nobody = "nobody listens" if sink.topic else "nobody offers it: start the gripper's driver"
        found = "unknown" if kind is None else bare_type(kind) or nobody
        fits = None if kind is None else sink.of_type(bare_type(kind)) is not None
        yield Check(f"command {sink.address}", sink.type, found, fits=fits)
    proof = inspection.proof
    if proof is not None:
        found = proof.fault or (f"proved on {proof.since}" if proof.is_known else "to be proved in the first motion")
        fits = False if proof.fault else True if proof.is_known else None
        yield Check("joints of the commands", "those that are meant", found, fits=fits)
        for name in proof.from_measured:
            found = "where the arm is measured: jerky; set interpolate_from_desired_state of the controller to true"
            yield Check(f"trajectories of {name}", "begin at the last set point", found, fits=None)
