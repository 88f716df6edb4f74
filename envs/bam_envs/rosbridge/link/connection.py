"""One connection of a link, from its opening to its end: what is sent, asked, answered and measured on it.

Everything here runs on the network thread, except where it says otherwise. A connection never comes back: what was
handed to it and not sent when it ended is refused, and cannot reach the server over the next one.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, ProtocolError, RemoteError
from bam_envs.rosbridge.encoding import Fragments
from bam_envs.rosbridge.json_frames import decode_frame, encode_frame
from bam_envs.rosbridge.link.handover import Parcel
from bam_envs.rosbridge.link.refusals import echoes

if TYPE_CHECKING:
    from bam_envs.rosbridge.link.protocol import LinkProtocol

_LOG = logging.getLogger(__name__)
_CLOSE_WITHIN = 1.0
_MOST_PASSED_OVER = 20
"""Messages of one connection that mean nothing, after which it is ended."""


def bare_reason(url: str, error: BamEnvsError) -> str:
    """What `error` says, without the address and the full stop: for a text that begins with the address."""
    return str(error).removeprefix(f"{url}: ").rstrip(".")


class Connection:
    """One WebSocket connection; the `Receiver` of its protocol.

    Args:
        url: For texts.
        epoch: Its number among the connections of a link.
        max_message: Largest message, either way [bytes].
        on_message: Takes each message that is not an answer: publish, call_service, status.
        on_end: Called once when it ended, if it was open.
    """

    def __init__(
        self,
        url: str,
        epoch: int,
        max_message: int,
        on_message: Callable[[Connection, dict[str, Any]], None],
        on_end: Callable[[Connection], None],
    ) -> None:
        self.url, self.epoch = url, epoch
        self.opening: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done when it is open, or will not be."""
        self.ending: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done when it has ended."""
        self.error: BamEnvsError | None = None
        """Why it ended; None before."""
        self.reason = ""
        """The same in Autobahn's words."""
        self.ready = False
        """Whether the server has answered a request on it."""
        self.answered_at = time.monotonic()
        """When the server last said anything [s, monotonic]. Any thread may read it."""
        self.announced: dict[str, bytes] = {}
        """What has been advertised and subscribed on it, by id."""
        self._max_message, self._on_message, self._on_end = max_message, on_message, on_end
        self._gone: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._protocol: LinkProtocol | None = None
        self._held_up = False
        self._pending: dict[str, Future[dict[str, Any]]] = {}
        self._fragments = Fragments(max_message)
        self._passed_over = 0

    # ---- sending

    def send(self, *frames: bytes) -> None:
        """Write frames to the socket now, all of them or none.

        Raises:
            LinkLost: The connection has ended, or the server does not read.
            InvalidValue: A frame is larger than allowed.
        """
        if self._protocol is None or self.error is not None:
            why = "not open" if self.error is None else bare_reason(self.url, self.error)
            raise LinkLost(f"{self.url}: the link is down ({why}). Nothing was sent.")
        if self._held_up:
            raise LinkLost(f"{self.url}: the server does not read what it is sent. Nothing more was sent.")
        largest = max(map(len, frames), default=0)
        if largest > self._max_message:
            raise InvalidValue(
                f"{self.url}: a message of {largest} bytes is above the limit of {self._max_message}; nothing was "
                "sent. Send less at once, or raise max_message on both ends."
            )
        self._protocol.write(*frames)

    def post(self, *parcels: Parcel) -> None:
        """Send what another thread has handed over, in this order and at once, unless that took it back."""
        mine = [parcel for parcel in parcels if parcel.take()]
        error: BamEnvsError | None = LinkLost(f"{self.url}: the link broke. The message was not sent.")
        try:
            self.send(*(parcel.frame for parcel in mine))
            error = None
            self._pending.update({parcel.identity: parcel.answer for parcel in mine if parcel.answer is not None})
        except BamEnvsError as refused:
            error = refused
        finally:
            for parcel in mine:
                parcel.settle(error)

    def ask(self, identity: str, request: Mapping[str, Any]) -> asyncio.Future[dict[str, Any]]:
        """Send a request; what is returned resolves to the whole answer.

        Raises:
            LinkLost: See `send`.
        """
        answer: Future[dict[str, Any]] = Future()
        self.send(encode_frame(request))
        self._pending[identity] = answer
        return asyncio.wrap_future(answer)

    def forget(self, identity: str) -> None:
        """Nobody waits for this answer any more."""
        self._pending.pop(identity, None)

    def ping(self) -> None:
        """Ask for a sign of life."""
        if self._protocol is not None and self.error is None and not self._held_up:
            self._protocol.sendPing()

    # ---- ending

    def drop(self, error: BamEnvsError) -> None:
        """End it at once, without a word to the server; what is still unsent is thrown away."""
        self._end(error)
        if self._protocol is not None and self._protocol.transport is not None:
            self._protocol.transport.abort()

    async def close(self) -> None:
        """End it with a closing handshake, or without one where the server does not take part."""
        if self._protocol is not None and self.error is None:
            self._protocol.sendClose()
            self._end(LinkLost(f"{self.url}: the link was closed."))
            await asyncio.wait([self._gone], timeout=_CLOSE_WITHIN)
        self.drop(LinkLost(f"{self.url}: the link was closed."))

    def _end(self, error: BamEnvsError) -> None:
        if self.error is not None:
            return
        self.error = error
        pending, self._pending = self._pending, {}
        for answer in pending.values():
            if not answer.done():
                answer.set_exception(error)
        if not self.opening.done():
            self.opening.set_result(None)
        self.ending.set_result(None)
        if self._protocol is not None:
            self._on_end(self)

    # ---- what the protocol says

    def opened(self, protocol: LinkProtocol) -> None:
        """The WebSocket handshake is done."""
        self._protocol = protocol
        self.answered_at = time.monotonic()
        if not self.opening.done():
            self.opening.set_result(None)

    def closed(self, reason: str) -> None:
        """The connection ended, or never opened."""
        self.reason = self.reason or reason
        if not self._gone.done():
            self._gone.set_result(None)
        if "exceeds payload limit" in reason:
            self._end(
                ProtocolError(
                    f"{self.url}: the server sent a message above the limit of {self._max_message} bytes. "
                    "Take compressed images, or raise max_message."
                )
            )
        else:
            self._end(LinkLost(f"{self.url}: the link dropped: {reason}."))

    def held_up(self, held_up: bool) -> None:
        """The server does not read fast enough, or does again."""
        self._held_up = held_up

    def ponged(self) -> None:
        """The server lives."""
        self.answered_at = time.monotonic()

    def received(self, payload: bytes, binary: bool) -> None:
        """A message came. What cannot be read is passed over; a server that sends nothing else is left."""
        self.answered_at = time.monotonic()
        if binary:
            self.pass_over(f"a binary message of {len(payload)} bytes, which nobody asked for")
            return
        try:
            self._dispatch(decode_frame(payload))
        except BamEnvsError as error:  # nonsense, or an answer to it that cannot be sent
            self.pass_over(str(error))

    def pass_over(self, text: str) -> None:
        """Take note of a message that means nothing here; `text` says what it is."""
        _LOG.info("%s: passed over: %s", self.url, text)
        self._passed_over += 1
        if self._passed_over == _MOST_PASSED_OVER:
            self.drop(
                ProtocolError(
                    f"{self.url}: the server sends what is no rosbridge message, {self._passed_over} times by now: "
                    f"{text}. Is it the right port?"
                )
            )

    def _dispatch(self, message: dict[str, Any]) -> None:
        operation = message.get("op")
        if operation == "service_response":
            self._resolve(message)
        elif operation == "fragment":
            self._fragments.expire(self.answered_at)
            whole = self._fragments.add(message, self.answered_at)
            if whole is not None:
                self._dispatch(decode_frame(whole))
        elif not self._is_echo(message):
            self._refuse_request(message)
            self._on_message(self, message)

    def _is_echo(self, message: dict[str, Any]) -> bool:
        # Looked at before the server is known to be one: later on, a request of its own may have an id like ours.
        if self.ready or message.get("op") != "call_service":
            return False
        answer = self._pending.pop(str(message.get("id")), None)
        if answer is not None and not answer.done():
            answer.set_exception(echoes(self.url))
        return answer is not None

    def _resolve(self, message: dict[str, Any]) -> None:
        answer = self._pending.pop(str(message.get("id")), None)
        if answer is not None and not answer.done():
            answer.set_result(message)

    def _refuse_request(self, message: dict[str, Any]) -> None:
        # A server may answer a request that it cannot read with a status of the same id, and with nothing else.
        if message.get("op") == "status" and message.get("level") == "error":
            answer = self._pending.pop(str(message.get("id")), None)
            if answer is not None and not answer.done():
                answer.set_exception(RemoteError(str(message.get("msg"))))
