"""Simulated robots behind a simulated link: late, lost and repeated commands; late, lost and unreadable states.

Time is counted in periods of the robot. A delay d [s] is floor(d / T + u) periods T, u uniform in [0, 1), so that the
mean is right also where d is shorter than T. Messages keep their order, as on TCP: a late one holds up those behind it.
Random numbers depend only on the seed of the episode and the number of the step: environment i of a batch equals a
single environment with the same seed, bit for bit.
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
from bam_envs.robots.room import mixed
from bam_envs.safety.guard import is_base, measured_places

Array = NDArray[np.float64]
Counts = NDArray[np.int64]
LONGEST = 32
"""Maximum delay of a message [periods]; a later message counts as lost."""
WATCHDOG = 0.5
"""Time after the last command at which a base stops by itself [s]; an arm stays where its last command sent it."""
NEVER = np.iinfo(np.int64).max
_COMMANDS, _STATES = 0, 1  # the two directions
_STAMP = "stamp"  # key of the time stamp beside the signals of a state

Quantiles = Annotated[
    list[Annotated[float, Meta(ge=0, le=60)]],
    Meta(min_length=2, max_length=1001, description="a list of 2 to 1001 times from 0 to 60 s"),
]
Share = Annotated[float, Meta(ge=0, le=0.9)]


@dataclass(frozen=True)
class LinkProfile:
    """Delay, loss and damage of the messages of a robot on a link; ``bam-doctor --measure`` writes it as JSON.

    A delay is a distribution: its quantiles [s] at equally spaced probabilities from 0 to 1, in rising order.

    Raises:
        InvalidValue: A value is invalid; the error names it.
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
    """Mean number of consecutive lost messages; at least that of independent losses."""
    duplicates: Fraction = 0.0
    """Share of steps in which the previous command arrives again after the newest one."""
    nulls: Fraction = 0.0
    """Share of states with a null in place of a number, which are dropped on arrival."""
    about: str = ""
    """Description of the measurement, for people."""

    def __post_init__(self) -> None:
        check_fields(self, lambda name: f"link: {name}")
        for name in ("command_delay", "state_delay"):
            values = list(getattr(self, name))
            if values != sorted(values):
                raise InvalidValue(f"link: {name}: expected quantiles in rising order, found {brief(values)}")

    def to_json(self) -> str:
        """The profile as JSON, for a file that `link_profile` reads."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1).decode()


def quantiles(p50: float, p90: float, p99: float, most: float) -> list[float]:
    """101 quantiles by linear interpolation through the given ones [s]; the smallest is half the median."""
    through = np.interp(np.linspace(0, 1, 101), [0, 0.5, 0.9, 0.99, 1], [p50 / 2, p50, p90, p99, most])
    return [float(value) for value in through]


def _both_ways(delay: list[float], loss: float, burst: float, duplicates: float, nulls: float) -> LinkProfile:
    return LinkProfile(delay, delay, loss, loss, burst, duplicates, nulls)


PROFILES: dict[str, LinkProfile] = {
    "wifi": _both_ways(quantiles(0.004, 0.012, 0.06, 0.15), loss=0.002, burst=2.0, duplicates=0.0, nulls=0.0),
    "lte": _both_ways(quantiles(0.03, 0.06, 0.15, 0.4), loss=0.005, burst=3.0, duplicates=0.0, nulls=0.0),
    "bad": _both_ways(quantiles(0.05, 0.15, 0.4, 1.0), loss=0.05, burst=5.0, duplicates=0.01, nulls=0.01),
}
"""Shipped profiles, equal in both directions: a busy wireless network, a mobile network, an unusable network."""


def link_profile(link: object) -> LinkProfile:
    """The profile for a shipped name, the path of a JSON file, a table, or a profile itself.

    Raises:
        InvalidValue: There is no such profile or file, or a value in it is invalid; the error names the field.
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
    """`link` with the content of a file in its place, for a checkpoint: a shipped name, a table, or None."""
    if link is None or link in list(PROFILES):
        return link
    return asdict(link_profile(link))


class LinkedRobot:
    """Simulated robots behind a link; a `Robot` around a `Robot`.

    In each period one command is sent, and the robots execute the newest command that has arrived. Returned states are
    the newest that have arrived, with the command that was sent; ``truth`` is current.

    Args:
        robot: The robots behind the link.
        profile: The properties of the link.
    """

    def __init__(self, robot: Robot, profile: LinkProfile) -> None:
        self.robot, self.profile, self.spec, self.num_robots = robot, profile, robot.spec, robot.num_robots
        n, m = robot.num_robots, len(robot.spec.command.labels)
        self._is_base = is_base(robot.spec)
        self._seeds, self._count = np.zeros(n, np.uint64), np.zeros(n, np.int64)  # number of the step in the episode
        self._sent = np.zeros((n, LONGEST + 1, m))  # ring buffers: command k, like state k, is at k % (LONGEST + 1)
        self._states: dict[str, Array] = {}
        self._due = np.full((n, 2, LONGEST + 1), NEVER)  # step at which command k, state k arrives
        self._last_due = np.zeros((n, 2), np.int64)  # latest arrival so far: messages keep their order
        self._lost = np.zeros((n, 2), bool)  # whether the last command, state was lost: losses come in bursts
        self._newest = np.zeros((n, 2), np.int64)  # number of the newest command, state that has arrived
        self._heard = np.zeros(n, np.int64)  # step at which the last new command arrived
        self._arrived_state: dict[str, Array] = {}  # the newest state that has arrived
        self._command = np.zeros((n, m))  # the newest command that has arrived
        self._last_sent = np.zeros((n, m))
        nothing = RobotState({}, np.zeros(n), self._last_sent)
        self.there = nothing
        """The current state of the robots; without signals before `reset`."""
        self.newest = nothing
        """The newest state that has arrived; the one returned last."""
        self.age = np.zeros(n)
        """Age of the newest state that has arrived [s]. Shape: (n,)."""
        self._env_ids = np.arange(n)

    def connect(self) -> None:
        """Make the robots ready."""
        self.robot.connect()

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Bring these robots to `initial`; messages on their way are dropped."""
        state = self.robot.reset(env_ids, initial)
        self._seeds[env_ids] = mixed(np.asarray(initial.seeds).astype(np.uint64) + np.uint64(0x11AB))
        for counter in (self._count, self._newest, self._heard, self._lost, self._last_due):
            counter[env_ids] = 0
        self._due[env_ids] = NEVER
        self._command, self._last_sent = self._command.copy(), self._last_sent.copy()
        self._command[env_ids] = self._last_sent[env_ids] = state.command[env_ids]
        signals = {**state.signals, _STAMP: state.stamp[:, None]}
        for name, array in signals.items():
            if name not in self._states:
                self._states[name] = np.zeros((len(array), LONGEST + 1, *array.shape[1:]), array.dtype)
                self._arrived_state[name] = array.copy()
            self._arrived_state[name] = self._arrived_state[name].copy()
            self._arrived_state[name][env_ids] = array[env_ids]
        return self._store(state)

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, m), SI units; returns the newest state that has arrived one period later.

        Raises:
            InvalidValue: The command has another shape, or is not finite.
        """
        command = checked_command(command, self._command.shape)
        draws = self._next_step()
        slot = self._count % (LONGEST + 1)
        self._last_sent = self._sent[self._env_ids, slot] = command
        self._post(_COMMANDS, draws[:3])
        return self._advance(draws)

    def wait(self) -> RobotState:
        """Send nothing for one period; returns the newest state that has arrived."""
        draws = self._next_step()
        self._due[self._env_ids, _COMMANDS, self._count % (LONGEST + 1)] = NEVER
        return self._advance(draws)

    def _next_step(self) -> Array:
        """Begin the next step; returns its random numbers in [0, 1). Shape: (7, n)."""
        self._count = self._count + 1
        steps = mixed(self._count.astype(np.uint64) * np.uint64(7) + np.arange(7, dtype=np.uint64)[:, None])
        draws: Array = (mixed(self._seeds + steps) >> np.uint64(11)).astype(np.float64) / 2**53
        return draws

    def _post(self, direction: int, draws: Array) -> None:
        """Draw the step at which message number `count` of each robot arrives; `draws` has shape (3, n)."""
        profile = self.profile
        loss, delay = (
            (profile.command_loss, profile.command_delay)
            if direction == _COMMANDS
            else (profile.state_loss, profile.state_delay)
        )
        # Gilbert model: a Markov chain with the share of losses `loss` and the mean length of a loss `burst`.
        stay = max(loss, 1 - 1 / profile.burst)
        lost = draws[0] < np.where(self._lost[:, direction], stay, loss / (1 - loss) * (1 - stay))
        self._lost[:, direction] = lost
        if direction == _STATES:
            lost = lost | (draws[0] > 1 - profile.nulls)
        late = np.interp(draws[1], np.linspace(0, 1, len(delay)), delay) / self.spec.period
        due = np.maximum(self._count + np.floor(late + draws[2]).astype(np.int64), self._last_due[:, direction])
        lost = lost | (due >= self._count + LONGEST)
        self._due[self._env_ids, direction, self._count % (LONGEST + 1)] = np.where(lost, NEVER, due)
        self._last_due[:, direction] = np.where(lost, self._last_due[:, direction], due)

    def _arrivals(self, direction: int) -> Any:
        """Receive the messages of this step; returns a mask of robots with a newer message. Shape: (n,) bool."""
        numbers = self._count[:, None] - np.arange(LONGEST + 1)
        due = np.take_along_axis(self._due[:, direction], numbers % (LONGEST + 1), axis=1)
        arrived = (due <= self._count[:, None]) & (numbers > self._newest[:, direction, None])
        newer = arrived.any(axis=1)
        newest = self._count - arrived.argmax(axis=1)
        self._newest[:, direction] = np.where(newer, newest, self._newest[:, direction])
        return newer

    def _advance(self, draws: Array) -> RobotState:
        """Advance one period: the robots execute the newest command, and send their state."""
        newer = self._arrivals(_COMMANDS)
        number = self._newest[:, _COMMANDS]
        self._heard = np.where(newer, self._count, self._heard)
        self._command = np.where(newer[:, None], self._sent[self._env_ids, number % (LONGEST + 1)], self._command)
        repeated = (draws[6] < self.profile.duplicates) & (number > 1) & newer
        executed = np.where(repeated[:, None], self._sent[self._env_ids, (number - 1) % (LONGEST + 1)], self._command)
        if self._is_base:
            silent = (self._count - self._heard) * self.spec.period > WATCHDOG
            executed = np.where(silent[:, None], 0.0, executed)
        state = self.robot.step(executed)
        slot = self._count % (LONGEST + 1)
        for name, array in {**state.signals, _STAMP: state.stamp[:, None]}.items():
            self._states[name][self._env_ids, slot] = array
        self._post(_STATES, draws[3:6])
        newer, place = self._arrivals(_STATES), self._newest[:, _STATES] % (LONGEST + 1)
        for name, array in self._states.items():
            mask = newer.reshape(-1, *[1] * (array.ndim - 2))
            self._arrived_state[name] = np.where(mask, array[self._env_ids, place], self._arrived_state[name])
        return self._store(state)

    def _store(self, there: RobotState) -> RobotState:
        signals = dict(self._arrived_state)
        stamp = signals.pop(_STAMP)[:, 0]
        self.age = (self._count - self._newest[:, _STATES]).astype(np.float64) * self.spec.period
        self.there, self.newest = there, RobotState(signals, stamp, self._last_sent, there.truth)
        return self.newest

    def rest(self, state: RobotState) -> Array:
        """The command that stops robots measured in `state`: zero speed, or the measured joints. Shape: (n, m)."""
        if self._is_base:
            return np.zeros_like(self._command)
        rest: Array = self._last_sent.copy()
        for place, name, column in measured_places(self.spec, self.spec.command.units):
            if self.spec.command.units[place] == "rad":  # the gripper keeps its grip
                rest[:, place] = state.signals[name][:, column]
        return rest

    def halt(self) -> None:
        """Stop moving at once; commands on their way are dropped."""
        self.robot.halt()
        if self.there.signals:
            self._due[:, _COMMANDS] = NEVER
            self._command = self.rest(self.there)

    def close(self) -> None:
        """Halt, and drop the link."""
        self.robot.close()

    def render(self, mode: str, marks: list[Any]) -> Any:
        """The image of environment 0, in its current state; see `render` of the robot."""
        robot: Any = self.robot
        return robot.render(mode, marks)

    _MEMORY = ("_seeds", "_count", "_sent", "_due", "_last_due", "_lost", "_newest", "_heard", "_command", "_last_sent")

    def state_dict(self) -> dict[str, Any]:
        """The complete state of robots and link."""
        robot: Any = self.robot
        tables = {"states": self._states, "now": self._arrived_state}
        copies = {key: {name: array.copy() for name, array in table.items()} for key, table in tables.items()}
        return {"robot": robot.state_dict(), **copies, **{name: getattr(self, name).copy() for name in self._MEMORY}}

    def load_state_dict(self, state: Mapping[str, Any]) -> RobotState:
        """Restore the result of `state_dict`; returns the newest state that has arrived."""
        robot: Any = self.robot
        there: RobotState = robot.load_state_dict(state["robot"])
        self._states, self._arrived_state = (
            {name: np.array(array) for name, array in state[key].items()} for key in ("states", "now")
        )
        for name in self._MEMORY:
            setattr(self, name, np.array(state[name]))
        return self._store(there)
