"""One topic in CBOR, on a connection of its own: for raw images and large arrays, which JSON makes seven times slower.

roslibpy has no CBOR, so this is a client of its own, on `websockets`. It takes the newest message only: while one is
being looked at, the ones that came meanwhile are passed over, whatever their size.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from bam_envs.core.errors import BamEnvsError, LinkLost, ProtocolError
from bam_envs.ros.interfaces import normal_name
from bam_envs.ros.typed_arrays import decode_cbor
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.json_frames import decode_frame
from bam_envs.rosbridge.link.dialing import Dial
from bam_envs.rosbridge.link.websocket_client import CLOSE_WITHIN, open_websocket

_LOG = logging.getLogger(__name__)
_FIRST_DELAY, _LONGEST_DELAY = 0.05, 2.0


@dataclass(frozen=True)
class Arrival:
    """A message and when it came."""

    message: Mapping[str, Any]
    """Its fields; typed arrays are arrays, byte arrays `bytes`."""
    at: float
    """When it came [s, monotonic]."""


class CborStream:
    """The newest message of one topic.

    Args:
        endpoint: As of `RosbridgeLink`; a namespace in it is not used.
        topic: Its name.
        kind: Its type.
        listener: Called with each message that is not passed over, in a thread of the stream; it may take its time.
        throttle_ms: Least time between two messages [ms]; the server drops the others.
        max_message: Largest message [bytes].
        clock: Monotonic clock [s], for `Arrival.at`.

    Raises:
        InvalidValue: The address or the type is none.
    """

    def __init__(
        self,
        endpoint: Endpoint | str,
        topic: str,
        kind: str,
        listener: Callable[[Arrival], None] | None = None,
        *,
        throttle_ms: int = 0,
        max_message: int = 64 * 1024 * 1024,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        endpoint = Endpoint(endpoint) if isinstance(endpoint, str) else endpoint
        self._dial = Dial(endpoint, max_message)
        self.url, self.topic = self._dial.address.url, topic
        self._request: dict[str, Any] = {
            "op": "subscribe",
            "id": f"subscribe:{topic}",
            "topic": topic,
            "type": normal_name(kind),
            "compression": "cbor",
            "throttle_rate": throttle_ms,
            "queue_length": 0,
        }
        self._listener, self._timeout = listener, endpoint.connect_timeout
        self._changed = threading.Condition()
        self._frame: tuple[str | bytes, float] | None = None
        self._decoded: tuple[tuple[str | bytes, float], Arrival | None] | None = None
        self._connection: ClientConnection | None = None
        self._error: BamEnvsError | None = None
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []

    # ---- for the user

    def start(self) -> None:
        """Connect and subscribe; from then on it comes back by itself whenever the connection drops.

        Raises:
            NoServer: There is no server that can be used; the text says why.
            InvalidValue: The CA file cannot be read.
            LinkLost: The stream was closed.
        """
        if self._closing.is_set():
            raise LinkLost(f"{self.url}: this stream was closed. Make a new one.")
        if not self._threads:
            first: Future[None] = Future()
            self._start_thread(self._receive_all, first)
            try:
                first.result()
            except BamEnvsError:
                self._threads.pop().join()
                raise
            if self._listener is not None:
                self._start_thread(self._tell_all, self._listener)

    def latest(self) -> Arrival | None:
        """The newest message, or None before the first.

        Raises:
            ProtocolError: The newest message cannot be read.
        """
        with self._changed:
            frame, decoded = self._frame, self._decoded
        if frame is None:
            return None
        if decoded is None or decoded[0] is not frame:
            decoded = self._decoded = (frame, self._decode(*frame))
        return decoded[1]

    @property
    def is_up(self) -> bool:
        """Whether there is a connection."""
        return self._connection is not None

    @property
    def error(self) -> BamEnvsError | None:
        """Why there was no connection, the last time there was none."""
        return self._error

    def close(self) -> None:
        """Leave, with a closing handshake, and stay away. As often as one likes."""
        self._closing.set()
        connection = self._connection
        if connection is not None:
            connection.close()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(CLOSE_WITHIN + 2 * self._timeout)

    # ---- threads

    def _start_thread(self, target: Callable[..., None], argument: object) -> None:
        name = f"bam-cbor{self.topic.replace('/', '-')}"
        self._threads.append(threading.Thread(target=target, args=(argument,), name=name, daemon=True))
        self._threads[-1].start()

    def _receive_all(self, first: Future[None]) -> None:
        try:
            self._receive_again_and_again(first)
        finally:
            if not first.done():  # start() waits for it, whatever happened
                first.set_exception(LinkLost(f"{self.url}: {self.topic}: the stream ended while it was connected."))

    def _receive_again_and_again(self, first: Future[None]) -> None:
        delay = _FIRST_DELAY
        while not self._closing.is_set():
            try:
                with open_websocket(self._dial, self._timeout) as connection:
                    delay = self._receive(connection, first, delay)
            except BamEnvsError as error:
                self._error = error
                if not first.done():
                    first.set_exception(error)
                    return
            self._closing.wait(delay)
            delay = min(2 * delay, _LONGEST_DELAY)

    def _receive(self, connection: ClientConnection, first: Future[None], delay: float) -> float:
        """Keep the newest frame until the connection ends; how long to wait for the next connection [s]."""
        try:
            connection.send(json.dumps(self._request))
            self._connection = connection
            if not first.done():
                first.set_result(None)
            # close() ends the connection that it finds: one that came about meanwhile must end by itself.
            while not self._closing.is_set():
                self._keep(connection.recv())
                delay = _FIRST_DELAY
        except ConnectionClosed as error:
            self._error = LinkLost(f"{self.url}: {self.topic}: the connection dropped: {error}.")
            if not first.done():
                first.set_exception(self._error)
        finally:
            self._connection = None
        return delay

    def _keep(self, frame: str | bytes) -> None:
        if isinstance(frame, str) and not _is_publication(frame):
            _LOG.warning("%s: %s: the server says %s", self.url, self.topic, frame[:500])
            return
        with self._changed:
            self._frame = (frame, self._clock())
            self._changed.notify_all()

    def _tell_all(self, listener: Callable[[Arrival], None]) -> None:
        told = self._wait_for_other_than(None)
        while told is not None:
            self._tell(listener)
            told = self._wait_for_other_than(told)

    def _wait_for_other_than(self, told: object) -> object:
        """The newest frame, once it is another one; None when the stream is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._frame is not told or self._closing.is_set())
            return None if self._closing.is_set() else self._frame

    def _tell(self, listener: Callable[[Arrival], None]) -> None:
        try:
            arrival = self.latest()
            if arrival is not None:
                listener(arrival)
        except ProtocolError as error:
            _LOG.warning("%s", error)
        except Exception:  # a listener is foreign code, and the next message must be told all the same
            _LOG.exception("%s: a listener failed", self.topic)

    # ---- messages

    def _decode(self, frame: str | bytes, at: float) -> Arrival:
        message = decode_frame(frame) if isinstance(frame, str) else decode_cbor(frame)
        content = message.get("msg")
        if message.get("op") != "publish" or message.get("topic") != self.topic or not isinstance(content, Mapping):
            raise ProtocolError(
                f"{self.url}: expected a message of {self.topic}, found op {message.get('op')!r} "
                f"of {message.get('topic')!r}."
            )
        return Arrival(content, at)


def _is_publication(frame: str) -> bool:
    # A server that has no CBOR sends JSON; every server sends its statuses so.
    try:
        return decode_frame(frame).get("op") == "publish"
    except ProtocolError:
        return False
