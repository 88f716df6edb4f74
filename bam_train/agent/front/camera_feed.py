"""Pictures of a robot's cameras for people who look: the newest of each camera, on a WebSocket of its own.

A camera is connected only while somebody looks. A picture is sent when the one before it was drawn, and later if that
took long: a slow link or a busy computer gets fewer pictures, never old ones, and the buttons of the page come first.
Commands have another socket, and wait for no picture.
"""

import asyncio
import contextlib
import io
import json
import threading
import time
from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from websockets.exceptions import ConnectionClosed

from bam_envs.core.errors import BamEnvsError, MissingExtra
from bam_envs.live.camera import LiveCamera, Pixels
from bam_envs.rosbridge.bus import Caller
from bam_envs.rosbridge.server.server_connection import BridgeConnection

_IMAGE_POLL_PERIOD, _RECONNECT_PERIOD, _KEEPALIVE_PERIOD = 0.02, 2.0, 1.0
"""Times between two looks at a camera, two attempts to connect it, and two signs of life to a page [s]."""
_QUICK, _LONGEST = 0.02, 0.5
"""Time to draw a picture above which pictures give way, and longest pause between two of them [s]."""
_QUALITY = 80
"""Quality of pictures that arrive uncompressed, and are sent as JPEG."""


class CameraFeed:
    """Serves the pictures of `cameras`, by their names; `serve` is a handler of a `Site`.

    A page gets ``{"cameras": [names], "seen": sizes}``, and then binary messages: the number of the camera (one byte)
    and a JPEG or PNG. It answers each with ``{"op": "next", "camera": number}``. ``{"camera": number, "error": text}``
    says why there are no pictures.

    Args:
        cameras: The cameras by name.
        seen: Width and height of the images that the policy sees [pixels], by the camera's name.
    """

    def __init__(self, cameras: Mapping[str, LiveCamera], seen: Mapping[str, tuple[int, int]] | None = None) -> None:
        self._names, self._readers = list(cameras), [_Reader(one) for one in cameras.values()]
        self._seen = dict(seen or {})
        self._viewers = 0

    async def serve(self, connection: BridgeConnection, caller: Caller) -> None:
        """Send pictures until the connection closes."""
        self._viewers += 1
        if self._viewers == 1:
            for reader in self._readers:
                reader.start()
        try:
            await self._show(connection)
        finally:
            self._viewers -= 1
            if self._viewers == 0:
                self.close()

    def close(self) -> None:
        """Disconnect the cameras. Idempotent."""
        for reader in self._readers:
            reader.stop()

    async def _show(self, connection: BridgeConnection) -> None:
        page, shown, told = PagePace(), [0] * len(self._names), [""] * len(self._names)
        await connection.send(json.dumps({"cameras": self._names, "seen": self._seen}))
        listening = asyncio.create_task(_listen(connection, page, len(self._names)))
        silent, turn = time.monotonic(), 0
        try:
            while not listening.done():
                for number, reader in enumerate(self._readers):
                    if reader.error != told[number]:
                        told[number] = reader.error
                        await connection.send(json.dumps({"camera": number, "error": reader.error}))
                for number in (*range(turn, len(shown)), *range(turn)):
                    at, data = self._readers[number].newest
                    if page.is_free and at != shown[number]:
                        shown[number], silent, turn = at, time.monotonic(), number + 1
                        page.sent(number)
                        await connection.send(bytes([number]) + data)
                await page.wait(_IMAGE_POLL_PERIOD)
                if time.monotonic() - silent > _KEEPALIVE_PERIOD:
                    await connection.send('{"event": "alive"}')
                    silent = time.monotonic()
        finally:
            listening.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await listening


class PagePace:
    """Whether a page has time for a picture; it gets one at a time, of whichever camera.

    After a picture it has as much time for something else as that took, and more if that was longer than `_QUICK`.

    Args:
        clock: Monotonic [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._drawn = clock, asyncio.Event()
        self._camera, self._sent, self._free = -1, 0.0, 0.0

    @property
    def is_free(self) -> bool:
        """Whether the next picture may be sent."""
        return self._camera < 0 and self._clock() >= self._free

    def sent(self, camera: int) -> None:
        """A picture of a camera is on its way."""
        self._camera, self._sent = camera, self._clock()
        self._drawn.clear()

    def drew(self, camera: int) -> None:
        """The page drew it."""
        if camera == self._camera:
            now = self._clock()
            took, self._camera = now - self._sent, -1
            self._free = now + min(took * max(1.0, took / _QUICK), _LONGEST)
            self._drawn.set()

    async def wait(self, longest: float) -> None:
        """Wait until the next picture may be sent; at most so long [s], also where it may be sent at once."""
        if self._camera >= 0:
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._drawn.wait(), longest)
        if self._camera < 0:
            pause = self._free - self._clock()
            await asyncio.sleep(min(pause, longest) if pause > 0 else longest)


class _Next(msgspec.Struct):
    op: str
    camera: int = -1


async def _listen(connection: BridgeConnection, page: PagePace, cameras: int) -> None:
    """Note which cameras' pictures were drawn, until the connection closes."""
    while True:
        with contextlib.suppress(msgspec.MsgspecError, RecursionError):  # also lists in lists in lists
            message = msgspec.json.decode(await connection.next_message(), type=_Next)
            if message.op == "next" and 0 <= message.camera < cameras:
                page.drew(message.camera)


class _Reader:
    """Reads one camera in a thread of its own."""

    def __init__(self, camera: LiveCamera) -> None:
        self._camera = camera
        self._stopped, self._thread = threading.Event(), threading.Thread()
        self.newest: tuple[int, bytes] = (0, b"")
        """Number and file of the newest picture; 0: there is none."""
        self.error = ""

    def start(self) -> None:
        self._stopped = stopped = threading.Event()
        self.newest, self.error = (0, b""), ""
        before = self._thread
        self._thread = threading.Thread(target=self._run, args=(stopped, before), name="bam-camera", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()

    def _run(self, stopped: threading.Event, before: threading.Thread) -> None:
        if before.ident is not None:
            before.join()  # it closes the camera
        while not stopped.is_set():
            self._attempt(stopped)

    def _attempt(self, stopped: threading.Event) -> None:
        """Read the camera until it fails; then wait a little."""
        try:
            self._camera.connect()
            self.error = ""
            self._read(stopped)
        except BamEnvsError as error:
            self.error = str(error)
            stopped.wait(_RECONNECT_PERIOD)
        finally:
            self._camera.close()

    def _read(self, stopped: threading.Event) -> None:
        seen = 0
        while not stopped.wait(_IMAGE_POLL_PERIOD):
            file = self._camera.file()
            if file is not None:
                number, _, data = file
            else:  # as it arrived, no browser draws it
                image = self._camera.latest()
                number, data = image.number, b"" if image.number == seen else jpeg(image.pixels)
            if number != seen:
                seen, self.newest = number, (number, data)


def jpeg(pixels: Pixels) -> bytes:
    """Colours, greys, or distances [m] (up to the farthest one) as a JPEG; `MissingExtra` without Pillow."""
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingExtra("pillow", "sim", "A picture of a camera that does not compress it") from error
    if pixels.dtype != np.uint8:
        known = np.nan_to_num(pixels, nan=0.0, posinf=0.0)
        pixels = (255.0 * known / max(float(known.max()), 1e-9)).astype(np.uint8)
    buffer, picture = io.BytesIO(), Image.fromarray(pixels[..., :3] if pixels.ndim == 3 else pixels)
    picture.save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()
