"""Keeping a client connected: the first connection, the next ones with bounded back-off, the end.

Longer than most modules: what runs on which thread can be followed only in one place.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import TimeoutError as NoResultYet
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NoServer
from bam_envs.rosbridge.json_frames import encode_frame
from bam_envs.rosbridge.link.callbacks import tell_all
from bam_envs.rosbridge.link.connection import Connection, bare_reason
from bam_envs.rosbridge.link.declarations import Declarations
from bam_envs.rosbridge.link.dialing import Dial, ServerClock, dial_server
from bam_envs.rosbridge.link.heartbeat import Heartbeat, watch

_LOG = logging.getLogger(__name__)
_FIRST_DELAY, _LONGEST_DELAY = 0.05, 2.0
_STEADY = 2.0
_LEAVE_WITHIN = 3.0


class Keeper:
    """The connections of one link, one after the other.

    Args:
        dial: Where to connect, and how.
        timeout: For one connection, until the server has answered a request [s].
        clock: Our wall clock [s].
        declarations: What every new connection is told first.
        on_message: Takes each message that is not an answer; on the loop thread.
    """

    def __init__(
        self,
        dial: Dial,
        timeout: float,
        clock: Callable[[], float],
        declarations: Declarations,
        on_message: Callable[[Connection, dict[str, Any]], None],
    ) -> None:
        self.up: Connection | None = None
        """The connection, while there is one that can be used. Any thread may read it."""
        self.epoch = 0
        """Counts the connections; 0 before the first."""
        self.server = ServerClock(None, None)
        """What the server says of itself."""
        self.why = "not connected yet: call connect()"
        """Why there is no connection."""
        self.down_callbacks: list[Callable[[LinkLost], None]] = []
        self.thread = 0
        """The network thread, once connected."""
        self._dial, self._timeout, self._clock = dial, timeout, clock
        self._declarations, self._on_message = declarations, on_message
        self._beat: Heartbeat | None = None
        self._closed = False
        self._pid = os.getpid()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._connecting, self._changed = threading.Lock(), threading.Condition()

    # ---- any thread

    def connect(self) -> None:
        """Connect, and keep connected from then on; `RosbridgeLink.connect` says what it raises."""
        with self._connecting:
            self._require_open()
            if self._loop is None:
                self._loop, self.thread = _network()
            if "keep" not in self._tasks:
                self._run(self._establish, self._timeout + _LEAVE_WITHIN, withdraw=True)
            elif not self.wait_up(self._timeout):
                raise LinkLost(f"{self._dial.address.url}: the link is down ({self.why}).")

    def close(self) -> None:
        """End it. In a forked child nothing is touched: the socket is the parent's too."""
        self._closed = True
        if self._loop is None or self._pid != os.getpid():
            return
        if threading.get_ident() == self.thread:
            self._tasks["leave"] = self._loop.create_task(self._leave())
            return
        try:
            self._run(self._leave, _LEAVE_WITHIN)
        except LinkLost as error:
            _LOG.warning("%s: not closed properly: %s", self._dial.address.url, error)

    def wait_up(self, timeout: float) -> bool:
        """Whether there is a connection, after at most `timeout` [s]."""
        with self._changed:
            self._changed.wait_for(lambda: self.up is not None or self._closed, timeout)
        return self.up is not None

    def watch(self, beat: Heartbeat) -> None:
        """From now on drop connections on which the server is silent."""
        self._beat = beat
        self.post(self._start_watch)

    def post(self, callback: Callable[..., None], *args: object) -> None:
        """Run something on the network thread soon. Nothing happens before the first `connect`.

        Raises:
            LinkLost: Somebody ended that thread.
        """
        if self._loop is None:
            return
        try:
            self._loop.call_soon_threadsafe(callback, *args)
        except RuntimeError as error:
            raise self._thread_gone() from error

    def tell(self, request: Mapping[str, Any]) -> None:
        """Declare something now if there is a connection; the greeting of the next one contains it anyway."""
        self.post(self._tell, request["op"], request["id"], encode_frame(request))

    def require_process(self) -> None:
        """Raise `InvalidValue` in a forked child."""
        if self._pid != os.getpid():
            raise InvalidValue(
                f"This link to {self._dial.address.url} was made in process {self._pid}, and this is a fork of it. "
                "Make and connect a link in the child itself."
            )

    def _run(self, work: Callable[[], Coroutine[Any, Any, None]], timeout: float, *, withdraw: bool = False) -> None:
        if self._loop is None or self._loop.is_closed():
            raise self._thread_gone()
        running = asyncio.run_coroutine_threadsafe(work(), self._loop)
        try:
            running.result(timeout)
        except NoResultYet as error:
            raise LinkLost(
                f"{self._dial.address.url}: the network thread took nothing for {timeout:g} s. "
                "A listener must return at once: do work in another thread."
            ) from error
        finally:
            if withdraw:  # also after Ctrl-C: nobody would know of a connection that came about later
                running.cancel()

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost(f"{self._dial.address.url}: this link was closed. Make a new one.")

    def _thread_gone(self) -> LinkLost:
        return LinkLost(
            f"{self._dial.address.url}: the network thread, which all of roslibpy shares, was ended by somebody's "
            "terminate(). Make a new link, and end connections of roslibpy with close()."
        )

    # ---- the network thread

    async def _establish(self) -> None:
        deadline, delay = time.monotonic() + self._timeout, _FIRST_DELAY
        while True:
            try:
                first = await self._open(deadline - time.monotonic())
                break
            except NoServer as error:
                # What refuses may still be starting; everything else will stay as it is.
                if not isinstance(error.__cause__, ConnectionRefusedError) or time.monotonic() + delay >= deadline:
                    raise
            await asyncio.sleep(delay)
            delay = min(2 * delay, _LONGEST_DELAY)
            self._require_open()
        self._tasks["keep"] = asyncio.get_running_loop().create_task(self._keep(first))

    async def _keep(self, connection: Connection) -> None:
        delay = _FIRST_DELAY
        while not self._closed:
            since = time.monotonic()
            await asyncio.wait([connection.ending])
            # One that breaks at once, again and again, must not be tried again at once.
            if time.monotonic() - since > _STEADY:
                delay = _FIRST_DELAY
            while connection.error is not None:
                await asyncio.sleep(delay)
                delay = min(2 * delay, _LONGEST_DELAY)
                try:
                    connection = await self._open(self._timeout)
                except BamEnvsError as error:
                    self.why = bare_reason(self._dial.address.url, error)
                except Exception as error:  # whatever it was: a link that gives up is worse than one that tries again
                    _LOG.exception("%s: connecting failed", self._dial.address.url)
                    self.why = f"{type(error).__name__}: {error}"

    async def _open(self, timeout: float) -> Connection:
        connection = Connection(
            self._dial.address.url, self.epoch + 1, self._dial.max_message, self._on_message, self._on_end
        )
        server = await dial_server(self._dial, connection, timeout, self._clock)
        for request in self._declarations.greeting():
            frame = encode_frame(request)
            connection.announced[request["id"]] = frame
            try:
                connection.send(frame)
            except BamEnvsError as error:
                connection.drop(error)
                raise
        if self._closed:
            await connection.close()
        self._require_open()
        self.epoch, self.server = connection.epoch, server
        with self._changed:
            self.up = connection
            self._changed.notify_all()
        self._start_watch()
        return connection

    def _tell(self, operation: str, identity: str, frame: bytes) -> None:
        if self.up is None or self.up.announced.get(identity) == frame:
            return
        if operation.startswith("un"):
            self.up.announced.pop(identity, None)
        else:
            self.up.announced[identity] = frame
        try:
            self.up.send(frame)
        except LinkLost as error:
            _LOG.warning("%s was not declared: %s", identity, error)

    def _on_end(self, connection: Connection) -> None:
        if connection is not self.up:
            return
        error = connection.error or LinkLost(f"{connection.url}: the link dropped.")
        self.up, self.why = None, bare_reason(connection.url, error)
        tell_all(self.down_callbacks, LinkLost(str(error)))

    def _start_watch(self) -> None:
        if self._beat is not None and self.up is not None:
            if "watch" in self._tasks:
                self._tasks["watch"].cancel()
            self._tasks["watch"] = asyncio.get_running_loop().create_task(watch(self.up, self._beat))

    async def _leave(self) -> None:
        for name in ("keep", "watch"):
            if name in self._tasks:
                self._tasks[name].cancel()
        self.why = "it was closed; make a new one"
        connection, self.up = self.up, None
        with self._changed:
            self._changed.notify_all()
        if connection is not None:
            self._say_farewell(connection)
            await connection.close()

    def _say_farewell(self, connection: Connection) -> None:
        try:
            for request in self._declarations.farewell():
                connection.send(encode_frame(request))
        except LinkLost as error:
            _LOG.debug("no farewell: %s", error)


def _network() -> tuple[asyncio.AbstractEventLoop, int]:
    try:
        from bam_envs.rosbridge.link.protocol import network_loop
    except RuntimeError as error:
        raise InvalidValue(
            "Twisted is active in this process, and Autobahn, which roslibpy is built on, serves only one framework. "
            'Call roslibpy.set_default_transport("asyncio") before anything of roslibpy connects, '
            "or connect in a process of its own."
        ) from error
    return network_loop()
