"""Simulated robots behind a simulated link: late, lost and repeated commands, late, lost and empty states.

Time is counted in periods of the robot. A delay d [s] is floor(d / T + u) periods T, u uniform in [0, 1), so that the
mean is right also where d is shorter than T. Messages keep their order, as on TCP: a late one holds up those behind it.
What is drawn follows from the seed of the episode and the number of the step alone: environment i of a batch equals a
single one with the same seed, bit for bit.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, Initial, Robot, RobotState, checked_command
from bam_envs.core.validation import Fraction, check_fields, read_table
from bam_envs.core.wording import brief, did_you_mean
from bam_envs.robots.physics.room import mixed
from bam_envs.safety.guard import is_base, measured_places

Array = NDArray[np.float64]
Counts = NDArray[np.int64]
LONGEST = 32
"""Maximum delay of a message [periods]; later ones count as lost."""
WATCHDOG = 0.5
"""Time after the last command at which a base stops by itself [s]; an arm stays where its last command sent it."""
NEVER = np.iinfo(np.int64).max
_COMMANDS, _STATES = 0, 1  # the two directions
_STAMP = "stamp"  # of a state, kept beside its signals

Quantiles = Annotated[
    list[Annotated[float, Meta(ge=0, le=60)]],
    Meta(min_length=2, max_length=1001, description="a list of 2 to 1001 times from 0 to 60 s"),
]
Share = Annotated[float, Meta(ge=0, le=0.9)]


@dataclass(frozen=True)
class LinkProfile:
    """What a link does to the messages of a robot; ``bam-doctor --measure`` writes it as JSON.

    A delay is a distribution: its quantiles [s] at equally spaced probabilities from 0 to 1, in rising order.

    Raises:
        InvalidValue: A value does not fit; names it.
    """

    command_delay: Quantiles
    """Quantiles of the time from sending a command to its arrival at the robot [s]."""
    state_delay: Quantiles
    """Quantiles of the time from measuring a state to its arrival here [s]."""
    command_loss: Share = 0.0
    """Share of commands that never arrive."""
    state_loss: Share = 0.0
    """Share of states that never arrive."""
    burst: Annotated[float, Meta(ge=1, le=1000)] = 1.0
    """Mean number of messages that are lost in a row; at least what chance alone makes of it."""
    duplicates: Fraction = 0.0
    """Share of steps in which the command before the newest one arrives again, after it."""
    nulls: Fraction = 0.0
    """Share of states with a null in place of a number, which are dropped when they arrive."""
    about: str = ""
    """What was measured, where and when; for people."""

    def __post_init__(self) -> None:
        check_fields(self, lambda name: f"link: {name}")
        for name in ("command_delay", "state_delay"):
            values = list(getattr(self, name))
            if values != sorted(values):
                raise InvalidValue(f"link: {name}: expected quantiles in rising order, found {brief(values)}")

    def to_json(self) -> str:
        """The content of a file for `link_profile`."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1).decode()


def quantiles(p50: float, p90: float, p99: float, most: float) -> list[float]:
    """101 quantiles on straight lines through four [s]; the smallest is half the median."""
    through = np.interp(np.linspace(0, 1, 101), [0, 0.5, 0.9, 0.99, 1], [p50 / 2, p50, p90, p99, most])
    return [float(value) for value in through]


def _both_ways(delay: list[float], loss: float, burst: float, duplicates: float, nulls: float) -> LinkProfile:
    return LinkProfile(delay, delay, loss, loss, burst, duplicates, nulls)


PROFILES: dict[str, LinkProfile] = {
    "wifi": _both_ways(quantiles(0.004, 0.012, 0.06, 0.15), loss=0.002, burst=2.0, duplicates=0.0, nulls=0.0),
    "lte": _both_ways(quantiles(0.03, 0.06, 0.15, 0.4), loss=0.005, burst=3.0, duplicates=0.0, nulls=0.0),
    "bad": _both_ways(quantiles(0.05, 0.15, 0.4, 1.0), loss=0.05, burst=5.0, duplicates=0.01, nulls=0.01),
}
"""Shipped profiles, both directions alike: a busy wireless network, a mobile network, one that nobody should use."""


def link_profile(link: object) -> LinkProfile:
    """The profile that `link` names or holds: a shipped name, the name of a JSON file, a table, or a profile itself.

    Raises:
        InvalidValue: There is no such profile or file, or it holds nonsense; names the field.
    """
    if isinstance(link, LinkProfile):
        return link
    if isinstance(link, Mapping):
        return read_table(LinkProfile, dict(link), "link")
    if not isinstance(link, (str, Path)):
        raise InvalidValue(f"link: expected the name of a profile, a .json file or a table, found {brief(link)}")
    if link in PROFILES:
        return PROFILES[str(link)]
    path = Path(link).expanduser()
    if path.suffix != ".json":
        raise InvalidValue(
            f"link: {str(link)!r} is neither a shipped profile nor a .json file. {did_you_mean(link, PROFILES)}"
        )
    try:
        return read_table(LinkProfile, msgspec.json.decode(path.read_bytes()), str(link))
    except InvalidValue as error:
        raise InvalidValue(str(error).replace("link: ", f"{link}: ", 1)) from error
    except OSError as error:
        raise InvalidValue(
            f"link: {link} cannot be read: {error.strerror or error}. Write it with bam-doctor --measure {link}"
        ) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidValue(f"link: {link} is not JSON: {error}. Write it with bam-doctor --measure {link}") from error


def portable(link: object) -> object:
    """`link` without a file, which need not be where a checkpoint is used: a shipped name, a table, or None."""
    if link is None or link in list(PROFILES):
        return link
    return asdict(link_profile(link))


class LinkedRobot:
    """Simulated robots behind a link; a `Robot` around a `Robot`.

    Each period one command is sent, and the robots execute the newest one that has arrived. Returned states are the
    newest that have arrived, with the command that was sent; ``truth`` is of now.

    Args:
        robot: The robots behind the link.
        profile: What the link does.
    """

    def __init__(self, robot: Robot, profile: LinkProfile) -> None:
        self.robot, self.profile, self.spec, self.num_robots = robot, profile, robot.spec, robot.num_robots
        n, m = robot.num_robots, len(robot.spec.command.labels)
        self._is_base = is_base(robot.spec)
        self._seeds, self._count = np.zeros(n, np.uint64), np.zeros(n, np.int64)  # the steps of the episode
        self._sent = np.zeros((n, LONGEST + 1, m))  # command k is at k % (LONGEST + 1), and so are states
        self._states: dict[str, Array] = {}
        self._due = np.full((n, 2, LONGEST + 1), NEVER)  # the step at which command k, state k arrives
        self._last_due = np.zeros((n, 2), np.int64)  # the latest arrival so far: messages keep their order
        self._lost = np.zeros((n, 2), bool)  # whether the last command, state was lost: losses come in bursts
        self._newest = np.zeros((n, 2), np.int64)  # number of the newest command, state that has arrived
        self._heard = np.zeros(n, np.int64)  # the step at which the robot heard a new command
        self._now: dict[str, Array] = {}  # the newest state that has arrived
        self._command = np.zeros((n, m))  # the newest command that has arrived
        self._last_sent = np.zeros((n, m))
        nothing = RobotState({}, np.zeros(n), self._last_sent)
        self.there = nothing
        """The newest state at the robots' end; without signals before `reset`."""
        self.newest = nothing
        """The newest state that has arrived here, as returned last."""
        self._rows = np.arange(n)

    def connect(self) -> None:
        """Make the robots ready."""
        self.robot.connect()

    @property
    def age(self) -> Array:
        """Age of the newest state that has arrived [s]. Shape: (n,)."""
        age: Array = (self._count - self._newest[:, _STATES]).astype(np.float64) * self.spec.period
        return age

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Bring these robots to `initial`; nothing is on its way then."""
        state = self.robot.reset(env_ids, initial)
        self._seeds[env_ids] = mixed(np.asarray(initial.seeds).astype(np.uint64) + np.uint64(0x11AB))
        for zero in (self._count, self._newest, self._heard, self._lost, self._last_due):
            zero[env_ids] = 0
        self._due[env_ids] = NEVER
        self._command, self._last_sent = self._command.copy(), self._last_sent.copy()
        self._command[env_ids] = self._last_sent[env_ids] = state.command[env_ids]
        signals = {**state.signals, _STAMP: state.stamp[:, None]}
        for name, array in signals.items():
            if name not in self._states:
                self._states[name] = np.zeros((len(array), LONGEST + 1, *array.shape[1:]))
                self._now[name] = array.copy()
            self._now[name] = self._now[name].copy()
            self._now[name][env_ids] = array[env_ids]
        return self._seen(state)

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, m), SI units; one period later, the newest state that has arrived.

        Raises:
            InvalidValue: It has another shape, or is not finite.
        """
        command = checked_command(command, self._command.shape)
        draws = self._next_step()
        slot = self._count % (LONGEST + 1)
        self._last_sent = self._sent[self._rows, slot] = command
        self._post(_COMMANDS, draws[:3])
        return self._advance(draws)

    def wait(self) -> RobotState:
        """Send nothing for a period; the newest state that has arrived."""
        draws = self._next_step()
        self._due[self._rows, _COMMANDS, self._count % (LONGEST + 1)] = NEVER
        return self._advance(draws)

    def _next_step(self) -> Array:
        """Begin the next step; its random numbers from 0 to 1. Shape: (7, n)."""
        self._count = self._count + 1
        steps = mixed(self._count.astype(np.uint64) * np.uint64(7) + np.arange(7, dtype=np.uint64)[:, None])
        draws: Array = (mixed(self._seeds + steps) >> np.uint64(11)).astype(np.float64) / 2**53
        return draws

    def _post(self, way: int, draws: Array) -> None:
        """Draw when message number `count` of each robot arrives."""
        profile = self.profile
        loss, delay = (
            (profile.command_loss, profile.command_delay)
            if way == _COMMANDS
            else (profile.state_loss, profile.state_delay)
        )
        # A chain of two states whose share of losses is `loss` and whose mean run of losses is `burst`.
        stay = max(loss, 1 - 1 / profile.burst)
        lost = draws[0] < np.where(self._lost[:, way], stay, loss / (1 - loss) * (1 - stay))
        self._lost[:, way] = lost
        if way == _STATES:
            lost = lost | (draws[0] > 1 - profile.nulls)
        late = np.interp(draws[1], np.linspace(0, 1, len(delay)), delay) / self.spec.period
        due = np.maximum(self._count + np.floor(late + draws[2]).astype(np.int64), self._last_due[:, way])
        lost = lost | (due >= self._count + LONGEST)
        self._due[self._rows, way, self._count % (LONGEST + 1)] = np.where(lost, NEVER, due)
        self._last_due[:, way] = np.where(lost, self._last_due[:, way], due)

    def _arrivals(self, way: int) -> Any:
        """Take in what arrives in this step; a mask of the robots with a newer message. Shape: (n,) bool."""
        numbers = self._count[:, None] - np.arange(LONGEST + 1)
        due = np.take_along_axis(self._due[:, way], numbers % (LONGEST + 1), axis=1)
        arrived = (due <= self._count[:, None]) & (numbers > self._newest[:, way, None])
        newer = arrived.any(axis=1)
        newest = self._count - arrived.argmax(axis=1)
        self._newest[:, way] = np.where(newer, newest, self._newest[:, way])
        return newer

    def _advance(self, draws: Array) -> RobotState:
        """One period: the robots execute the newest command, and their state is sent here."""
        newer = self._arrivals(_COMMANDS)
        number = self._newest[:, _COMMANDS]
        self._heard = np.where(newer, self._count, self._heard)
        self._command = np.where(newer[:, None], self._sent[self._rows, number % (LONGEST + 1)], self._command)
        repeated = (draws[6] < self.profile.duplicates) & (number > 1) & newer
        executed = np.where(repeated[:, None], self._sent[self._rows, (number - 1) % (LONGEST + 1)], self._command)
        if self._is_base:
            silent = (self._count - self._heard) * self.spec.period > WATCHDOG
            executed = np.where(silent[:, None], 0.0, executed)
        state = self.robot.step(executed)
        slot = self._count % (LONGEST + 1)
        for name, array in {**state.signals, _STAMP: state.stamp[:, None]}.items():
            self._states[name][self._rows, slot] = array
        self._post(_STATES, draws[3:6])
        newer, place = self._arrivals(_STATES), self._newest[:, _STATES] % (LONGEST + 1)
        for name, array in self._states.items():
            mask = newer.reshape(-1, *[1] * (array.ndim - 2))
            self._now[name] = np.where(mask, array[self._rows, place], self._now[name])
        return self._seen(state)

    def _seen(self, there: RobotState) -> RobotState:
        signals = dict(self._now)
        stamp = signals.pop(_STAMP)[:, 0]
        self.there, self.newest = there, RobotState(signals, stamp, self._last_sent, there.truth)
        return self.newest

    def rest(self, state: RobotState) -> Array:
        """The command that stops robots measured in `state`: no speed of a base, an arm where it is. Shape: (n, m)."""
        if self._is_base:
            return np.zeros_like(self._command)
        rest: Array = self._last_sent.copy()
        for place, name, column in measured_places(self.spec, self.spec.command.units):
            if self.spec.command.units[place] == "rad":  # the gripper keeps its grip
                rest[:, place] = state.signals[name][:, column]
        return rest

    def halt(self) -> None:
        """Stop moving, at once; commands on their way are dropped."""
        self.robot.halt()
        if self.there.signals:
            self._due[:, _COMMANDS] = NEVER
            self._command = self.rest(self.there)

    def close(self) -> None:
        """Halt, and drop the link."""
        self.robot.close()

    def render(self, mode: str, marks: list[Any]) -> Any:
        """The image of environment 0, where it is now; see the robot's own."""
        robot: Any = self.robot
        return robot.render(mode, marks)

    _MEMORY = ("_seeds", "_count", "_sent", "_due", "_last_due", "_lost", "_newest", "_heard", "_command", "_last_sent")

    def state_dict(self) -> dict[str, Any]:
        """Everything that the future of robots and link depends on."""
        robot: Any = self.robot
        tables = {"states": self._states, "now": self._now}
        copies = {key: {name: array.copy() for name, array in table.items()} for key, table in tables.items()}
        return {"robot": robot.state_dict(), **copies, **{name: getattr(self, name).copy() for name in self._MEMORY}}

    def load_state_dict(self, state: Mapping[str, Any]) -> RobotState:
        """Restore the result of `state_dict`; returns the state."""
        robot: Any = self.robot
        there: RobotState = robot.load_state_dict(state["robot"])
        self._states, self._now = (
            {name: np.array(array) for name, array in state[key].items()} for key in ("states", "now")
        )
        for name in self._MEMORY:
            setattr(self, name, np.array(state[name]))
        return self._seen(there)
