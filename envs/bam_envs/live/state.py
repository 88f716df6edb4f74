"""The newest messages of a live robot as its state, and the age of that state.

The network thread only puts messages into a `Mailbox`; the thread that drives the robot decodes them.

The age of a message is the greater of two: since its arrival, and by its stamp. The clock of the stamps may differ from
the local one: the offset comes from the server's clock if the link knows it, and from the message with the least delay.
"""

import math
import threading
import time
from collections import defaultdict
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
SIMULATED_BEFORE = 1e8
"""An earlier stamp [s since 1970] comes from a simulator's clock, which may have any speed but must advance."""
_OTHER_CLOCK = 60.0
"""A stamp farther than this [s] from the server's clock comes from a clock that was never set."""


@dataclass(frozen=True)
class Letter:
    """A message that arrived."""

    message: Any
    """As it arrived, unchecked."""
    arrived: float
    """When it arrived [s], local monotonic clock."""
    number: int
    """Position among the messages of its slot, from 1."""


class Mailbox:
    """The newest message of each signal or topic, by name, for threads that read or wait.

    Args:
        clock: Monotonic [s].
        keeps_all: Whether older messages are kept too.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, *, keeps_all: bool = False) -> None:
        self._clock, self._changed = clock, threading.Condition()
        self._slots: dict[str, Letter] = {}
        self._keeps_all = keeps_all
        self.letters: defaultdict[str, list[Letter]] = defaultdict(list)
        """All messages of each slot, in order, with `keeps_all`."""

    def listener(self, name: str) -> Listener:
        """A listener that puts messages into the slot `name`."""
        return lambda message, caller: self.put([name], message)

    def put(self, names: Iterable[str], message: Any) -> None:
        """Replace the content of the slots `names` by `message`, which arrives now."""
        with self._changed:
            arrived = self._clock()
            for name in names:
                before = self._slots.get(name)
                self._slots[name] = letter = Letter(message, arrived, 1 if before is None else before.number + 1)
                if self._keeps_all:
                    self.letters[name].append(letter)
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
        """Let waiting threads check their conditions again."""
        with self._changed:
            self._changed.notify_all()

    def wait_for(self, ready: Callable[[dict[str, Letter]], bool], timeout: float) -> bool:
        """Wait until `ready` is true of the slots, at most `timeout` [s]; False if it did not become true."""
        with self._changed:
            return self._changed.wait_for(lambda: ready(self._slots), timeout)


class SourceAge:
    """Stamp, tag and age of the newest message of one topic.

    `wall_ahead` is the local wall clock minus the local monotonic clock [s].
    """

    def __init__(self, wall_ahead: float) -> None:
        self.stamp: float | None = None
        """Time of the measurement by the sender's clock [s]; None without a stamp, and before the first message."""
        self.tag: object = None
        """Tag with the command that it answers; see `bam_envs.ros.freshness.read_echo`."""
        self._quickest, self._wall_ahead = ClockOffset(), wall_ahead
        self.number = 0
        """Number of the newest letter that was read; 0 before the first."""
        self._newest, self._measured = -math.inf, -math.inf

    def look(self, letter: Letter, where: str, server_offset: float | None) -> None:
        """Read stamp and tag of a message of the topic `where`, if it is new; `ProtocolError` for a wrong stamp.

        `server_offset` is the local wall clock minus the server's [s]; None if it is not known.
        """
        if letter.number == self.number:
            return
        message, arrived = require_message(letter.message, where), letter.arrived
        stamp = read_stamp(message, where)
        if stamp is None:
            self._measured = arrived
        elif stamp != self._newest:  # a repeated stamp is stale, however many messages repeat it
            delay = 0.0
            if stamp >= SIMULATED_BEFORE:
                delay = self._quickest.age(stamp, arrived)
                absolute = math.inf if server_offset is None else arrived + self._wall_ahead - stamp - server_offset
                if abs(absolute) < _OTHER_CLOCK:
                    delay = max(delay, absolute)
            self._newest, self._measured = stamp, arrived - delay
        self.stamp, self.tag, self.number = stamp, tag_text(message), letter.number

    def at(self, now: float) -> float:
        """Age [s] at `now`, local monotonic clock; infinite before the first message."""
        return now - self._measured


def concerns(source: Source, message: Any) -> bool:
    """Whether a message of the topic of `source` is about it.

    On a shared topic the names identify the source of a message; a malformed one counts for every source.
    """
    names: Any = message.get("name") if isinstance(message, Mapping) else None
    return not (source.partial and isinstance(names, Sequence)) or any(name in source.names for name in names)


class LiveState:
    """Listens to the sources of the signals in `spec`, and decodes in the calling thread."""

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
        """The local wall clock minus the server's [s], or None."""
        self._clock, self._wall = clock, wall
        self._sizes = {signal.name: len(signal.labels) for signal in spec.signals}
        self._heads: dict[tuple[str, tuple[str, ...]], Source] = {}  # the first signal of each message
        self._extra: dict[str, float] = {}  # how much older than `max_age` these messages may be [s]
        for source in self.sources:
            head = self._heads.setdefault((source.topic, source.names), source).signal
            more = max(0.0, (source.max_age or profile.max_age) - profile.max_age)
            self._extra[head] = min(self._extra.get(head, more), more)
        self.forget_ages()

    def forget_ages(self) -> None:
        """Forget ages: another connection may lead to other clocks."""
        ahead = self._wall() - self._clock()
        self._ages = {head.signal: SourceAge(ahead) for head in self._heads.values()}

    def listener(self, topic: str) -> Listener:
        """The listener for messages of `topic`."""
        sources = [source for source in self.sources if source.topic == topic]

        def listen(message: Message, caller: Caller) -> None:
            self.mailbox.put([source.signal for source in sources if concerns(source, message)], message)

        return listen

    def read(self) -> tuple[dict[str, Array], float]:
        """The newest values [SI] of each signal, shape (1, k), and the stamp of the first source that has one [s].

        Without any stamp, the arrival of the newest message replaces it. `StaleState` if a signal has no message.
        """
        letters = self.mailbox.newest()
        for source in self.sources:
            if source.signal not in letters:
                raise StaleState(f"{source.topic} ({source.type}): no message yet.")
        self._look(letters)
        signals = {
            source.signal: decode_source(source, letters[source.signal].message, self._sizes[source.signal])[None]
            for source in self.sources
        }
        stamps = [self._ages[head.signal].stamp for head in self._heads.values()]
        arrived = max(letter.arrived for letter in letters.values())
        return signals, next((stamp for stamp in stamps if stamp is not None), arrived)

    def age(self) -> float:
        """Age of the state [s]: of its oldest source, less the extra age that the profile allows that source."""
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

        True if that happened, or `stop` became true, within `timeout` [s]; `Mailbox.wake` triggers a check of `stop`.
        """

        def is_answered(letters: Mapping[str, Letter]) -> bool:
            if stop():
                return True
            if len(letters) < len(self.sources):
                return False
            self._look(letters)
            answers = [age.stamp or 0.0 for age in self._ages.values() if age.tag == tag]
            stamps = [age.stamp for age in self._ages.values() if age.stamp is not None]
            return bool(answers) and all(stamp >= answers[0] for stamp in stamps)

        return self.mailbox.wait_for(is_answered, timeout)

    def _look(self, letters: Mapping[str, Letter]) -> None:
        for source in self._heads.values():
            letter, age = letters[source.signal], self._ages[source.signal]
            if letter.number != age.number:
                age.look(letter, source.topic, self.server_offset())
