"""First motion (G25): what a robot at rest cannot show is checked in its first motion, and stops it.

`ProofMotion` proves that commands reach the joints that are meant: an arm that is commanded in another order, or with
another sign, offset or unit, is stopped before a joint has moved by `MOST` or faster than `FASTEST`. `FirstMotion`
compares the measurements with each other while the robot moves for the first time.
"""

import math
from collections.abc import Generator, Sequence

from bam_envs.core.robot import RobotSpec
from bam_envs.safety.following import LIKELY
from bam_envs.safety.guard import Guard, Numbers, Tick, columns_in, ticks_of

MOST, FASTEST = 0.05, 0.1
"""Farthest motion [rad] and highest speed [rad/s] of a joint before its commands are proved."""
REST_REACH = 1e6
"""Time in which an arm is to reach the position of a halt before its commands are proved [s]: it stays where it is."""
PROOF, SLOW = 0.02, 0.085
"""Motion of each joint that proves its commands [rad], and the highest speed of a correct or wrong joint [rad/s]."""
SETTLE, WAIT = 0.55, 0.2
"""Duration of the last stage in which the arm is commanded to stay, and least rest after a motion [s]."""
AGAIN = 3
"""How often a joint that did not move far enough has another such rest before that is its fault."""
SHORTEST = 4
"""Least time in which a command is to be reached before the arm has shown that it stays [periods]."""
GAP, KNOWN_GAP = 1e4, 4 * math.pi
"""Greatest distance of a command from the measured joint [rad]: in any unit, and in one that was proved before."""
STILL, SAG = 0.002, 0.03
"""Motion of a joint commanded to stay that counts as none, and the most that its load explains [rad]."""
NEAR_ZERO = 2 * math.pi * math.pi / 180
"""Greatest position of a joint that is divided by the degrees of a radian once more [rad]."""
TINY = 0.0005
"""Motion of all joints that no unit makes large [rad]."""
TOGETHER = ((0.002, 0.15), (0.006, 0.15))
"""The next motions of all joints together [rad], and their durations [s]."""
LEAST_GAIN, MOST_GAIN = 0.6, 1.6
"""Least and greatest share of a commanded motion that a correct joint is measured to move."""
OTHERS = 0.3
"""Share of the motion of a joint by which another joint may move with it, and that counts as no motion."""
COMPARED = 0.15
"""Motion over which a measured speed is compared with the measured position [m, rad]."""
STATE_GAP, FEW_GAPS = 2.0, 20
"""Time between two states from which a motion is not judged across it [periods], and how often that is so."""
OPEN, OPENS_WITHIN = 0.95, 3.0
"""Share of its range to which a gripper is commanded when it is to open, and the longest time for that [s]."""
Step = tuple[Numbers, float | None]
"""Joints to command (k,) [rad], and the time in which they are to be reached [s]; None: one period."""
Moves = Generator[Step, Numbers, Numbers]
"""Yields steps, takes the measured joints (k,) [rad] after each, and returns the last of them."""


class NotAsCommanded(Exception):  # noqa: N818 - named for the cause
    """An arm did not move as commanded; the text says which joint, and how."""


class ProofMotion:
    """The proof of an arm's commands, without any input or output.

    Args:
        labels: Names of the joints.
        start: Measured joints (k,) [rad].
        middle: Middle of the range of each joint (k,) [rad], towards which it moves.
        period: Time between two commands [s].
        lag: Longest delay of the measured joints behind the commands [s].
        is_timed: Whether a command says in which time it is to be reached; otherwise it is executed at once.
        sag: How far the load of a weak servo moves a joint that is commanded to stay [rad], `SAG` at most.
    """

    def __init__(
        self,
        labels: Sequence[str],
        start: Numbers,
        middle: Numbers,
        period: float,
        lag: float,
        *,
        is_timed: bool,
        sag: float = SAG,
    ) -> None:
        self._sag = min(SAG, sag)
        self._labels, self._start, self._period, self._lag, self._is_timed = labels, start, period, lag, is_timed
        self._signs = [1.0 if value <= most else -1.0 for value, most in zip(start, middle, strict=True)]
        self._base = start.copy()  # where the joints are measured when they are commanded to `start`
        self._rest = [0.0] * len(start)
        self.age = 0.0
        """Age of the measured joints that come next [s], as on a busy computer."""
        self.measured_lag = 0.0
        """Delay of the joint that moved last behind its commands [s]."""

    def moves(self, *, every: bool) -> Moves:
        """The steps, after which the arm is where it began.

        Args:
            every: Whether each joint moves; otherwise, for commands that were proved before, the last one alone.

        Raises:
            NotAsCommanded: The arm does not move as commanded.
        """
        if every and self._is_timed and all(abs(at) <= NEAR_ZERO for at in self._start):
            raise NotAsCommanded(
                f"all joints are measured within {NEAR_ZERO:.2f} rad of 0, as by a driver or a profile that takes "
                "radians for degrees, with which a motion would look like none: correct the scale, or jog a joint away"
            )
        yield from self._stay(GAP if every else KNOWN_GAP)
        yield from self._together() if every else self._ramp(self._all(TINY), self._rest, 0.0)
        there = self._rest
        for joint in range(len(self._labels)) if every else [len(self._labels) - 1]:
            there = yield from self._alone(joint, there)
        return (yield from self._ramp(there, self._rest, MOST_GAIN * PROOF / SLOW))

    def _all(self, amount: float) -> Numbers:
        return [sign * amount for sign in self._signs]

    def _stay(self, greatest: float) -> Moves:
        """Stay at the measured position; a command that means another one is approached so slowly that it shows first.

        A gap between what is measured and what is commanded closes in the commanded time. The longer nothing moves, the
        smaller is the gap that is still possible, and the shorter the commanded time.
        """
        goal = [at + way for at, way in zip(self._start, self._all(TINY), strict=True)]
        closed = [0.0]  # share of a gap that was closed after each command
        while self._is_timed:
            delay = 1 + self._ticks(self._lag + self.age)  # commands that may not show yet
            gap = min(greatest, self._sag + STILL / max(closed[max(0, len(closed) - delay)], 1e-9))
            if gap <= MOST:
                break
            closed.append(closed[-1] + self._period * SLOW / gap)
            self._require_still((yield goal, gap / SLOW), STILL + self._sag * min(1.0, closed[-1]))
        ticks, measured = self._ticks(SETTLE), self._start
        for tick in range(ticks + self._ticks(self._lag)):
            reach = max(SHORTEST, ticks + SHORTEST - 1 - tick) * self._period
            measured = yield goal, reach if self._is_timed else None
            self._require_still(measured, STILL + self._sag)
        self._base = [at - way for at, way in zip(measured, self._all(TINY), strict=True)]
        if max(abs(now - begin) for now, begin in zip(self._base, self._start, strict=True)) > STILL:
            once, twice, reach = self._all(TINY), self._all(2 * TINY), SHORTEST * self._period
            yield from self._ramp(once, twice, SETTLE, reach)  # a sag, or TINY in another unit?
            measured = yield from self._ramp(twice, once, SETTLE, reach)
        return measured

    def _require_still(self, measured: Numbers, most: float) -> None:
        moved = [now - before for now, before in zip(measured, self._start, strict=True)]
        at = max(range(len(moved)), key=lambda joint: abs(moved[joint]))
        if abs(moved[at]) > most + TINY:
            sags = "; or, of a weak servo, the load: allow it with --guard follow_tolerance=0.03" if most < SAG else ""
            raise NotAsCommanded(
                f"{self._labels[at]} was commanded to stay where it is measured, and moved {moved[at]:+.3f} rad: "
                f"commands and measurements differ in the order of the joints, in a sign, an offset or the unit{sags}"
            )

    def _together(self) -> Moves:
        """Move all joints a little and back, which shows commands in another unit, and an arm that does not move."""
        before, measured = self._all(TINY), self._base
        for amount, seconds in TOGETHER:
            measured = yield from self._ramp(before, self._all(amount), seconds)
            before = self._all(amount)
        moved = max(abs(now - begin) for now, begin in zip(measured, self._base, strict=True))
        if moved < OTHERS * TOGETHER[-1][0]:
            raise NotAsCommanded(f"all joints were commanded to move, and none moved: {LIKELY}")
        return (yield from self._ramp(before, self._rest, WAIT))

    def _alone(self, joint: int, before: Numbers) -> Generator[Step, Numbers, Numbers]:
        """Move one joint, which moves as far as commanded, from `before`; returns where the arm is then."""
        name, there = self._labels[joint], before.copy()
        there[joint] = self._signs[joint] * PROOF
        measured = yield from self._ramp(before, there, MOST_GAIN * PROOF / SLOW)
        for _ in range(AGAIN):  # on a busy computer the arm, or its state, may come late
            if abs(measured[joint] - self._base[joint]) < LEAST_GAIN * PROOF:
                measured = yield from self._ramp(before, there, 0.0)
        moved = measured[joint] - self._base[joint]
        if not LEAST_GAIN <= moved / there[joint] <= MOST_GAIN:
            did = "did not move" if abs(moved) < OTHERS * PROOF else f"moved {moved:+.3f} rad"
            raise NotAsCommanded(f"{name} was commanded to move {there[joint]:+.3f} rad, and {did}: {LIKELY}")
        return there

    def _ramp(self, begin: Numbers, end: Numbers, seconds: float, reach: float | None = None) -> Moves:
        """Go from `begin` to `end` (k,), relative to the start, and rest there; for `reach` see `Step`."""
        ticks, measured = self._ticks(seconds), self._base
        for tick in range(1, ticks + self._ticks(max(WAIT, self._lag + 0.075)) + 1):
            share = min(1.0, tick / max(1, ticks))
            way = [one + (other - one) * share for one, other in zip(begin, end, strict=True)]
            measured = yield [at + one for at, one in zip(self._start, way, strict=True)], reach
            for joint, row in enumerate(zip(begin, end, measured, strict=True)):
                self._require_near(joint, *row, begin, end)
                if tick == ticks and abs(row[1] - row[0]) == PROOF:
                    behind = abs(way[joint] - (row[2] - self._base[joint]))
                    self.measured_lag = behind * seconds / PROOF
        return measured

    def _require_near(self, joint: int, one: float, other: float, at: float, begin: Numbers, end: Numbers) -> None:
        """Require that a joint measured `at` [rad] is near its way from `one` to `other` [rad]."""
        place, low, high = at - self._base[joint], min(one, other), max(one, other)
        spare = STILL + (MOST_GAIN - 1.0) * (high - low) if high > low else OTHERS * PROOF
        if low - spare <= place <= high + spare:
            return
        name = self._labels[joint]
        if high == low and begin != end:
            moving = next(self._labels[i] for i in range(len(begin)) if begin[i] != end[i])
            raise NotAsCommanded(
                f"{name} moved {place:+.3f} rad when {moving} was commanded: the commands have another order of joints"
            )
        raise NotAsCommanded(
            f"{name} was commanded to move {other - one:+.4f} rad, and moved {place - one:+.4f} rad: its commands have "
            "another sign or unit, or the joints another order"
        )

    def _ticks(self, seconds: float) -> int:
        return math.ceil(seconds / self._period - 1e-9)


class FirstMotion(Guard):
    """In the first motion, measured speeds fit measured positions, and the gripper opens when it is commanded to."""

    number, name, unit, limit_value = "G25", "first motion", "share of the measured motion", MOST_GAIN

    def __init__(self, spec: RobotSpec) -> None:
        self._period = spec.period
        sizes = {signal.name: len(signal.labels) for signal in spec.signals}
        self._ways: list[_Way] = []
        if "joint_position" in sizes and sizes.get("joint_velocity") == sizes["joint_position"]:
            names = next(signal.labels for signal in spec.signals if signal.name == "joint_position")
            self._ways = [_Way(f"joint_velocity of {name}", name, "rad", joint) for joint, name in enumerate(names)]
        if "base_pose" in sizes and "base_velocity" in sizes:
            ways = ["the speed", *["the speed sideways"] * (sizes["base_velocity"] == 3), "the turn rate"]
            self._ways = [
                _Way(f"{way} in base_velocity", "base_pose", "rad" if "turn" in way else "m", column)
                for column, way in enumerate(ways)
            ]
        self._most = MOST_GAIN
        self._is_base = "base_pose" in sizes
        self._grippers = [(at, spec.command.labels[at], spec.command.high[at]) for at in columns_in(spec.command, "m")]
        self._opening, self._longest = 0, ticks_of(OPENS_WITHIN, spec)
        self._pose: Numbers | None = None
        self._gaps = 0  # states that came after a gap

    @property
    def opens(self) -> bool:
        """Whether the gripper has shown that it opens when it is commanded to, or there is none."""
        return not self._grippers

    def connected(self, *, simulated: bool) -> None:
        """Take note of a simulated robot, whose time passes more slowly than the clock where its computer is busy."""
        self._most = math.inf if simulated else MOST_GAIN

    def restart(self) -> None:
        """Forget the motion so far: time may have passed without commands."""
        self._opening, self._pose = 0, None
        for way in self._ways:
            way.restart()

    def fault(self, tick: Tick) -> str | None:
        """Report a speed that is not the change of its position, or a gripper that does not open."""
        if self._grippers and (reason := self._gripper(tick)) is not None:
            return reason
        if not self._ways:
            return None
        seconds, signals = tick.elapsed, tick.signals  # from state to state, as a speed is one of its state
        if self._is_base:
            speeds = signals["base_velocity"][0].tolist()
            changes = self._driven(signals["base_pose"][0].tolist())
            changes = changes if len(speeds) == 3 else [changes[0], changes[2]]
        else:
            speeds = signals["joint_velocity"][0].tolist()
            positions = signals["joint_position"][0].tolist()
            before, self._pose = self._pose or positions, positions
            changes = [now - old for now, old in zip(positions, before, strict=True)]
        if seconds > STATE_GAP * self._period and self._gaps < FEW_GAPS:
            self._gaps += 1  # in which a busy computer may have held up the states, or a simulated robot
            return None
        for way in self._ways:
            if (reason := way.add(changes[way.column], speeds[way.column] * seconds, self._most)) is not None:
                return reason
        if all(way.fits for way in self._ways):
            self._ways = []
        return None

    def _driven(self, pose: Numbers) -> Numbers:
        """Distance driven forwards and to the left [m] and angle turned [rad] since the last tick, by x, y, yaw."""
        before, self._pose = self._pose or pose, pose
        turned = math.remainder(pose[2] - before[2], 2 * math.pi)
        heading, dx, dy = before[2] + turned / 2, pose[0] - before[0], pose[1] - before[1]
        cos, sin = math.cos(heading), math.sin(heading)
        return [dx * cos + dy * sin, dy * cos - dx * sin, turned]

    def _gripper(self, tick: Tick) -> str | None:
        """Report a gripper that was commanded to open and is not measured open."""
        for at, name, widest in self._grippers:
            measured = tick.measured[at]
            if math.isnan(measured):
                self._grippers = []
            elif tick.last[at] < OPEN * widest:
                self._opening = 0
            elif measured >= (1.0 - OTHERS) * widest:
                self._grippers = []
            else:
                self._opening += 1
                if self._opening > self._longest:
                    return (
                        f"{name} was commanded to open to {tick.last[at]:.3f} m and is measured at {measured:.3f} m: "
                        "inverted, in another unit such as the angle of a finger, or blocked; correct its scale and "
                        "offset in the profile, or free it"
                    )
        return None


class _Way:
    """Adds up a measured speed and the change of its position, until both show a motion that can be compared."""

    def __init__(self, speed: str, position: str, unit: str, column: int) -> None:
        self.column, self._speed, self._position, self._unit = column, speed, position, unit
        self.fits, self._wrong = False, 0
        self.restart()

    def restart(self) -> None:
        self._by_position = self._by_speed = self._way = 0.0

    def add(self, change: float, by_speed: float, most: float) -> str | None:
        """Take one tick; the reason for a stop if the two differ in two motions, by more than `most` times."""
        if self.fits or math.isnan(by_speed):
            return None
        if change * self._way < -STILL * STILL:  # it turns round
            self.restart()
        self._by_position, self._by_speed = self._by_position + change, self._by_speed + by_speed
        self._way = self._by_position
        if max(abs(self._by_position), abs(self._by_speed)) < COMPARED:
            return None
        measured, told = self._by_position, self._by_speed
        self.restart()
        if abs(measured) > STILL and LEAST_GAIN <= told / measured <= most:
            self.fits = True
            return None
        self._wrong += 1
        if self._wrong < 2:
            return None
        return (
            f"{self._speed} adds up to {told:+.3f} {self._unit} while {self._position} changed by {measured:+.3f} "
            f"{self._unit}: one of them is not measured, mirrored, or in another unit; correct the driver, or the "
            "scale in the profile"
        )
