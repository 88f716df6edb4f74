"""Checks of the topics of a live robot against a task: pure functions of collected messages.

A topic whose messages cannot be read is refused in its own line, and its signals have no further lines.
"""

import math
import statistics
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bam_envs.core.errors import ProtocolError
from bam_envs.core.robot import RobotSpec, SignalSpec
from bam_envs.live.inspection import Inspection
from bam_envs.live.state import SIMULATED_BEFORE, Letter, SourceAge, concerns
from bam_envs.ros.codec import decode_source
from bam_envs.ros.messages import Message, bare_type, has_header, number_at, read_stamp, same_type
from bam_envs.ros.profile_tables import RobotProfile, Source
from bam_envs.safety.guards import MeasuredLimits
from bam_train.deploy.contract_table import Check, check

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


def readings(inspection: Inspection, source: Source, size: int) -> tuple[Array, Array]:
    """Arrival times (k,) [s] and values (k, size) [SI] of a signal; `ProtocolError` for an unreadable message."""
    letters = [letter for letter in inspection.letters.get(source.topic, ()) if concerns(source, letter.message)]
    values = [decode_source(source, letter.message, size) for letter in letters]
    return np.array([letter.arrived for letter in letters]), np.array(values).reshape(-1, size)


def robot_checks(profile: RobotProfile, spec: RobotSpec, inspection: Inspection) -> Iterator[Check]:
    """The lines about topics, rates, ages, units, ranges and commands of a live robot."""
    sizes = {signal.name: len(signal.labels) for signal in spec.signals}
    required = [source for source in inspection.sources if source.signal in sizes]
    lockstep = inspection.info is not None and inspection.info.lockstep
    readable: dict[str, tuple[Array, Array]] = {}
    for topic in dict.fromkeys(source.topic for source in required):
        sources = [source for source in required if source.topic == topic]
        problem, found = _read_topic(inspection, sources, sizes)
        yield check(f"topic {topic}", sources[0].type, problem or sources[0].type, fits=not problem)
        if problem:
            continue
        readable |= found
        if not lockstep:
            yield from _timing(profile, spec, inspection, sources[0])
        yield from _scan_geometry(sources[0], inspection.letters[topic][-1].message)
    for signal in spec.signals:
        if signal.name in readable:
            lines = list(_range(signal, readable[signal.name][1]))
            yield from lines
            if lines[0].verdict == "refused":
                del readable[signal.name]
    for speed, position in SPEED_OF.items():
        if speed in readable and position in readable and not lockstep:
            simulated = inspection.info is not None and inspection.info.simulated
            yield _speed(speed, position, *readable[speed], *readable[position], simulated)
    yield from _commands(inspection)
    if inspection.info is not None and inspection.info.lockstep and inspection.info.period is not None:
        period = inspection.info.period
        yield check("robot's period", f"{spec.period:g} s", f"{period:g} s", fits=period == spec.period)


def _read_topic(
    inspection: Inspection, sources: Sequence[Source], sizes: dict[str, int]
) -> tuple[str, dict[str, tuple[Array, Array]]]:
    """Why the messages of a topic cannot be used, or ""; and the readings of its signals."""
    topic, expected = sources[0].topic, sources[0].type
    if inspection.types is not None:
        kind = inspection.types[topic]
        if not kind:
            return "nobody publishes it", {}
        if not same_type(kind, expected):
            return bare_type(kind), {}
    found: dict[str, tuple[Array, Array]] = {}
    for source in sources:
        try:
            times, values = readings(inspection, source, sizes[source.signal])
        except ProtocolError as error:
            return str(error).removeprefix(f"{topic}: ").removesuffix("."), {}
        if not len(times):
            return f"no message in {inspection.seconds:.1f} s", {}
        found[source.signal] = times, values
    return "", found


def _timing(profile: RobotProfile, spec: RobotSpec, inspection: Inspection, source: Source) -> Iterator[Check]:
    """Rate and age of the messages of a topic."""
    letters = [letter for letter in inspection.letters[source.topic] if concerns(source, letter.message)]
    allowed = source.max_age or profile.max_age
    least = 1 / allowed if source.max_age else max(1 / allowed, STATES_PER_COMMAND / spec.period)
    try:
        new, ages = _new_and_ages(inspection, source, letters)
    except ProtocolError as error:
        yield check(f"rate of {source.topic}", f"at least {least:.3g} Hz", str(error), fits=False)
        return
    rate = (len(new) - 1) / (new[-1] - new[0]) if len(new) > 1 and new[-1] > new[0] else 0.0
    what = f"{rate:.3g} Hz" if rate else f"{len(new)} new in {inspection.seconds:.1f} s"
    yield check(f"rate of {source.topic}", f"at least {least:.3g} Hz", what, fits=rate >= least, passes=True)
    if rate >= least:
        age = statistics.median(ages)
        found = f"{age:.3f} s"
        yield check(f"age of {source.topic}", f"at most {allowed:g} s", found, fits=age <= allowed, passes=True)
    yield from _stamps(inspection, source, letters)


def _stamps(inspection: Inspection, source: Source, letters: Sequence[Letter]) -> Iterator[Check]:
    """A line about stamps that do not tell when a message was measured, from which its age would be judged."""
    stamps = [read_stamp(letter.message, source.topic) for letter in letters]
    found = ""
    if has_header(source.type) and None in stamps:
        found = "0: ages are judged by arrival alone, and a driver that repeats old states is not noticed"
    offset, clock = (
        inspection.server_offset or 0.0,
        "this computer" if inspection.server_offset is None else "the bridge",
    )
    rows = zip(stamps, letters, strict=True)
    ahead = [at - (one.arrived + inspection.wall_ahead - offset) for at, one in rows if at and at >= SIMULATED_BEFORE]
    if ahead and statistics.median(ahead) > AHEAD:
        found = f"{statistics.median(ahead):.1f} s ahead of the clock of {clock}: set the clock of the robot"
    if found:
        yield check(f"stamps of {source.topic}", "the time of the measurement", found, fits=None)


def _new_and_ages(inspection: Inspection, source: Source, letters: Sequence[Letter]) -> tuple[list[float], list[float]]:
    """Arrival times of messages with a new stamp [s], and the age of each message at its arrival [s]."""
    tracker, new, ages, before = SourceAge(inspection.wall_ahead), [], [], math.nan
    for letter in letters:
        tracker.look(letter, source.topic, inspection.server_offset)
        ages.append(max(0.0, tracker.at(letter.arrived)))
        if tracker.stamp is None or tracker.stamp != before:
            new.append(letter.arrived)
        before = math.nan if tracker.stamp is None else tracker.stamp
    return new, ages


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
            yield check(what, wanted, str(error).removeprefix(f"{source.topic}: ").removesuffix("."), fits=None)
            continue
        if angle:
            fits, hint = math.isclose(value, expected, rel_tol=_SCAN_OFF), " (degrees?)"
            other = math.isclose(math.radians(value), expected, rel_tol=_SCAN_OFF)
        else:
            fits, hint = expected / _RANGE_OFF < value < expected * _RANGE_OFF, " (millimetres?)"
            other = math.isclose(value / FACTORS["m"]["millimetres"], expected, rel_tol=_SCAN_OFF)
        yield check(what, wanted, f"{value:.4g}{hint if other and not fits else ''}", fits=fits)


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
    yield check(signal.name, expected, found, fits=not outside.any())
    if signal.name.endswith("quaternion") and not outside.any():
        lengths = np.linalg.norm(values, axis=1)
        worst = float(lengths[np.abs(lengths - 1.0).argmax()])
        yield check(f"length of {signal.name}", "1", f"{worst:.3f}", fits=abs(worst - 1.0) <= BEYOND)


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


def _speed(
    speed: str, position: str, times: Array, speeds: Array, at: Array, positions: Array, simulated: bool
) -> Check:
    """Compare the measured speeds with the change of the measured positions.

    A simulated gripper at rest on an object may chatter: its measured speed is then not that of a motion.
    """
    what, expected = f"{speed} against {position}", f"equal within {RATE_OFF:g}"
    if len(at) < 2 or at[-1] - at[0] < _SHORTEST:
        return check(what, expected, "too few messages", fits=None)
    change = positions[-1] - positions[0]
    if position == "base_pose":
        change = driven(positions)[-1]
    changed = change / (at[-1] - at[0])
    inside = (times >= at[0]) & (times <= at[-1])
    measured = speeds[inside].mean(axis=0) if inside.any() else speeds.mean(axis=0)
    off = np.abs(measured - changed) - RATE_OFF * np.abs(changed)
    worst = int(off.argmax())
    still = np.abs(changed).max() < RATE_OFF and (simulated or off[worst] <= RATE_OFF)
    if still:
        return check(what, expected, "not shown at rest", fits=None)
    found = f"{measured[worst]:.3g} measured, {changed[worst]:.3g} from {position}"
    return check(what, expected, found, fits=bool(off[worst] <= RATE_OFF))


def driven(poses: Array) -> Array:
    """Distance driven forwards [m] and angle turned [rad] since the first of the `poses` (k, 3). Shape: (k, 2)."""
    steps = np.diff(poses, axis=0)
    turned = np.angle(np.exp(1j * steps[:, 2]))
    heading = poses[:-1, 2] + turned / 2
    forwards = steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(np.stack([forwards, turned], axis=1), axis=0)])


def _commands(inspection: Inspection) -> Iterator[Check]:
    """Each topic of a command has a subscriber and the expected type."""
    for sink in inspection.sinks:
        kind = None if inspection.types is None else inspection.types[sink.topic]
        found = "unknown" if kind is None else bare_type(kind) or "nobody listens"
        fits = None if kind is None else bare_type(kind) == bare_type(sink.type)
        yield check(f"command {sink.topic}", sink.type, found, fits=fits)
    proof = inspection.proof
    if proof is not None:
        found = proof.fault or (f"proved on {proof.since}" if proof.is_known else "to be proved in the first motion")
        fits = False if proof.fault else True if proof.is_known else None
        yield check("joints of the commands", "those that are meant", found, fits=fits)
        for name in proof.from_measured:
            found = "where the arm is measured: jerky; set interpolate_from_desired_state of the controller to true"
            yield check(f"trajectories of {name}", "begin at the last set point", found, fits=None)
