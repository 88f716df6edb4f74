"""What waits for one client that reads slowly: bounded, and of each topic the newest."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

from bam_envs.rosbridge.server.packets import Packet


@dataclass(frozen=True)
class OutboxLimits:
    """How much may wait for one client."""

    size: int = 8 * 2**20
    """Most bytes; one message more, of whatever size, is taken when less than that waits."""
    of_one_stream: int = 100
    """Most messages of one topic, unless the client asked for fewer."""


class Outbox:
    """A queue that drops the oldest message of a topic for a newer one, and nothing else.

    Args:
        limits: How much may wait.
    """

    def __init__(self, limits: OutboxLimits) -> None:
        self.limits = limits
        self.size = 0
        """Bytes that wait."""
        self.dropped = 0
        """Messages that had to give way."""
        self._packets: deque[Packet] = deque()
        self._waiting: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._packets)

    def add(self, packet: Packet, keep: int = 0) -> bool:
        """Take a packet.

        Args:
            packet: What waits from now on.
            keep: Most packets of the same stream that may wait; 0 for the usual number.

        Returns:
            False if there is no room for one that must arrive.
        """
        if packet.stream is not None:
            self._thin_out(packet.stream, min(keep or self.limits.of_one_stream, self.limits.of_one_stream))
        while self.size >= self.limits.size and self._drop(None):
            pass
        if self.size >= self.limits.size and packet.stream is None:
            return False
        if self.size < self.limits.size:
            self._push(packet)
        return True

    def pop(self) -> Packet:
        """The oldest packet; there must be one."""
        packet = self._packets.popleft()
        self._gone(packet)
        return packet

    def _push(self, packet: Packet) -> None:
        self._packets.append(packet)
        self.size += packet.size
        if packet.stream is not None:
            self._waiting[packet.stream] += 1

    def _thin_out(self, stream: str, most: int) -> None:
        while self._waiting[stream] >= most and self._drop(stream):
            pass

    def _drop(self, stream: str | None) -> bool:
        """Drop the oldest packet of a stream, or of any; False if there is none."""
        for place, packet in enumerate(self._packets):
            if packet.stream is not None and stream in (None, packet.stream):
                del self._packets[place]
                self._gone(packet)
                self.dropped += 1
                return True
        return False

    def _gone(self, packet: Packet) -> None:
        self.size -= packet.size
        if packet.stream is not None:
            self._waiting[packet.stream] -= 1
            if not self._waiting[packet.stream]:
                del self._waiting[packet.stream]
