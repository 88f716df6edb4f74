"""Old messages are refused: tags that say who sent what when, their check on the robot's side, and clock offsets.

A tag travels as text in a field that the message type has anyway: ``header.frame_id``, or the label of the first
dimension of a multi-array. It looks like ``bam1 s=4f1c e=2 q=17 t=1700000000.250000 d=1700000000.350000``.
"""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

from bam_envs.errors import RemoteError

_MARK = "bam1"
_MOST_SESSIONS = 1024
_LONGEST = 256  # characters of a tag: what is read is kept for a while


@dataclass(frozen=True)
class Tag:
    """Who sent a message, and for how long it means anything."""

    session: str
    """One client, from its start to its end; without blanks."""
    epoch: int
    """Counts the connections of the session."""
    sequence: int
    """Counts its messages over all epochs."""
    sent: float
    """When it was sent [s], on the sender's steady clock (any zero: the receiver works out the offset)."""
    deadline: float
    """From when on it must not be executed [s], same clock."""

    def to_text(self) -> str:
        """As it travels."""
        return self._text

    @cached_property
    def _text(self) -> str:
        return f"{_MARK} s={self.session} e={self.epoch} q={self.sequence} t={self.sent:.6f} d={self.deadline:.6f}"


def read_tag(text: object) -> Tag | None:
    """The tag that `text` is, or None for anything else: other people's messages have none."""
    if not isinstance(text, str) or len(text) > _LONGEST or not text.startswith(_MARK + " "):
        return None
    return _read_tag(text)


@lru_cache(maxsize=64)  # every message of a command has the same one
def _read_tag(text: str) -> Tag | None:
    fields = dict(part.split("=", 1) for part in text.split()[1:] if "=" in part)
    try:
        tag = Tag(fields["s"], int(fields["e"]), int(fields["q"]), float(fields["t"]), float(fields["d"]))
    except (KeyError, ValueError):
        return None
    return tag if math.isfinite(tag.sent) and math.isfinite(tag.deadline) else None


class Tagger:
    """Makes the tags of one session.

    Args:
        clock: Steady clock [s]: a step of the wall clock must not make commands old.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.session = uuid.uuid4().hex[:12]
        self._clock, self._sequence, self._lock = clock, 0, threading.Lock()

    def next(self, epoch: int, lifetime: float) -> Tag:
        """A new tag, for a message that means something for `lifetime` [s]."""
        with self._lock:
            self._sequence += 1
            now = self._clock()
            return Tag(self.session, epoch, self._sequence, now, now + lifetime)


class ClockOffset:
    """How far a clock over there is ahead of ours, from one-way messages: the quickest one was about instant.

    It is the smallest difference seen, so a message's age is how much longer it took than the quickest; a drift of
    the clocks is followed by forgetting the smallest slowly (`drift`).
    """

    def __init__(self, drift: float = 1e-4) -> None:
        self.drift = drift
        """Largest drift between two clocks [s/s]."""
        self.offset: float | None = None
        """Our clock minus theirs [s]; None before the first message."""
        self._at = 0.0

    def age(self, sent: float, arrived: float) -> float:
        """Age [s] of a message at its arrival; `sent` on their clock, `arrived` on ours."""
        difference = arrived - sent
        if self.offset is not None:
            self.offset += self.drift * max(0.0, arrived - self._at)
        if self.offset is None or difference < self.offset:
            self.offset = difference
        self._at = arrived
        return difference - self.offset


class FreshnessCheck:
    """The robot's side: refuses what is old, whatever a bridge kept in its queues.

    Args:
        clock: Steady clock [s]: a step of the wall clock must not make commands old.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._sessions: OrderedDict[str, tuple[ClockOffset, dict[str, tuple[int, int]]]] = OrderedDict()

    def require(self, tag: Tag, channel: str = "") -> None:
        """Take note of a message of `channel`.

        Raises:
            RemoteError: It is of an old connection, not newer than one before it, or too late.
        """
        with self._lock:
            offset, latest = self._session(tag.session)
            epoch, sequence = latest.get(channel, (0, 0))
            now = self._clock()
            late = offset.age(tag.sent, now) - (tag.deadline - tag.sent)
            newest = max(latest.values(), default=(0, 0))[0]
            if tag.epoch < newest:
                raise RemoteError(f"old connection: epoch {tag.epoch}, and epoch {newest} is there")
            if tag.sequence <= sequence:
                raise RemoteError(f"old message: number {tag.sequence} after number {sequence}")
            latest[channel] = (max(epoch, tag.epoch), tag.sequence)
            if late > 0:
                raise RemoteError(f"expired: {late:.3f} s after its deadline")

    def _session(self, name: str) -> tuple[ClockOffset, dict[str, tuple[int, int]]]:
        if name not in self._sessions:
            self._sessions[name] = (ClockOffset(), {})
            if len(self._sessions) > _MOST_SESSIONS:
                self._sessions.popitem(last=False)
        self._sessions.move_to_end(name)
        return self._sessions[name]
