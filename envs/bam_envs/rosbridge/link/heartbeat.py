"""Seeing within a set time that a server no longer answers, though the connection is still there."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass

from bam_envs.core.errors import InvalidValue, LinkLost
from bam_envs.rosbridge.link.connection import Connection


@dataclass(frozen=True)
class Heartbeat:
    """How often to ask, and when to give up."""

    every: float
    """Between two probes [s]."""
    lost_after: float
    """Silence after which the link is lost [s]."""

    def __post_init__(self) -> None:
        if not 0.0 < self.every < self.lost_after:
            raise InvalidValue(
                f"Heartbeat: every {self.every} s, lost_after {self.lost_after} s. Expected 0 < every < lost_after."
            )


async def watch(connection: Connection, beat: Heartbeat) -> None:
    """Ping until `connection` ends, and end it when nothing has come for `beat.lost_after`."""
    heard = connection.answered_at = time.monotonic()
    while connection.error is None:
        connection.ping()
        pause = min(beat.every, heard + beat.lost_after - time.monotonic())
        woken = time.monotonic() + pause
        await asyncio.wait([connection.ending], timeout=pause)
        if time.monotonic() - woken > beat.every:
            # This process itself stood still, and what came meanwhile is still unread: start over.
            connection.answered_at = time.monotonic()
        heard = connection.answered_at
        if time.monotonic() - heard >= beat.lost_after:
            connection.drop(LinkLost(f"{connection.url}: nothing from the server for {beat.lost_after:g} s."))
