"""The newest messages of a live robot as its state, and how old that state is.

The network thread does nothing but put messages into a `Mailbox`; the thread that drives the robot decodes them.

The age of a message is judged twice, since its arrival and by its stamp, and the greater age counts. The clock of the
stamps may differ from ours: the offset comes from the server's clock if the link knows it, and from the message that
took the least time.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import StaleState
from bam_envs.core.robot import RobotSpec
from bam_envs.ros.codec import decode_source
from bam_envs.ros.freshness import ClockOffset, read_echo
from bam_envs.ros.messages import read_stamp, require_message, tag_text
from bam_envs.ros.profile_tables import RobotProfile, Source
from bam_envs.rosbridge.bus import Caller, Listener, Message

Array = NDArray[np.float64]
_SIMULATED_BEFORE = 1e8
"""An earlier stamp [s since 1970] comes from a simulator's clock, of any speed: it only has to go on."""
_OTHER_CLOCK = 60.0
"""A stamp farther than this [s] from the server's clock comes from a clock that nobody set."""


@dataclass(frozen=True)
class Letter:
    """A message that arrived."""

    message: Any
    """As it arrived, unchecked."""
    arrived: float
    """When it arrived [s], our monotonic clock."""
    number: int
    """Counts the messages of its slot, from 1."""


class Mailbox:
    """The newest message of each signal, by name, for threads that look or wait.

    Args:
        clock: Monotonic clock [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._changed = clock, threading.Condition()
        self._slots: dict[str, Letter] = {}

    def put(self, names: Iterable[str], message: Any) -> None:
        """Replace what is in the slots `names` by `message`, which arrives now."""
        with self._changed:
            arrived = self._clock()
            for name in names:
                before = self._slots.get(name)
                self._slots[name] = Letter(message, arrived, 1 if before is None else before.number + 1)
            self._changed.notify_all()

    def newest(self) -> dict[str, Letter]:
        """The filled slots."""
        with self._changed:
            return dict(self._slots)

    def clear(self) -> None:
        """Empty the slots."""
        with self._changed:
            self._slots.clear()
            self._changed.notify_all()

    def wake(self) -> None:
        """Let whoever waits check its condition again."""
        with self._changed:
            self._changed.notify_all()

    def wait_for(self, ready: Callable[[dict[str, Letter]], bool], timeout: float) -> bool:
        """Wait until `ready` is true of the slots, at most `timeout` [s]; whether it became true."""
        with self._changed:
            return self._changed.wait_for(lambda: ready(self._slots), timeout)


class SourceAge:
    """How old the newest message of one topic is.

    Args:
        wall_ahead: Our wall clock minus our monotonic one [s].
    """

    def __init__(self, wall_ahead: float) -> None:
        self._quickest, self._wall_ahead = ClockOffset(), wall_ahead
        self._stamp = -math.inf
        self._measured = -math.inf

    def look(self, arrived: float, stamp: float | None, server_offset: float | None) -> None:
        """Note a message.

        Args:
            arrived: When it arrived [s], our monotonic clock.
            stamp: When it was measured, as it says [s]; None without a stamp.
            server_offset: Our wall clock minus the server's [s]; None if it is not known.
        """
        if stamp is None:
            self._measured = arrived
        elif stamp != self._stamp:  # a stamp that stands still is stale, however many messages repeat it
            self._stamp, self._measured = stamp, arrived - self._delay(arrived, stamp, server_offset)

    def _delay(self, arrived: float, stamp: float, server_offset: float | None) -> float:
        """How long the message took to arrive [s]."""
        if stamp < _SIMULATED_BEFORE:
            return 0.0
        delay = self._quickest.age(stamp, arrived)
        if server_offset is None:
            return delay
        absolute = arrived + self._wall_ahead - stamp - server_offset
        return max(delay, absolute) if abs(absolute) < _OTHER_CLOCK else delay

    def at(self, now: float) -> float:
        """Age [s] at `now`, our monotonic clock; infinite if nothing came."""
        return now - self._measured


@dataclass(frozen=True)
class _Seen:
    """What was read from the newest message of a topic."""

    number: int
    stamped: bool
    stamp: float
    tag: object


class LiveState:
    """Listens to the sources of a robot's signals, and decodes in the calling thread.

    One thread may call it; `signals` may be called from any.

    Args:
        profile: The robot.
        spec: The signals to measure.
        clock: Monotonic clock [s].
        wall: Wall clock [s].
    """

    def __init__(
        self,
        profile: RobotProfile,
        spec: RobotSpec,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self.mailbox = Mailbox(clock)
        """Slots by signal."""
        self.sources = tuple(profile.source(signal.name) for signal in spec.signals)
        """Where each signal comes from, in the order of the spec."""
        self.server_offset: Callable[[], float | None] = lambda: None
        """Our wall clock minus the server's [s], where it is known."""
        self._clock, self._wall = clock, wall
        self._sizes = {signal.name: len(signal.labels) for signal in spec.signals}
        self._heads = {(source.topic, source.names): source for source in reversed(self.sources)}
        self._extra = self._allowed_extra(profile)
        self._ages: dict[str, SourceAge] = {}
        self._seen: dict[str, _Seen] = {}

    def _allowed_extra(self, profile: RobotProfile) -> dict[str, float]:
        """How much older than `max_age` the messages of each head may be [s]."""
        extra: dict[str, float] = {}
        for source in self.sources:
            head = self._heads[source.topic, source.names].signal
            more = max(0.0, profile.age_limit(source) - profile.max_age)
            extra[head] = min(extra.get(head, more), more)
        return extra

    @property
    def topics(self) -> dict[str, str]:
        """Topic -> type."""
        return {source.topic: source.type for source in self.sources}

    def listener(self, topic: str) -> Listener:
        """The listener to subscribe `topic` with."""
        mine = [source for source in self.sources if source.topic == topic]
        always = [source.signal for source in mine if not source.partial]
        shared = [source for source in mine if source.partial]

        def listen(message: Message, caller: Caller) -> None:
            self.mailbox.put([*always, *(source.signal for source in shared if _is_ours(source, message))], message)

        return listen

    def restart(self) -> None:
        """Forget all messages and ages."""
        self.mailbox.clear()
        self.forget_ages()

    def forget_ages(self) -> None:
        """Forget ages: behind another connection there may be other clocks."""
        self._ages.clear()
        self._seen.clear()

    def silent(self) -> list[Source]:
        """Sources without a message."""
        letters = self.mailbox.newest()
        return [source for source in self.sources if source.signal not in letters]

    def read(self) -> tuple[dict[str, Array], float]:
        """The newest values [SI] of each signal, shape (1, k), and the stamp of the first source that has one [s].

        Raises:
            StaleState: A signal has no message.
            ProtocolError: A message is not what the profile says.
        """
        letters = self._letters()
        self._look(letters)
        return self._decode(letters), self._stamp(letters)

    def signals(self) -> dict[str, Array]:
        """As `read`, without the stamp. Any thread."""
        return self._decode(self._letters())

    def age(self) -> float:
        """Age of the state [s]: of its oldest source, less the extra age that the profile allows that source.

        Raises:
            ProtocolError: A stamp cannot be read.
        """
        letters, now = self.mailbox.newest(), self._clock()
        if len(letters) < len(self.sources):
            return math.inf
        self._look(letters)
        return max(self._ages[head].at(now) - extra for head, extra in self._extra.items())

    def echo(self) -> tuple[str, int]:
        """Session and number of the command that the newest state answers; empty and 0 if it answers none."""
        echoes = (read_echo(tag_text(letter.message)) for letter in self.mailbox.newest().values())
        return next((one for one in echoes if one is not None), ("", 0))

    def await_answer(self, tag: str, stop: Callable[[], bool], timeout: float) -> bool:
        """Wait until the command with the echo `tag` is answered, and no source is older than the answer.

        Returns:
            Whether that happened within `timeout` [s], or `stop` became true; `Mailbox.wake` has it checked.
        """
        return self.mailbox.wait_for(lambda slots: stop() or self._is_answer(slots, tag), timeout)

    def _is_answer(self, letters: Mapping[str, Letter], tag: str) -> bool:
        if len(letters) < len(self.sources):
            return False
        self._look(letters)
        stamps = [seen.stamp for seen in self._seen.values() if seen.tag == tag]
        return bool(stamps) and all(seen.stamp >= stamps[0] for seen in self._seen.values() if seen.stamped)

    def _letters(self) -> dict[str, Letter]:
        letters = self.mailbox.newest()
        for source in self.sources:
            if source.signal not in letters:
                raise StaleState(f"{source.topic} ({source.type}): nothing came yet.")
        return letters

    def _decode(self, letters: Mapping[str, Letter]) -> dict[str, Array]:
        return {
            source.signal: decode_source(source, letters[source.signal].message, self._sizes[source.signal])[None]
            for source in self.sources
        }

    def _look(self, letters: Mapping[str, Letter]) -> None:
        """Read stamps and tags of the messages that are new."""
        for source in self._heads.values():
            letter, seen = letters[source.signal], self._seen.get(source.signal)
            if seen is None or seen.number != letter.number:
                message = require_message(letter.message, source.topic)
                stamp = read_stamp(message, source.topic)
                self._seen[source.signal] = _Seen(letter.number, stamp is not None, stamp or 0.0, tag_text(message))
                self._age(source.signal).look(letter.arrived, stamp, self.server_offset())

    def _age(self, signal: str) -> SourceAge:
        if signal not in self._ages:
            self._ages[signal] = SourceAge(self._wall() - self._clock())
        return self._ages[signal]

    def _stamp(self, letters: Mapping[str, Letter]) -> float:
        """The stamp of the first source that has one, else the arrival of the newest message [s]."""
        heads = (self._heads[source.topic, source.names] for source in self.sources)
        stamps = (self._seen[head.signal] for head in heads)
        return next((seen.stamp for seen in stamps if seen.stamped), max(one.arrived for one in letters.values()))


def _is_ours(source: Source, message: Any) -> bool:
    """Whether a message of a shared topic comes from the publisher of `source`; a malformed one counts as such."""
    names = message.get("name") if isinstance(message, Mapping) else None
    return not isinstance(names, Sequence) or any(name in source.names for name in names)
