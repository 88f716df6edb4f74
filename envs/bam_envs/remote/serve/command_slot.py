"""The newest command on its way from the network to the robot: one place, overwritten, never a queue."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Order:
    """What the messages since the last look command together."""

    values: Mapping[int, float] = field(default_factory=dict)
    """Place in the command -> number [SI]; places that are not in it stay as they are."""
    complete: bool = False
    """Whether the message that makes a command complete is among them."""
    tag: str = ""
    """`Tag.echo` of the newest one."""
    client: str = ""
    """Who sent them."""


class CommandSlot:
    """Written by the thread of the network, emptied by that of the robot."""

    def __init__(self) -> None:
        self._lock, self._order = threading.Lock(), Order()

    def put(self, client: str, places: Iterable[int], values: Iterable[float], *, complete: bool, tag: str) -> None:
        """Add a message's numbers [SI] for `places`; what was there for them, or of another client, is forgotten."""
        new = dict(zip(places, values, strict=True))
        with self._lock:
            old = self._order if self._order.client == client else Order()
            self._order = Order({**old.values, **new}, old.complete or complete, tag or old.tag, client)

    def take(self) -> Order | None:
        """What came, once; None if nothing did."""
        with self._lock:
            order, self._order = self._order, Order()
        return order if order.values else None

    def take_complete(self) -> Order | None:
        """What came, once; None as long as the command is not complete."""
        with self._lock:
            if not self._order.complete:
                return None
            order, self._order = self._order, Order()
        return order

    def clear(self) -> Order:
        """Forget what came; what it was."""
        with self._lock:
            order, self._order = self._order, Order()
        return order
