"""Text that comes from a file or from the network, as it may be printed: nothing in it acts on a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.text import Text


def shown(text: str) -> str:
    r"""One line of text with ``\x1b``, ``\n`` and the like instead of the characters.

    Control characters (C0, C1), those that turn the direction of writing, line separators and halves of surrogate pairs
    are shown as in Python's string literals.
    """
    return text if text.isprintable() else "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


def rich_text(text: str, style: str = "", **arguments: Any) -> Text:
    """The same for a rich console, which knows no markup in it."""
    from rich.text import Text

    return Text(shown(text), style, **arguments)
