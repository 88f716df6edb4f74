"""Refuse old messages: tags with sender, number and time, their check on the robot's side, and clock offsets.

A tag is sent as text in an existing field of the message type: ``header.frame_id``, or the label of the first dimension
of a multi-array. It looks like ``bam1 s=4f1c e=2 q=17 t=1700000000.250000 d=1700000000.350000``. In an open session
(`bam_envs.rosbridge.sessions`) a signature follows, ``m=`` and 32 hexadecimal digits.
"""

import hmac
import math
import re
import threading
import time
import uuid
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

from bam_envs.core.errors import RemoteError

_MARK = "bam1"
_MOST_SESSIONS = 1024
_LONGEST = 256  # most characters of a tag, parts of which are kept


@dataclass(frozen=True)
class Tag:
    """Sender, number, time and deadline of a message."""

    session: str  # identifies one client from its start to its end; without blanks
    epoch: int  # number of the session's connection
    sequence: int  # number of the message, over all epochs
    sent: float  # time of sending [s], on the sender's steady clock; the receiver estimates the offset
    deadline: float  # time after which it must not be executed [s], same clock
    mac: str = ""  # the received signature; empty without one
    received: str = field(default="", compare=False)  # the received text without `mac`, which is signed

    def to_text(self) -> str:
        """The text of the tag, without a signature."""
        new = f"{_MARK} s={self.session} e={self.epoch} q={self.sequence} t={self.sent:.6f} d={self.deadline:.6f}"
        return self.received or new

    @property
    def echo(self) -> str:
        """The part of the tag that the answering state repeats; see `read_echo`."""
        return f"{_MARK} s={self.session} q={self.sequence}"


def read_tag(text: object) -> Tag | None:
    """The tag in `text`, or None for anything else: messages of other programs have none."""
    if not isinstance(text, str) or len(text) > _LONGEST or not text.startswith(_MARK + " "):
        return None
    fields = dict(part.split("=", 1) for part in text.split()[1:] if "=" in part)
    mac = fields.get("m", "")
    try:
        numbers = int(fields["e"]), int(fields["q"]), float(fields["t"]), float(fields["d"])
        tag = Tag(fields["s"], *numbers, mac, text.rpartition(" m=")[0] if mac else "")
    except (KeyError, ValueError):
        return None
    return tag if math.isfinite(tag.sent) and math.isfinite(tag.deadline) else None


def read_echo(text: object) -> tuple[str, int] | None:
    """Session and number of the command that a state with the text `text` answers; None if it answers none."""
    if not isinstance(text, str) or len(text) > _LONGEST:
        return None
    echo = re.fullmatch(rf"{_MARK} s=(\S*) q=([0-9]+)", text)
    return None if echo is None else (echo[1], int(echo[2]))


def signature(key: bytes, tag: Tag, channel: str, content: bytes) -> str:
    """HMAC-SHA256 of `content` that is sent on `channel` under `tag`, its first 32 hexadecimal digits."""
    return hmac.digest(key, f"{tag.to_text()}\n{channel}\n".encode() + content, "sha256")[:16].hex()


def new_session() -> str:
    """A unique name for a session."""
    return uuid.uuid4().hex[:12]


class Tagger:
    """Makes the tags of one session, on a steady clock [s]; with a `key` it also signs messages."""

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, *, session: str | None = None, key: bytes = b""
    ) -> None:
        self.session = new_session() if session is None else session
        self.signs = bool(key)
        self._key, self._clock, self._sequence, self._lock = key, clock, 0, threading.Lock()

    def sign(self, tag: Tag, channel: str, content: bytes) -> str:
        """The text of `tag`, signed for `content` on `channel`."""
        return f"{tag.to_text()} m={signature(self._key, tag, channel, content)}" if self._key else tag.to_text()

    def next(self, epoch: int, lifetime: float) -> Tag:
        """A new tag, for a message that is valid for `lifetime` [s]."""
        with self._lock:
            self._sequence += 1
            now = self._clock()
            return Tag(self.session, epoch, self._sequence, now, now + lifetime)


class ClockOffset:
    """Estimates the offset to the clock of a sender, as if its fastest message had taken no time.

    The offset grows by `drift` [s/s], to follow clocks that drift apart.
    """

    def __init__(self, drift: float = 1e-4) -> None:
        self.offset: float | None = None  # local clock minus the sender's [s]; None before the first message
        self._drift, self._at = drift, 0.0

    def age(self, sent: float, arrived: float) -> float:
        """Age [s] of a message at its arrival; `sent` on the sender's clock, `arrived` on the local one."""
        difference = arrived - sent
        if self.offset is not None:
            self.offset += self._drift * max(0.0, arrived - self._at)
        if self.offset is None or difference < self.offset:
            self.offset = difference
        self._at = arrived
        return difference - self.offset


class StampFreshness:
    """Checks the freshness of the messages of one session, which a bridge may delay. Thread-safe; steady clock [s]."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._offset, self._lock = clock, ClockOffset(), threading.Lock()
        self._latest: dict[str, tuple[int, int]] = {}

    def require(self, tag: Tag, channel: str = "") -> None:
        """Record a message of `channel`; `RemoteError` if its connection or number is old, or it is too late."""
        with self._lock:
            epoch, sequence = self._latest.get(channel, (0, 0))
            late = self._offset.age(tag.sent, self._clock()) - (tag.deadline - tag.sent)
            newest = max(self._latest.values(), default=(0, 0))[0]
            if tag.epoch < newest:
                raise RemoteError(f"old connection: epoch {tag.epoch}, and epoch {newest} is there")
            if tag.sequence <= sequence:
                raise RemoteError(f"old message: number {tag.sequence} after number {sequence}")
            self._latest[channel] = (max(epoch, tag.epoch), tag.sequence)
            if late > 0:
                raise RemoteError(f"expired: {late:.3f} s after its deadline")


class FreshnessCheck:
    """`StampFreshness` of each of the latest sessions. Thread-safe."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._sessions: OrderedDict[str, StampFreshness] = OrderedDict()

    def require(self, tag: Tag, channel: str = "") -> None:
        """As `StampFreshness.require`, for the session of `tag`."""
        with self._lock:
            fresh = self._sessions.setdefault(tag.session, StampFreshness(self._clock))
            self._sessions.move_to_end(tag.session)
            if len(self._sessions) > _MOST_SESSIONS:
                self._sessions.popitem(last=False)
        fresh.require(tag, channel)
