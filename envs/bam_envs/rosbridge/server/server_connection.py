"""One WebSocket connection of the rosbridge server: written to at once, or through its bounded outbox."""

import asyncio
import time
from collections import Counter, deque
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.frames import DATA_OPCODES, Frame, Opcode
from websockets.protocol import Event, State

from bam_envs.rosbridge.server.client_session import Packet, ServerOptions
from bam_envs.rosbridge.tokens import Refusals, Role

TRY_AGAIN_LATER = 1013  # close code of a client that does not read what it must get
# Most sockets without a place, in all and of one address; the oldest is closed for a new one.
_STRANGERS, _STRANGERS_OF_ONE = 128, 32
_OF_A_STRANGER = 65536  # most unread data of a client before its admission [bytes]
_BROKEN = (1002, 1003, 1007, 1009)  # close codes for what breaks the protocol, or is too large
_PORT_PROBE_LIFETIME = 1.0  # longest time that a socket is open which only looks for the port [s]
_FRAME = 200  # approximate overhead of a frame [bytes]


class Outbox:
    """A queue for one client that drops the oldest messages of a topic for newer ones, and no other messages.

    At most `most_bytes` and one more message wait; of one topic at most `most_of_a_stream` messages.
    """

    def __init__(self, most_bytes: int, most_of_a_stream: int) -> None:
        self.size = 0  # bytes that wait
        self._most_bytes, self._most_of_a_stream = most_bytes, most_of_a_stream
        self._packets: deque[Packet] = deque()
        self._waiting: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._packets)

    def add(self, packet: Packet, keep: int = 0) -> bool:
        """Queue a packet, at most `keep` of its stream (0: the default); False if a required one has no room."""
        if packet.stream is not None:
            most = min(keep or self._most_of_a_stream, self._most_of_a_stream)
            while self._waiting[packet.stream] >= most and self._drop(packet.stream):
                pass
        while self.size >= self._most_bytes and self._drop(None):
            pass
        if self.size >= self._most_bytes:
            return packet.stream is not None
        self._packets.append(packet)
        self._count(packet, 1)
        return True

    def pop(self) -> Packet:
        """The oldest packet; there must be one."""
        packet = self._packets.popleft()
        self._count(packet, -1)
        return packet

    def _drop(self, stream: str | None) -> bool:
        """Drop the oldest packet of a stream, or of any; False if there is none."""
        for place, packet in enumerate(self._packets):
            if packet.stream is not None and stream in (None, packet.stream):
                del self._packets[place]
                self._count(packet, -1)
                return True
        return False

    def _count(self, packet: Packet, change: int) -> None:
        self.size += change * packet.size
        if packet.stream is not None:
            self._waiting[packet.stream] += change
            if not self._waiting[packet.stream]:
                del self._waiting[packet.stream]


class BridgeConnection(ServerConnection):
    """A connection with an `Outbox` that counts its unread data; one of `sockets`, the open ones of the server."""

    def __init__(
        self, *args: Any, sockets: set["BridgeConnection"], limits: ServerOptions, refusals: Refusals, **options: Any
    ) -> None:
        super().__init__(*args, **options)
        self._sockets, self._most_unfinished, self._refusals = sockets, limits.unfinished, refusals
        self._most_unsent = limits.max_message + limits.outbox_size
        self.outbox = Outbox(limits.outbox_size, limits.outbox_of_a_topic)
        self.role: Role | None = None  # of an admitted client; None before
        self.secret = ""  # the token that gave the role; empty for a client that showed none
        self.host = ""  # the IP address of the client
        self.heard = time.monotonic()  # when data last arrived [s, monotonic]
        self.born = self.heard  # when the socket opened [s, monotonic]
        self.spoke = 0.0  # when its last message arrived [s, monotonic]; 0 for none since its admission
        self.placed = False  # whether it has one of the places for clients
        self.full = ""  # why an admitted client has none
        self._waiting = 0  # size of complete frames that are not taken yet [bytes]
        self._message, self._is_text = 0, False  # of the unfinished message: its size, and whether it is text
        self._whole = deque[tuple[int, bool]]()  # the same of complete messages
        self._takes_more = True
        self._closing: asyncio.Task[None] | None = None

    # ---- outgoing

    def put(self, packet: Packet, keep: int) -> None:
        """Send `packet` at the next `flush`, or when the socket takes more; close if a required one has no room."""
        if self.state is not State.OPEN or self.transport.is_closing():
            return
        if self._takes_more and not self.outbox:
            self._write(packet)
        elif not self.outbox.add(packet, keep) and self._closing is None:
            reason = f"{self.outbox.size} bytes wait, and the client does not read"
            self._closing = self.loop.create_task(self.close(TRY_AGAIN_LATER, reason))

    def flush(self) -> None:
        """Write the packets together, so that a client that waits for several messages wakes up once."""
        parts = self.protocol.data_to_send()
        whole = b"".join(parts)
        if whole and not self.transport.is_closing():
            self.transport.write(whole)
        if parts and not parts[-1] and self.transport.can_write_eof():  # the protocol's sign for a half-close
            self.transport.write_eof()

    def pause_writing(self) -> None:
        """asyncio: the socket takes no more for now."""
        super().pause_writing()
        self._takes_more = False

    def resume_writing(self) -> None:
        """asyncio: the socket takes more."""
        super().resume_writing()
        self._takes_more = True
        while self._takes_more and self.outbox and self.state is State.OPEN:
            self._write(self.outbox.pop())
            self.flush()

    def _write(self, packet: Packet) -> None:
        # Not send(), which waits: the outbox limits what waits.
        write = self.protocol.send_text if packet.text else self.protocol.send_binary
        for frame in packet.frames:
            write(frame)

    # ---- incoming

    async def next_frame(self) -> bytes:
        """Wait for the next message."""
        return (await self.next_data())[0]

    async def next_message(self) -> str | bytes:
        """Wait for the next message, a text as `str`; text that is no UTF-8 has � in it."""
        data, is_text = await self.next_data()
        return data.decode(errors="replace") if is_text else data

    async def next_data(self) -> tuple[bytes, bool]:
        """Wait for the next message; returns it, and whether it is text, which may be no UTF-8."""
        message = await self.recv(decode=False)
        size, is_text = self._whole.popleft()
        self._waiting -= size
        return message, is_text

    def limit_messages(self, most: int) -> None:
        """Close the connection (1009) if a later message is larger than `most` bytes."""
        self.protocol.max_message_size = most

    def give_way(self, why: str) -> None:
        """Close the connection for another client, and log why."""
        self._refusals.note(self.host, why)
        self.placed = False
        if self._closing is None:
            self._closing = self.loop.create_task(self.close(TRY_AGAIN_LATER, why))

    def cut(self, why: str) -> None:
        """Drop the connection at once, and log why."""
        self._refusals.note(self.host, why)
        self.transport.abort()

    @property
    def unfinished(self) -> int:
        """Size of received data that is not taken yet [bytes]."""
        return self._waiting + len(self.protocol.reader.buffer)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: a socket opened. Too many silent sockets: the oldest is closed, so that they keep no client out."""
        super().connection_made(transport)
        self.host = str((self.remote_address or [""])[0])
        self._sockets.add(self)
        here = (one for one in self._sockets if one is self or not one.transport.is_closing())
        strangers = [one for one in here if not one.placed]
        host, most = Counter(one.host for one in strangers).most_common(1)[0]
        if most > _STRANGERS_OF_ONE or len(strangers) > _STRANGERS:
            min((one for one in strangers if one.host == host), key=lambda one: one.born).cut(
                "It opens too many sockets."
            )

    def connection_lost(self, exc: Exception | None) -> None:
        """asyncio: the socket closed."""
        self._sockets.discard(self)
        # A socket that was closed at once, and empty, is a look whether the port is open.
        if self.request is None and (self.heard > self.born or time.monotonic() - self.born > _PORT_PROBE_LIFETIME):
            self._refusals.note(self.host, "It sent no complete request.")
        closed = self.protocol.close_sent
        if closed is not None and closed.code in _BROKEN and not self.protocol.close_rcvd_then_sent:
            self._refusals.note(self.host, f"Its connection was closed: {closed}.")
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """asyncio: data arrived."""
        self.heard = time.monotonic()
        super().data_received(data)
        if not self.placed and self.unfinished > _OF_A_STRANGER:
            self.cut(f"It sent more than {_OF_A_STRANGER} bytes before it had a place.")
        elif self.unfinished > _OF_A_STRANGER and sum(one.unfinished for one in self._sockets) > self._most_unfinished:
            max(self._sockets, key=lambda one: one.unfinished).cut("Its unfinished messages fill the memory.")
        # Answers to pings that are never read would pile up.
        if not self._takes_more and self.transport.get_write_buffer_size() > self._most_unsent:
            self.cut("It does not read what it asked for.")

    def process_event(self, event: Event) -> None:
        """websockets: a frame arrived."""
        if isinstance(event, Frame) and event.opcode in DATA_OPCODES:
            cost = len(event.data) + _FRAME
            self._waiting += cost
            self._message += cost
            self._is_text = event.opcode is Opcode.TEXT if event.opcode is not Opcode.CONT else self._is_text
            if event.fin:
                self.spoke = self.heard
                self._whole.append((self._message, self._is_text))
                self._message = 0
        super().process_event(event)
