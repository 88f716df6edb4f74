"""The tables of a robot profile: sources of its signals, sinks of its commands, cameras, ages and limits."""

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, get_args

from msgspec import Meta

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import BaseBody, RobotSpec, SignalSpec
from bam_envs.core.validation import Finite, NonEmpty, NonNegativeInt, Positive, RobotName, check

Topic = Annotated[str, Meta(pattern=r"^(/[A-Za-z]\w*)+\Z", description="an absolute name such as /joint_states")]
"""A topic, action or service without its namespace."""
MessageType = Annotated[
    str,
    Meta(
        pattern=r"^[A-Za-z]\w*/((msg|action|srv)/)?[A-Za-z]\w*\Z",
        description="a message type such as sensor_msgs/JointState",
    ),
]
Answer = Finite | bool | str
"""A value in a message that tells whether something succeeded, or whether a robot can move."""
ImageType = Literal["sensor_msgs/CompressedImage", "sensor_msgs/Image"]
"""Message type of a camera: JPEG or PNG, or raw pixels, both over a separate CBOR connection."""
IMAGE_TYPES = get_args(ImageType)
_TRAJECTORY, _TWIST = "trajectory_msgs/JointTrajectory", "geometry_msgs/Twist"
SPLINE_PERIODS, _SPLINE_DELAY = 2.0, 0.75
"""Periods from which on a trajectory's point is reached at rest, and the delay of such a motion as a share of its time:
it has gone half of the way in half of the time, and begins before it has come to rest (`benchmarks jerk`)."""
_LAGS = {"arm": 0.1, "base": 0.3}
"""Delay of live robots behind their commands [s], of network and controller; the limit `lag` overrides it."""


@dataclass(frozen=True, kw_only=True)
class Content:
    """The location of numbers in the messages of a topic."""

    topic: Topic
    type: MessageType
    """Type of the message, goal or request, ``pkg/Type``; a stamped message (``pkg/TypeStamped``) is read too."""
    fields: tuple[NonEmpty, ...] = ()
    """Path of each number, e.g. ``pose.position.x``; ``command.position[0]`` is the first of a list, and
    ``yaw(orientation)`` the angle about z of a quaternion."""
    names: tuple[NonEmpty, ...] = ()
    """The robot's names of the numbers, in the order of the labels; messages may have another order. Empty: the numbers
    of a source have no names, those of a sink have the names of its labels."""
    scale: tuple[Finite, ...] = (1.0,)
    """SI value = number x scale + offset; one for all, or one for each."""
    offset: tuple[Finite, ...] = (0.0,)
    """See `scale`."""


@dataclass(frozen=True, kw_only=True)
class Source(Content):
    """The source of the numbers of one signal."""

    signal: NonEmpty
    """Name of the signal."""
    field: NonEmpty = ""
    """Path of the list of its numbers, e.g. ``position``; or `fields`."""
    ignore: tuple[NonEmpty, ...] = ()
    """Other names that messages may have, beside those of other sources of the topic."""
    partial: bool = False
    """Whether several publishers share the topic, so that messages without any of `names` are ignored."""
    skip: tuple[NonNegativeInt, NonNegativeInt] = (0, 0)
    """Number of values of `field` to leave out at the beginning and at the end."""
    missing: Finite | None = None
    """Value for null, NaN and infinities in `field`; None: they are errors."""
    within: tuple[Finite, Finite] | None = None
    """Least and greatest of its numbers, before `scale`; others are clipped. None: no clipping."""
    frame: NonEmpty = ""
    """Frame that ``header.frame_id`` must name, or the message is refused; empty: any frame."""
    max_age: Positive | None = None
    """Maximum age [s]; None: the profile's."""
    optional: bool = False
    """Whether it is subscribed only if a task needs it."""
    constants: Mapping[str, Finite] = dataclasses.field(default_factory=dict)
    """Further fields of the message that a simulated robot sends."""


@dataclass(frozen=True, kw_only=True)
class Closing:
    """The action by which a gripper closes, if it opens by another one; its goals have the same `fields`."""

    action: Topic
    type: MessageType
    constants: Mapping[str, Answer] = dataclasses.field(default_factory=dict)
    """See `Sink.constants`."""


@dataclass(frozen=True, kw_only=True)
class Sink(Content):
    """Where some of the numbers of a command are sent: to a topic, or as goals of an action or requests of a service.

    The last two get a number only when it changes, and wait for no answer within a period.
    """

    topic: Topic = ""
    """The topic; or `action`, or `service`."""
    action: Topic = ""
    """The action; a new goal replaces the one that runs, and a halt cancels it."""
    service: Topic = ""
    """The service."""
    constants: Mapping[str, Answer] = dataclasses.field(default_factory=dict)
    """Other fields of each message, goal or request, by their paths, e.g. ``command.max_effort``."""
    closing: Closing | None = None
    """Another action for a width below half of its range."""
    labels: tuple[NonEmpty, ...]
    """Labels of its numbers in the command, in the order of the message."""
    reach: Positive | None = None
    """Time in which a trajectory's point is to be reached [s]; None: `reach_periods`."""
    reach_periods: Positive = 1.0
    """The same in periods of the task; above 1 an arm does not stop when the next command is late. From 2 on the point
    is reached at rest, to which a controller goes along a cubic spline, without jumps of the speed."""
    rate: Positive | None = None
    """Rate of a controller that holds its set points [Hz]: it gets some between two commands, on a spline over two
    periods. None: it gets the commands alone."""
    hold: Literal["measured", "last", "zero"] = "measured"
    """Command of a halt: the measured position, the last command, or zeros."""
    tag: bool = True
    """Whether the message has a tag with its sender and time, if its type has room for a text: ``header.frame_id``, or
    the label of an array's first dimension."""
    controller: NonEmpty = ""
    """The controller of ros2_control that takes it, which must be active; not checked if empty, or if the topic is
    renamed."""

    @property
    def address(self) -> str:
        """The topic, action or service."""
        return self.topic or self.action or self.service

    @property
    def forms(self) -> tuple["Sink", ...]:
        """The sink, and the one with the action `closing` if it has that."""
        if self.closing is None:
            return (self,)
        return self, dataclasses.replace(self, **vars(self.closing), closing=None)

    def of_type(self, kind: str) -> "Sink | None":
        """The sink with messages of type ``pkg/Type``: its own, or a Twist with a stamp instead of without, or without.

        Drives took a Twist before ROS 2 Jazzy, and take a TwistStamped since, under the same name. None for any other.
        """
        if kind == self.type:
            return self
        if {kind, self.type} != {_TWIST, f"{_TWIST}Stamped"}:
            return None
        stamped = kind != _TWIST
        fields = [f"twist.{path}" if stamped else path.removeprefix("twist.") for path in self.fields]
        return dataclasses.replace(self, type=kind, fields=tuple(fields))

    @property
    def is_timed(self) -> bool:
        """Whether its messages say in which time a position is to be reached; others are executed at once."""
        return self.type == _TRAJECTORY

    @property
    def is_named(self) -> bool:
        """Whether its messages, or its topic, tell which number is whose; others depend on an order."""
        return self.type in (_TRAJECTORY, "sensor_msgs/JointState") or len(self.labels) == 1

    def reach_at(self, period: float) -> float:
        """Time in which a trajectory's point is to be reached [s], for a command every `period` [s]."""
        return period * self.reach_periods if self.reach is None else self.reach

    def is_spline(self, period: float) -> bool:
        """Whether a trajectory's point is reached at rest, for a command every `period` [s]."""
        return self.reach_at(period) >= SPLINE_PERIODS * period

    def delay_at(self, period: float) -> float:
        """Delay of the set points behind the commands [s]."""
        if not self.is_timed:
            return 0.0 if self.rate is None else SPLINE_PERIODS * _SPLINE_DELAY * period
        return self.reach_at(period) * (_SPLINE_DELAY if self.is_spline(period) else 1.0)


@dataclass(frozen=True)
class Readiness:
    """A topic on which a robot reports whether it can move; optional."""

    topic: Topic
    type: MessageType
    field: tuple[NonEmpty, ...]
    """Path of the value, e.g. ``mode``; the first of several paths that the message has."""
    ready: tuple[Answer, ...] = ()
    """The values with which it can move; or `at_least`."""
    at_least: Finite | None = None
    """The least number with which it can begin to move."""
    words: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Meanings of other values, e.g. ``3 = "protective stop"``."""
    otherwise: NonEmpty = ""
    """Meaning of all further values; ``{}`` stands for the value. Empty: the value itself is reported."""
    remedy: NonEmpty = ""
    """How people bring it into a state in which it can move, in one line; `remedies` has those of single values."""
    remedies: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """The same for single values, as in `words`."""

    def value(self, message: Any) -> Any:
        """The value in `message`; None if it has none."""
        return next((value for path in self.field if (value := _value_in(message, path)) is not None), None)

    def trouble(self, message: Any) -> str | None:
        """Why the robot cannot move according to `message`, and its remedy; None if it can, or there is no value."""
        value = self.value(message)
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        enough = self.at_least is not None and not (number and value < self.at_least)
        if value is None or value in self.ready or enough:
            return None
        text = _text(value)
        remedy = self.remedies.get(text) or self.remedy
        what = self.words.get(text) or self.otherwise.replace("{}", text) or f"{self.field[0]} is {text}"
        return f"{what} ({self.topic}){remedy and f': {remedy}'}"


def _text(value: Any) -> str:
    """A value of a message as people write it."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return f"{value:g}"
    return "missing" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _value_in(message: Any, path: str) -> Any:
    """The value at `path` in a message; None if it has none."""
    for name in path.split("."):
        message = message.get(name) if isinstance(message, Mapping) else None
    return message


@dataclass(frozen=True, kw_only=True)
class Enable:
    """A service that is called before a robot takes commands, with the operator's consent."""

    service: Topic
    type: MessageType
    """Type of the service."""
    does: NonEmpty
    """What it does, for the operator, e.g. ``enables the motors``."""
    request: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The request."""
    field: NonEmpty = "success"
    """Path of the value in the response that tells whether it succeeded."""
    ready: tuple[Answer, ...] = (True,)
    """The values that mean success."""

    def trouble(self, response: Any) -> str | None:
        """Why `response` is not that of a success; None if it is."""
        value = _value_in(response, self.field)
        if value in self.ready:
            return None
        said = _value_in(response, "message")
        expected = " or ".join(map(_text, self.ready))
        return f"{self.field} is {_text(value)}, not {expected}{f': {said}' if said else ''}"


@dataclass(frozen=True)
class IdentitySource:
    """Where a robot tells its serial number or its name: a service, or a topic that repeats it. Nothing needs it."""

    field: NonEmpty
    """Path of it in the response, or in the message."""
    service: Topic = ""
    """The service; or `topic`."""
    request: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The request of the service."""
    topic: Topic = ""
    """The topic; or `service`."""
    type: MessageType = ""
    """Message type of the topic."""
    pattern: NonEmpty = ".*"
    """Regular expression that the whole of it must match; other text, such as that of an error, is ignored."""

    def identity(self, message: Any) -> str:
        """What `message` says; empty if it says nothing that can name a robot."""
        value = _value_in(message, self.field)
        text = str(value).strip() if isinstance(value, (str, int)) else ""
        if re.fullmatch(self.pattern, text) is None:
            return ""
        try:
            return str(check(text, RobotName, self.field))
        except InvalidValue:
            return ""


@dataclass(frozen=True)
class CameraSource:
    """A camera."""

    name: NonEmpty
    """Name of the camera."""
    topic: Topic
    type: MessageType = "sensor_msgs/CompressedImage"
    """One of `IMAGE_TYPES`."""
    max_age: Positive = 0.5
    """Maximum age of an image [s]."""
    optional: bool = False
    """Whether it is subscribed only if a task needs it."""


@dataclass(frozen=True)
class RobotProfile:
    """The description of a live robot in one file."""

    name: str
    kind: Literal["arm", "base"]  # what moves
    signals: tuple[SignalSpec, ...]  # every signal that has a source
    command: SignalSpec
    state: tuple[Source, ...]  # one source for each of `signals`, in their order
    commands: Mapping[str, tuple[Sink, ...]]
    """Modes in which a command is sent, by name, the default first. The last sink of a mode is a topic, and completes a
    command."""
    period: float  # time between two commands [s]
    max_age: float  # maximum age of a state [s]
    command_timeout: float  # time for which a command is valid [s]; see `command_life`
    limits: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Limits of the guards that differ from their defaults, by their names in `bam_envs.safety.guards`."""
    cameras: tuple[CameraSource, ...] = ()
    readiness: tuple[Readiness, ...] = ()  # topics that report whether it can move
    identity: tuple[IdentitySource, ...] = ()  # where it tells which robot it is; the first that answers counts
    enable: tuple[Enable, ...] = ()  # services to be called before it takes commands, in this order
    controllers: str = ""
    """The service that lists its controllers and their states (``list_controllers``); empty: there is none."""
    robot: str = ""  # the robot that it is for, if it is a described one
    watchdog: float | None = None
    """Time after which it stops by itself without a command [s]; 0: it does not; None: that is not known."""
    body: BaseBody | None = None
    """Shape and laser scanners of a base, if they are known."""

    @cached_property
    def sinks_by_address(self) -> Mapping[str, Sink]:
        """The sink of each topic, action and service, in the first mode that uses it."""
        modes = reversed([*self.commands.values()])
        return {one.address: one for sinks in modes for sink in reversed(sinks) for one in reversed(sink.forms)}

    def command_life(self, period: float) -> float:
        """Time for which a command is valid [s], for one command every `period` [s]: two periods at least."""
        # Otherwise the robot would rest in the middle of a slow task whenever the next command is slightly late.
        return max(self.command_timeout, 2.0 * period)

    def source(self, signal: str) -> Source:
        """The source of `signal`."""
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
        """The sinks of a command; `mode` None is the default one. `UnknownName` if there is no such mode."""
        if mode is None:
            return next(iter(self.commands.values()))
        if mode not in self.commands:
            raise UnknownName(f"command mode of {self.name}", mode, self.commands)
        return self.commands[mode]

    def narrowed(self, labels: tuple[str, ...], mode: str | None = None) -> "RobotProfile":
        """The same robot, for a task that commands only the numbers `labels`, in their order.

        It lacks the sinks that take none of them, and the modes that would split a message. `InvalidValue` if `mode`
        (None: the default one) would split a message, or for an unknown label.
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
                    f"{sink.address} takes {taken} in one message, and {absent} is not commanded. "
                    f"Give the profile of {self.name} a command mode with a topic for {alone} alone."
                )
        commands = {
            name: tuple(sink for sink in sinks if set(sink.labels) <= set(labels))
            for name, sinks in self.commands.items()
            if sinks is wanted or not any(_missing(sink, labels) for sink in sinks)
        }
        return dataclasses.replace(self, command=self.command.part(labels), commands=commands)

    def spec(self, wanted: RobotSpec | None = None, mode: str | None = None) -> RobotSpec:
        """The spec of this robot; with `wanted`, only the signals, command and period of that spec.

        What goes to an action or a service has no `max_rate`: it gets the end of a motion, whose speed is its own.

        For `mode` and errors see `narrowed`; `InvalidValue` also for a signal that it does not measure, `UnknownName`
        for images of a camera that it does not have.
        """
        period = self.period if wanted is None else wanted.period
        # A trajectory that takes longer than a period adds to the lag.
        reached = (sink.delay_at(period) for sink in self.sinks(mode))
        lag = _LAGS[self.kind] + max(0.0, max(reached, default=0.0) - period)
        joints = {at for at, unit in zip(self.command.labels, self.command.units, strict=True) if unit == "rad"}
        is_timed = all(sink.is_timed for sink in self.sinks(mode) if joints & set(sink.labels))
        if wanted is None:
            signals = tuple(signal for signal in self.signals if not self.source(signal.name).optional)
            command = self._at_own_speed(self.command, mode)
            return RobotSpec(self.name, signals, command, period, lag, self.body, is_timed=is_timed)
        for name in (name for camera in wanted.cameras for name in camera.spaces()):
            self.camera(name)
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
        command = self._at_own_speed(self.narrowed(wanted.command.labels, mode).command, mode)
        return RobotSpec(self.name, signals, command, period, lag, self.body, wanted.cameras, is_timed)

    def _at_own_speed(self, command: SignalSpec, mode: str | None) -> SignalSpec:
        if command.max_rate is None:
            return command
        own = {label for sink in self.sinks(mode) if not sink.topic for label in sink.labels}
        rates = zip(command.labels, command.max_rate, strict=True)
        return dataclasses.replace(command, max_rate=tuple(math.inf if at in own else rate for at, rate in rates))


def _missing(sink: Sink, labels: tuple[str, ...]) -> list[str]:
    """The labels of `sink` that are not in `labels`; empty if it takes none of them."""
    missing = [label for label in sink.labels if label not in labels]
    return missing if len(missing) < len(sink.labels) else []
