"""Bags of ROS 2 (rosbag2's MCAP files) as episodes: what a robot's topics said, sampled at an environment's rate.

The messages are read as those of a live robot are: by its profile, with the ages that it allows.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bam_envs.core.errors import MissingExtra, ProtocolError, StaleState
from bam_envs.core.robot import RobotSpec, RobotState
from bam_envs.live.camera import decode_pixels, fitted
from bam_envs.live.state import LiveState
from bam_envs.robots.profile import fitting_profile, profile_for
from bam_envs.ros.codec import decode_command
from bam_envs.ros.messages import bare_type
from bam_envs.ros.profile_tables import RobotProfile
from bam_envs.safety.guard import measured_places
from bam_train.data.record_dataset import info_of
from bam_train.data.recorded_episode import Array, DataSetInfo, Episode, nested
from bam_train.data.recordings import BAG
from bam_train.environments import make_env, require_env_kwargs
from bam_train.errors import FormatError
from bam_train.recording.recording import DAMAGE

ENV = "bam/joints-v0"
"""The environment of a bag's episodes: of a task's goals, a bag says nothing."""
_FIRST = np.zeros(1, np.int64)


def is_bag(source: Path) -> bool:
    """Whether it is an MCAP file, or a folder with some, that ROS wrote."""
    if source.is_dir():
        return (source / BAG).is_file()
    try:
        with source.open("rb") as file:
            return str(_reader(file).get_header().profile).startswith("ros")
    except (OSError, *DAMAGE):
        return False


def info_of_bag(env_kwargs: Mapping[str, Any]) -> DataSetInfo:
    """What all episodes of bags of an arm have in common; the arguments are those of `ENV`."""
    require_env_kwargs(ENV, env_kwargs)
    with closing(make_env(ENV, env_kwargs)) as env:
        return info_of(env, ENV, env_kwargs)


def episodes_of_bag(source: Path, info: DataSetInfo, profile: str | None = None) -> Iterator[tuple[Episode, str]]:
    """Each unbroken part of a bag, from its first command on, and what is odd about it.

    An action is the command that was in force a period later.

    Args:
        source: The file, or the folder of `ros2 bag record`.
        info: What `info_of_bag` gave.
        profile: Name or file of the profile; None: the one of the arm.

    Raises:
        FormatError: A topic is missing, or has no message; it is not encoded as ROS 2 does; the file is damaged.
        InvalidValue: The profile is that of another robot.
    """
    with closing(make_env(info.env, info.env_kwargs)) as env:
        inner: Any = env.unwrapped
        spec, task = inner.robot.spec, inner.task
        chosen = profile_for(spec) if profile is None else fitting_profile(profile, spec).narrowed(spec.command.labels)
        files = sorted(source.glob("*.mcap")) if source.is_dir() else [source]
        if not files:
            raise FormatError(f"{source}: has no .mcap file; make one: ros2 bag convert, with storage_id: mcap")
        parts = [part for file in files for part in _parts(file, chosen, spec)]
    for number, states in enumerate(parts):
        if len(states) > 1:
            yield _episode(source, info, task, chosen, number, states), ""


def _episode(
    source: Path,
    info: DataSetInfo,
    task: Any,
    profile: RobotProfile,
    number: int,
    states: list[tuple[float, RobotState]],
) -> Episode:
    (times, each), last = zip(*states, strict=True), len(states) - 1
    task.on_reset(_FIRST, each[0])
    seen = [task.observe(state) for state in each]
    leaves = info.observation_leaves
    observed = {leaf.column: np.concatenate([leaf.of(one) for one in seen]) for leaf in leaves}
    return Episode(
        nested(info.observation_space, observed, leaves),
        np.concatenate([task.action_for(after.command, state) for state, after in pairwise(each)]),
        np.zeros(last),
        terminated=False,
        truncated=True,
        columns={
            "time": np.array(times[:-1]),
            "stamp": np.concatenate([state.stamp for state in each[:-1]]),
            "command": np.concatenate([state.command for state in each[1:]]),
        },
        facts={
            "recording": source.name,
            "number": number,
            "robot": profile.name,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(times[0])),
        },
    )


def _parts(file: Path, profile: RobotProfile, spec: RobotSpec) -> list[list[tuple[float, RobotState]]]:
    """Wall clock [s] and state of each period, in unbroken parts; a state has the command in force."""
    now, due, parts = 0.0, None, [list[tuple[float, RobotState]]()]
    sampler = _Sampler(profile, spec, lambda: now)
    try:
        for at, topic, message in _messages(file, sampler.topics):
            while due is not None and due < at:
                now = due / 1e9
                state = sampler.look()
                if state is not None:
                    parts[-1].append((now, state))
                elif parts[-1]:
                    parts.append([])
                due += round(1e9 * spec.period)
            now = at / 1e9
            sampler.take(topic, message)
            due = at if due is None and sampler.is_commanded else due
    except ProtocolError as error:
        raise FormatError(f"{file}: {error}") from error
    missing = [topic for topic in sampler.needed if topic not in sampler.heard]
    if missing or not sampler.is_commanded:
        what = f"no message on {', '.join(missing)}" if missing else f"no command on {', '.join(sampler.sinks)}"
        text = f"{file}: has {what}, as the profile {profile.name} names it. It has {_offered(file)}"
        raise FormatError(f"{text}. Give its arm with --set robot_model=NAME, or its profile with --profile")
    return parts


class _Sampler:
    """The newest messages of a robot's topics as its state."""

    def __init__(self, profile: RobotProfile, spec: RobotSpec, clock: Any) -> None:
        self._profile, self._spec, self._clock = profile, spec, clock
        self._live = LiveState(profile, spec, clock, clock)
        self._listeners = {source.topic: self._live.listener(source.topic) for source in self._live.sources}
        boxes = {name: box for camera in spec.cameras for name, box in camera.spaces().items()}
        self._cameras = {profile.camera(name).topic: (profile.camera(name), box) for name, box in boxes.items()}
        self._images: dict[str, tuple[float, Any]] = {}
        self.sinks = [address for address, sink in profile.sinks_by_address.items() if sink.topic]
        """Topics of commands."""
        self.needed = [*self._listeners, *self._cameras]
        """Topics of states and images."""
        self.topics, self.heard = [*self.needed, *self.sinks], set[str]()
        self._command: Array = np.full(len(spec.command.labels), np.nan)
        self._measured = measured_places(spec, spec.command.units)

    @property
    def is_commanded(self) -> bool:
        """Whether there was a command."""
        return bool(np.isfinite(self._command).any())

    def take(self, topic: str, message: dict[str, Any]) -> None:
        """Take a message."""
        self.heard.add(topic)
        if topic in self._listeners:
            self._listeners[topic](message, None)  # type: ignore[arg-type]
        elif topic in self._cameras:
            self._images[topic] = self._clock(), message
        else:
            decoded = decode_command(self._profile, self._spec, topic, message)
            self._command[decoded.places] = decoded.values

    def look(self) -> RobotState | None:
        """The state now, with the command in force; None if a part of it is older than the profile allows."""
        try:
            signals, stamp = self._live.read()
        except StaleState:
            return None
        for topic, (camera, box) in self._cameras.items():
            came, message = self._images.get(topic, (-np.inf, None))
            if self._clock() - came > camera.max_age:
                return None
            signals[camera.name] = fitted(decode_pixels(message, topic), box)[None]
        if self._live.age() > self._profile.max_age:
            return None
        command = self._command.copy()
        for place, signal, column in self._measured:  # what nothing commanded stays as it is
            command[place] = signals[signal][0, column] if np.isnan(command[place]) else command[place]
        return RobotState(signals, np.array([stamp]), command[None])


def _messages(file: Path, topics: list[str]) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Time [ns], topic and content of the messages on `topics`, as they came."""
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        raise MissingExtra("mcap_ros2", "data", "Reading bags of ROS 2") from error
    factory = DecoderFactory()
    try:
        with file.open("rb") as stream:
            for schema, channel, message in _reader(stream).iter_messages(topics):
                decode = factory.decoder_for(channel.message_encoding, schema)
                if decode is None:
                    kind = "nothing" if schema is None else schema.encoding or "nothing"
                    text = f"{channel.topic} is {channel.message_encoding} by {kind}, expected cdr by ros2msg"
                    raise FormatError(f"{file}: {text}. Record it with ros2 bag record --storage mcap")
                yield message.log_time, channel.topic, _plain(decode(message.data))
    except FormatError:
        raise
    except (OSError, *DAMAGE) as error:
        text = f"{file}: is cut off or damaged. Save what is whole: mcap recover {file.name} -o whole.mcap"
        raise FormatError(text) from error


def _offered(file: Path) -> str:
    with file.open("rb") as stream:
        summary = _reader(stream).get_summary()
    channels = {} if summary is None else summary.channels
    rows = [f"{one.topic} ({bare_type(summary.schemas[one.schema_id].name)})" for one in channels.values()]
    return ", ".join(sorted(rows)) or "no topic"


def _reader(stream: Any) -> Any:
    from mcap.reader import make_reader

    return make_reader(stream, validate_crcs=True)


def _plain(value: Any) -> Any:
    """A message as rosbridge has it: objects as dicts, arrays as lists; bytes stay."""
    if hasattr(value, "__slots__") and hasattr(value, "__dict__"):
        return {name: _plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return list(value) if type(value).__name__ == "array" else value
