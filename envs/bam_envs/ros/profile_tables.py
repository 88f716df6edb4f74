"""What a robot profile holds: sources of its signals, sinks of its commands, cameras, ages and limits."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, get_args

from msgspec import Meta

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import RobotSpec, SignalSpec
from bam_envs.core.validation import Finite, NonEmpty, NonNegativeInt, Positive

Topic = Annotated[str, Meta(pattern=r"^(/[A-Za-z]\w*)+\Z", description="an absolute name such as /joint_states")]
"""Without namespace."""
MessageType = Annotated[
    str,
    Meta(pattern=r"^[A-Za-z]\w*/(msg/)?[A-Za-z]\w*\Z", description="a message type such as sensor_msgs/JointState"),
]
ImageType = Literal["sensor_msgs/CompressedImage", "sensor_msgs/Image"]
"""What a camera may send: JPEG or PNG, or raw pixels, which come on a CBOR connection of their own."""
IMAGE_TYPES = get_args(ImageType)
_TRAJECTORY = "trajectory_msgs/JointTrajectory"
_LAGS = {"arm": 0.1, "base": 0.3}
"""How far live robots are behind their commands [s], network and controller together; the limit `lag` changes it."""


@dataclass(frozen=True, kw_only=True)
class Content:
    """Where numbers are in the messages of a topic."""

    topic: Topic
    type: MessageType
    """Message type, ``pkg/Type``. What is stamped (``pkg/TypeStamped``) is read too where `type` is not."""
    fields: tuple[NonEmpty, ...] = ()
    """Where each number is, e.g. ``pose.position.x``; ``yaw(orientation)`` is the angle about z of a quaternion."""
    names: tuple[NonEmpty, ...] = ()
    """Names of the numbers at the robot, in the order of the labels; a message may have them in another one. Empty: the
    numbers of a source have no names, those of a sink are called like its labels."""
    scale: tuple[Finite, ...] = (1.0,)
    """SI value = number x scale + offset; one for all, or one for each."""
    offset: tuple[Finite, ...] = (0.0,)
    """See `scale`."""


@dataclass(frozen=True, kw_only=True)
class Source(Content):
    """Where the numbers of one signal come from."""

    signal: NonEmpty
    """Which signal."""
    field: NonEmpty = ""
    """Where the list of its numbers is, e.g. ``position``; or `fields`."""
    ignore: tuple[NonEmpty, ...] = ()
    """Names that may come too, and are not ours."""
    partial: bool = False
    """Whether several publishers share the topic, so that messages without any of `names` are somebody else's."""
    skip: tuple[NonNegativeInt, NonNegativeInt] = (0, 0)
    """How many numbers of `field` to leave out at the beginning and at the end."""
    missing: Finite | None = None
    """What null, NaN and infinities in `field` mean; None: they are errors."""
    within: tuple[Finite, Finite] | None = None
    """Least and greatest that its numbers can be, as they travel: what is beyond is cut. None: as they come."""
    frame: NonEmpty = ""
    """Frame that ``header.frame_id`` must name, or the message is refused; empty: not looked at."""
    max_age: Positive | None = None
    """Oldest that is acted on [s]; None: the profile's."""
    optional: bool = False
    """Whether it is measured only when it is asked for."""
    constants: Mapping[str, Finite] = dataclasses.field(default_factory=dict)
    """Further fields of the message, as a simulated robot sends them."""


@dataclass(frozen=True, kw_only=True)
class Sink(Content):
    """Where some of the numbers of a command go."""

    labels: tuple[NonEmpty, ...]
    """Which numbers of the command, by label, in the order of the message."""
    reach: Positive | None = None
    """When a trajectory's point is to be reached [s]; None: `reach_periods` after it was sent."""
    reach_periods: Positive = 1.0
    """The same, in periods of the task; above 1 an arm does not stop where the next command is late."""
    hold: Literal["measured", "last", "zero"] = "measured"
    """What a halt sends: where it is, what was sent last, or zeros."""
    tag: bool = True
    """Whether the message says who sent it when, if its type has room for a text: ``header.frame_id``, or the label of
    an array's first dimension."""
    controller: NonEmpty = ""
    """The controller of ros2_control that takes it, which must be active; empty, and where the topic is renamed: it is
    not asked for."""

    def reach_at(self, period: float) -> float:
        """When a trajectory's point is to be reached [s], where a command is sent every `period` [s]."""
        return period * self.reach_periods if self.reach is None else self.reach


@dataclass(frozen=True)
class Readiness:
    """A topic on which a robot says whether it can move. A robot that does not have it is driven without."""

    topic: Topic
    type: MessageType
    field: tuple[NonEmpty, ...]
    """Where the value is, e.g. ``mode``; of several names the first that the message has."""
    ready: tuple[Finite | bool | str, ...] = ()
    """The values with which it can move; or `at_least`."""
    at_least: Finite | None = None
    """The least number with which it can begin to move."""
    words: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """What other values mean, e.g. ``3 = "protective stop"``."""
    otherwise: NonEmpty = ""
    """What all further values mean; ``{}`` stands for the value. Empty: the value itself is said."""

    def value(self, message: Any) -> Any:
        """The value in `message`; None if it has none."""
        for path in self.field:
            found = message
            for name in path.split("."):
                found = found.get(name) if isinstance(found, Mapping) else None
            if found is not None:
                return found
        return None

    def trouble(self, message: Any) -> str | None:
        """Why the robot cannot move, by `message`; None if it can, or does not say."""
        value = self.value(message)
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        enough = self.at_least is not None and not (number and value < self.at_least)
        if value is None or value in self.ready or enough:
            return None
        text = f"{value:g}" if number else str(value).lower() if isinstance(value, bool) else str(value)
        return self.words.get(text) or self.otherwise.replace("{}", text) or f"{self.field[0]} is {text}"


@dataclass(frozen=True)
class CameraSource:
    """A camera."""

    name: NonEmpty
    """What it is called here."""
    topic: Topic
    type: MessageType = "sensor_msgs/CompressedImage"
    """One of `IMAGE_TYPES`."""
    max_age: Positive = 0.5
    """Oldest image that is handed out [s]."""


@dataclass(frozen=True)
class RobotProfile:
    """A live robot, as one file describes it."""

    name: str
    kind: Literal["arm", "base"]  # what moves
    signals: tuple[SignalSpec, ...]  # every signal that has a source
    command: SignalSpec  # what it is sent
    state: tuple[Source, ...]  # one source for each of `signals`, in their order
    commands: Mapping[str, tuple[Sink, ...]]
    """Modes in which a command is sent, by name, the default first. The last sink of a mode completes a command."""
    period: float  # time between two commands [s]
    max_age: float  # oldest state that is acted on [s]
    command_timeout: float  # for how long a command means something [s]; see `command_life`
    limits: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Limits of the guards that differ from their defaults, by their names in `bam_envs.safety.guards`."""
    cameras: tuple[CameraSource, ...] = ()
    readiness: tuple[Readiness, ...] = ()  # where it says whether it can move; the first one that says no is told
    controllers: str = ""
    """The service that lists its controllers and their states (``list_controllers``); empty: there is none."""

    @cached_property
    def sinks_by_topic(self) -> Mapping[str, Sink]:
        """What is sent on each topic, in the first mode that uses it."""
        return {sink.topic: sink for sinks in reversed([*self.commands.values()]) for sink in reversed(sinks)}

    def command_life(self, period: float) -> float:
        """For how long a command means something to who sends one every `period` [s]: two periods at least."""
        # The robot would else rest in the middle of a slow task whenever the next command is a little late.
        return max(self.command_timeout, 2.0 * period)

    def source(self, signal: str) -> Source:
        """Where `signal` comes from."""
        return next(source for source in self.state if source.signal == signal)

    def signal(self, name: str) -> SignalSpec:
        """The signal called `name`."""
        return next(signal for signal in self.signals if signal.name == name)

    def camera(self, name: str) -> CameraSource:
        """The camera called `name`; `UnknownName` if there is none."""
        cameras = {camera.name: camera for camera in self.cameras}
        if name not in cameras:
            raise UnknownName(f"camera of {self.name}", name, cameras)
        return cameras[name]

    def sinks(self, mode: str | None = None) -> tuple[Sink, ...]:
        """Where the parts of a command go; `mode` None is the default one. `UnknownName` if there is no such mode."""
        if mode is None:
            return next(iter(self.commands.values()))
        if mode not in self.commands:
            raise UnknownName(f"command mode of {self.name}", mode, self.commands)
        return self.commands[mode]

    def narrowed(self, labels: tuple[str, ...], mode: str | None = None) -> "RobotProfile":
        """The same robot, for a task that commands only the numbers `labels`, in their order.

        Sinks that take none of them are not in it: nothing is ever sent there. Nor are modes that would cut a message,
        and that is an `InvalidValue` for `mode` (None: the default one), as is a label that it does not take.
        """
        if labels == self.command.labels:
            return self
        if not labels or not set(labels) <= set(self.command.labels):
            expected, found = ", ".join(labels) or "nothing", ", ".join(self.command.labels)
            raise InvalidValue(f"Commands are {expected}, and {self.name} takes {found}. Choose another profile.")
        wanted = self.sinks(mode)
        for sink in wanted:
            if missing := _missing(sink, labels):
                taken, absent, alone = (", ".join(one) for one in (sink.labels, missing, labels))
                raise InvalidValue(
                    f"{sink.topic} takes {taken} in one message, and {absent} is not commanded. "
                    f"Give the profile of {self.name} a command mode with a topic for {alone} alone."
                )
        commands = {
            name: tuple(sink for sink in sinks if set(sink.labels) <= set(labels))
            for name, sinks in self.commands.items()
            if sinks is wanted or not any(_missing(sink, labels) for sink in sinks)
        }
        return dataclasses.replace(self, command=self.command.part(labels), commands=commands)

    def spec(self, wanted: RobotSpec | None = None, mode: str | None = None) -> RobotSpec:
        """What this robot measures and is sent; of it what a task has `wanted`, at its period, if that is given.

        `mode` and errors are as of `narrowed`; a signal that it does not measure is an `InvalidValue` too.
        """
        period = self.period if wanted is None else wanted.period
        # A trajectory that takes longer than a period is behind its commands for longer.
        reached = (sink.reach_at(period) for sink in self.sinks(mode) if sink.type == _TRAJECTORY)
        lag = _LAGS[self.kind] + max(0.0, max(reached, default=0.0) - period)
        if wanted is None:
            signals = tuple(signal for signal in self.signals if not self.source(signal.name).optional)
            return RobotSpec(self.name, signals, self.command, period, lag)
        known = {signal.name: signal for signal in self.signals}
        for signal in wanted.signals:
            if signal.name not in known:
                raise InvalidValue(
                    f"{signal.name} is needed, and {self.name} measures only {', '.join(known)}. "
                    f"Give its profile a [[state]] table for it."
                )
            if signal.labels != known[signal.name].labels:
                found = ", ".join(known[signal.name].labels)
                raise InvalidValue(f"{signal.name} must be {', '.join(signal.labels)}; that of {self.name} is {found}.")
        signals = tuple(known[signal.name] for signal in wanted.signals)
        command = self.narrowed(wanted.command.labels, mode).command
        return RobotSpec(self.name, signals, command, period, lag)


def _missing(sink: Sink, labels: tuple[str, ...]) -> list[str]:
    """What `sink` needs beside `labels`; nothing where it takes none of them."""
    missing = [label for label in sink.labels if label not in labels]
    return missing if len(missing) < len(sink.labels) else []
