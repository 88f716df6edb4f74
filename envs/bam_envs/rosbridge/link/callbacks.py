"""Telling foreign functions some news, so that none of them can keep the others from hearing it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import TypeVar

T = TypeVar("T")

_LOG = logging.getLogger(__name__)


def tell_all(callbacks: Iterable[Callable[[T], None]], news: T) -> None:
    """Give `news` to each callback; what one of them raises is logged and harms no other."""
    for callback in callbacks:
        _tell_one(callback, news)


def _tell_one(callback: Callable[[T], None], news: T) -> None:
    try:
        callback(news)
    except Exception:  # foreign code, and the others must hear of it all the same
        _LOG.exception("a callback of a link failed")
