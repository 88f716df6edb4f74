"""Errors, and what they say."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def raising(kind: type[BaseException], text: str, *, begins: bool = False) -> Iterator[None]:
    """The ``with`` block raises a `kind` whose message is `text`, or `begins` with it."""
    with pytest.raises(kind) as caught:
        yield
    assert (str(caught.value)[: len(text)] if begins else str(caught.value)) == text
