"""roslibpy's asyncio transport, made fit for a robot: it does not queue, does not reconnect, checks certificates.

Import this module only when a link connects: it binds Autobahn to asyncio for the rest of the process.
"""

from __future__ import annotations

import asyncio
import logging
import os
import ssl
import threading
from typing import Any, Protocol

from roslibpy.comm import comm_asyncio

from bam_envs.core.errors import LinkLost
from bam_envs.rosbridge.endpoint import Address
from bam_envs.rosbridge.text_frames import split_texts, text_frame

_AUTOBAHN = logging.getLogger("autobahn")
if _AUTOBAHN.level == logging.NOTSET:
    _AUTOBAHN.setLevel(logging.CRITICAL)  # a link says itself, and in one line, why it ended or did not open
_UNSENT_HIGH = 1024 * 1024
_inherited: list[object] = []
_starting = threading.Lock()


class Receiver(Protocol):
    """What hears of a connection; on the loop thread."""

    def opened(self, protocol: LinkProtocol) -> None:
        """The WebSocket handshake is done."""

    def received(self, payload: bytes, binary: bool) -> None:
        """A whole message came."""

    def ponged(self) -> None:
        """A ping was answered."""

    def held_up(self, held_up: bool) -> None:
        """The server does not read fast enough, or does again."""

    def closed(self, reason: str) -> None:
        """It ended, or never opened."""


class LinkProtocol(comm_asyncio.AsyncioRosBridgeProtocol):  # type: ignore[misc]
    """One WebSocket connection of roslibpy's, that tells its `Receiver` everything."""

    def connection_made(self, transport: Any) -> None:  # noqa: D102 - asyncio's
        transport.set_write_buffer_limits(high=_UNSENT_HIGH)
        super().connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """asyncio: bytes came. Autobahn puts them into a queue that it empties a turn of the loop later."""
        if self.state == self.STATE_OPEN and self.current_frame is None and not self.inside_message and not self.data:
            texts, data = split_texts(data, self.maxMessagePayloadSize)
            for text in texts:
                self.onMessage(text, isBinary=False)
        if data:
            self._dataReceived(data)

    def write(self, *payloads: bytes) -> None:
        """Send texts now, each as a frame, with one system call.

        Raises:
            LinkLost: A closing handshake is going on, or is over.
        """
        if self.state != self.STATE_OPEN:
            raise LinkLost(f"{self.factory.url}: the link is being closed. Nothing was sent.")
        # Autobahn's sendMessage does the same in several times the time, which a control loop waits for.
        self.transport.write(b"".join(map(text_frame, payloads)))

    def pause_writing(self) -> None:
        """asyncio: more than `_UNSENT_HIGH` bytes wait for the server to read."""
        self.factory.receiver.held_up(True)

    def resume_writing(self) -> None:
        """asyncio: they are gone."""
        self.factory.receiver.held_up(False)

    def onMessage(self, payload: bytes, isBinary: bool) -> None:  # noqa: D102, N802, N803 - Autobahn's
        self.factory.receiver.received(payload, isBinary)

    def onPong(self, payload: bytes) -> None:  # noqa: D102, N802 - Autobahn's
        self.factory.receiver.ponged()

    def onCloseFrame(self, code: int | None, reasonRaw: bytes | None) -> Any:  # noqa: D102, N802, N803 - Autobahn's
        done = super().onCloseFrame(code, reasonRaw)
        # Whoever began, nothing may be sent any more; Autobahn says so only when the server drops TCP, if it does.
        details = [f"code {self.remoteCloseCode}" if self.remoteCloseCode else "no code", self.remoteCloseReason]
        self.factory.receiver.closed(f"the server closed it with {', '.join(filter(None, details))}")
        self.transport.close()
        return done

    def onClose(self, wasClean: bool, code: int | None, reason: str | None) -> None:  # noqa: D102, N802, N803
        self.factory.connection_lost(self, self.wasNotCleanReason or "closed")


class LinkFactory(comm_asyncio.AsyncioRosBridgeClientFactory):  # type: ignore[misc]
    """Makes the protocol of one connection, once.

    Args:
        address: Where to connect.
        headers: More HTTP headers.
        max_message: Largest message to receive [bytes].
        receiver: Hears of everything.
    """

    protocol = LinkProtocol
    compression = "none"  # deflate costs more time than a fast network saves

    def __init__(self, address: Address, headers: dict[str, str], max_message: int, receiver: Receiver) -> None:
        super().__init__(f"{address.url}/", headers=headers)
        self.receiver = receiver
        # The JSON decoder checks UTF-8 anyway.
        self.setProtocolOptions(maxMessagePayloadSize=max_message, utf8validateIncoming=False)

    def ready(self, proto: LinkProtocol) -> None:
        """roslibpy: the handshake is done. Nothing waits in a queue here."""
        self.receiver.opened(proto)

    def connection_lost(self, proto: LinkProtocol, reason: str) -> None:
        """roslibpy: the connection ended. It does not come back by itself: the link decides that."""
        self.receiver.closed(reason)


async def open_socket(factory: LinkFactory, address: Address, context: ssl.SSLContext | None) -> asyncio.Transport:
    """Connect TCP, and TLS with a `context`; the rest comes through the receiver."""
    server = address.host if context is not None else None
    transport, _ = await asyncio.get_running_loop().create_connection(
        factory, address.host, address.port, ssl=context, server_hostname=server
    )
    return transport


def network_loop() -> tuple[asyncio.AbstractEventLoop, int]:
    """The loop of roslibpy's one thread in this process, running, and the thread's ident."""
    with _starting:
        manager = comm_asyncio._get_shared_manager()
        manager.run()
    return manager.loop, manager._thread.ident


def _forget_inherited() -> None:
    # A forked child has the parent's loop without its thread, and a share in its epoll: closing it there, even by the
    # garbage collector, would unregister the parent's sockets. So it is kept, unused, and the child gets a new one.
    global _starting
    _starting = threading.Lock()
    _inherited.append(comm_asyncio._MANAGER_SINGLETON)
    comm_asyncio._MANAGER_SINGLETON = None
    comm_asyncio._MANAGER_SINGLETON_LOCK = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_inherited)
