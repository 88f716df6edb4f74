"""How much a message may hold: known from its bytes, before anything is made of them."""

from __future__ import annotations

from bam_envs.core.errors import ProtocolError
from bam_envs.ros.checks import MAX_DEPTH

MOST_ITEMS = 100_000
"""Values in one message of JSON: lists and objects count, and each thing in them. An image is one text."""
_OTHERS = bytes(set(range(256)) - set(b'"[]{}'))
_ONE_KIND = bytes.maketrans(b"{}", b"[]")


def require_bounded(data: bytes, most_items: int = MOST_ITEMS) -> None:
    """Refuse JSON that is too much work, from a few passes over its bytes in C.

    Args:
        data: In UTF-8.
        most_items: Most values. Commas and brackets in texts count too.

    Raises:
        ProtocolError: There are more, or lists and objects are too deep in one another.
    """
    openings = data.count(b"[") + data.count(b"{")
    if openings + data.count(b",") > most_items:
        raise ProtocolError(f"Message: expected at most {most_items} values, found more.")
    if openings > MAX_DEPTH and _is_deep(data):
        raise ProtocolError(f"Message: expected at most {MAX_DEPTH} lists and objects in one another, found more.")


def _is_deep(data: bytes) -> bool:
    if b"\\" in data:
        data = data.replace(b"\\\\", b"").replace(b'\\"', b"")
    outside = b"".join(data.translate(_ONE_KIND, _OTHERS).split(b'"')[::2])  # every second part is in a text
    for _ in range(MAX_DEPTH):  # each pass takes the innermost away
        outside = outside.replace(b"[]", b"")
    return b"[" in outside
