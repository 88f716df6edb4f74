"""One WebSocket connection of the rosbridge server: written to at once, or through its bounded outbox."""

from __future__ import annotations

import asyncio
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.protocol import State

from bam_envs.bridge.server.outbox import Outbox, OutboxLimits
from bam_envs.bridge.server.packets import Packet

TRY_AGAIN_LATER = 1013
"""Close code of a client that does not read what it must get."""


class BridgeConnection(ServerConnection):
    """A connection that knows when its socket takes more.

    Args:
        *args: Of `websockets`.
        sockets: Every open socket of the server; this one is added and taken out.
        most_sockets: A socket beyond is closed at once.
        most_unsent: Most bytes that may wait for the socket [bytes]; pings that are never read would pile up.
        outbox_limits: Of what waits beside.
        **options: Of `websockets`.
    """

    def __init__(
        self,
        *args: Any,
        sockets: set[BridgeConnection],
        most_sockets: int,
        most_unsent: int,
        outbox_limits: OutboxLimits,
        **options: Any,
    ) -> None:
        super().__init__(*args, **options)
        self._sockets, self._most_sockets, self._most_unsent = sockets, most_sockets, most_unsent
        self.outbox = Outbox(outbox_limits)
        self._takes_more = True
        self._closing: asyncio.Task[None] | None = None

    def put(self, packet: Packet, keep: int) -> None:
        """Send `packet` at the next `flush`, or when the socket takes more.

        A client that must get it and does not read is closed.
        """
        if not self.is_open or self.transport.is_closing():
            return
        if self._takes_more and not self.outbox:
            self._write(packet)
        elif not self.outbox.add(packet, keep) and self._closing is None:
            reason = f"{self.outbox.size} bytes wait, and the client does not read"
            self._closing = self.loop.create_task(self.close(TRY_AGAIN_LATER, reason))

    def flush(self) -> None:
        """Write what was put, in one piece: a client that waits for several messages wakes up once."""
        parts = self.protocol.data_to_send()
        whole = parts[0] if len(parts) == 1 else b"".join(parts)
        if whole and not self.transport.is_closing():
            self.transport.write(whole)
        if parts and not parts[-1] and self.transport.can_write_eof():  # how the protocol says: half-close
            self.transport.write_eof()

    @property
    def is_open(self) -> bool:
        """Whether the opening handshake is over and the closing one has not begun."""
        return self.state is State.OPEN

    @property
    def is_opening(self) -> bool:
        """Whether the opening handshake is not over yet."""
        return self.state is State.CONNECTING

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """A socket opened."""
        super().connection_made(transport)
        self._sockets.add(self)
        if len(self._sockets) > self._most_sockets:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """The socket closed."""
        self._sockets.discard(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Bytes came."""
        super().data_received(data)
        if not self._takes_more and self.transport.get_write_buffer_size() > self._most_unsent:
            self.transport.abort()

    def pause_writing(self) -> None:
        """The socket takes no more for now."""
        super().pause_writing()
        self._takes_more = False

    def resume_writing(self) -> None:
        """The socket takes more."""
        super().resume_writing()
        self._takes_more = True
        while self._takes_more and self.outbox and self.is_open:
            self._write(self.outbox.pop())
            self.flush()

    def _write(self, packet: Packet) -> None:
        # Not send(), which waits: how much waits is for the outbox to say.
        write = self.protocol.send_text if packet.text else self.protocol.send_binary
        for frame in packet.frames:
            write(frame)
