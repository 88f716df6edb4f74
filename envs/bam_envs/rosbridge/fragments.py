"""Messages in fragments: cutting what is too long for one frame, and joining what comes in several."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bam_envs.core.errors import ProtocolError
from bam_envs.core.wording import brief
from bam_envs.rosbridge.encoding import dump_json

LONGEST_ID = 256
"""Most characters of an id: it is kept, and repeated, for as long as what it names is unfinished."""
LARGEST_ID = 2**53
"""Largest id that is a number: what every JSON reader holds exactly."""
_MOST_FRAGMENTS = 10_000
"""Of one outgoing message: a smaller fragment size would cost more than it carries."""
_EMPTY = 100
"""About what a fragment without any text costs [bytes]."""

Id = str | int | None
"""What a client calls an interaction; None if it does not."""


def split(text: str, size: int, name: str) -> list[str]:
    """`text` as messages ``fragment`` with `size` characters of it in each; `text` itself if it is short enough."""
    if len(text) <= size:
        return [text]
    size = max(size, math.ceil(len(text) / _MOST_FRAGMENTS))
    starts = range(0, len(text), size)
    return [
        dump_json({"op": "fragment", "id": name, "data": text[at : at + size], "num": num, "total": len(starts)})
        for num, at in enumerate(starts)
    ]


def read_id(message: Mapping[str, Any], where: str = "id") -> Id:
    """The id of a message: a text or an integer, if there is one.

    Raises:
        ProtocolError: It is something else, or too long to be kept.
    """
    value = message.get("id")
    if isinstance(value, bool) or not (value is None or isinstance(value, (str, int))):
        raise ProtocolError(f"{where}: expected a text or an integer, found {brief(value)}.")
    if isinstance(value, str) and len(value) > LONGEST_ID:
        raise ProtocolError(f"{where}: expected at most {LONGEST_ID} characters, found {len(value)}.")
    if isinstance(value, int) and abs(value) > LARGEST_ID:
        raise ProtocolError(f"{where}: expected an integer of 53 bits, found {brief(value)}.")
    return value


@dataclass
class _Parts:
    total: int
    deadline: float
    texts: dict[int, str] = field(default_factory=dict)
    size: int = 0
    """Bytes: a text that is not ASCII takes up to four for a character."""


class Fragments:
    """Joins the fragments of one connection, in whatever order they come.

    Args:
        max_size: Most bytes that all unfinished messages may hold together.
        lifetime: How long a message may stay unfinished [s].
        max_messages: Most unfinished messages.
    """

    def __init__(self, max_size: int, lifetime: float = 10.0, max_messages: int = 16) -> None:
        self.max_size, self.lifetime, self.max_messages = max_size, lifetime, max_messages
        self._unfinished: dict[Id, _Parts] = {}

    @property
    def size(self) -> int:
        """What the unfinished messages hold [bytes]."""
        return sum(parts.size for parts in self._unfinished.values())

    def clear(self) -> None:
        """Give all of them up."""
        self._unfinished.clear()

    @property
    def deadline(self) -> float | None:
        """When the first unfinished message is given up [s], clock of the caller; None if there is none."""
        return min((parts.deadline for parts in self._unfinished.values()), default=None)

    def add(self, message: Mapping[str, Any], now: float) -> str | None:
        """Take a message ``fragment``; returns the whole text when it was the last one missing.

        Raises:
            ProtocolError: It does not fit; what there was of its message is given up.
        """
        name = read_id(message, "fragment.id")
        if name is None:
            raise ProtocolError("fragment.id: expected a text or an integer, found None.")
        try:
            return self._add(name, message, now)
        except ProtocolError:
            self._unfinished.pop(name, None)
            raise

    def expire(self, now: float) -> list[Id]:
        """Give up what is too old; returns the ids."""
        late = [name for name, parts in self._unfinished.items() if parts.deadline <= now]
        for name in late:
            del self._unfinished[name]
        return late

    def _add(self, name: Id, message: Mapping[str, Any], now: float) -> str | None:
        num, total = _count(message, "num"), _count(message, "total")
        data = message.get("data")
        if not isinstance(data, str):
            raise ProtocolError(f"fragment.data: expected a text, found {brief(data)}.")
        if name not in self._unfinished and len(self._unfinished) >= self.max_messages:
            raise ProtocolError(f"Fragments of {self.max_messages} messages are unfinished; send one to its end first.")
        parts = self._unfinished.setdefault(name, _Parts(total, now + self.lifetime))
        if total != parts.total or not num < total or parts.texts.get(num, data) != data:
            raise ProtocolError(f"Fragment {num} of {total} of {name!r} does not fit the ones before it.")
        if num not in parts.texts:
            parts.texts[num] = data
            # An empty fragment costs memory too.
            parts.size += len(data) * (1 if data.isascii() else 4) + _EMPTY
            if self.size > self.max_size:
                raise ProtocolError(f"Fragments: expected at most {self.max_size} bytes, found {self.size}.")
        if len(parts.texts) < total:
            return None
        del self._unfinished[name]
        return "".join(parts.texts[place] for place in range(total))


def _count(message: Mapping[str, Any], name: str) -> int:
    value = message.get(name)
    # The Python servers send the total as a float with a fraction: 8.52 for 8 fragments.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 2**31:
        raise ProtocolError(f"fragment.{name}: expected a number >= 0, found {brief(value)}.")
    return int(value)
