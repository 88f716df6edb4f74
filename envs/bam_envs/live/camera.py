"""A live robot's camera: the newest image, decoded on request.

Images, compressed or raw, arrive as CBOR on a separate connection with its own thread: as JSON a raw one takes longer
than a control period, and a compressed one delays the commands and states behind it.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError, ResetNeeded, StaleState
from bam_envs.live.state import Letter, Mailbox, SourceAge
from bam_envs.ros.images import SIGNATURES, message_bytes, read_color_message, read_depth_message, resized
from bam_envs.ros.messages import read_stamp
from bam_envs.ros.profile_tables import CameraSource
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint

Pixels = NDArray[Any]
FIRST_IMAGE = 3.0
"""Longest wait for a first image, unless the endpoint has a timeout [s]."""
_SLOT = "image"
_COLOURS = {
    "rgb8": [0, 1, 2],
    "bgr8": [2, 1, 0],
    "rgba8": [0, 1, 2, 3],
    "bgra8": [2, 1, 0, 3],
    "mono8": [0],
    "8UC1": [0],
    "8UC3": [2, 1, 0],
}
"""Encodings of raw images: which byte of a pixel is red, green, blue and alpha."""
_DEPTHS = ("16UC1", "mono16", "32FC1")


@dataclass(frozen=True)
class CameraImage:
    """One image."""

    pixels: Pixels
    """uint8, (height, width, 3 or 4) RGB or RGBA, (height, width) if grey; depth: float32, (height, width) [m]."""
    stamp: float | None
    """Time when it was taken, on the camera's clock [s]; None without a stamp."""
    number: int
    """Number of images that have arrived, this one included."""


class LiveCamera:
    """One camera of a profile behind a rosbridge server; the namespace of `endpoint` goes before its topic."""

    def __init__(
        self, endpoint: Endpoint | str, source: CameraSource, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._endpoint = Endpoint(endpoint) if isinstance(endpoint, str) else endpoint
        self.source, self.url = source, self._endpoint.url
        self._topic, self._clock = self._endpoint.address.namespace + source.topic, clock
        self._link: RosbridgeLink | None = None
        self._mailbox, self._age = Mailbox(clock), SourceAge(0.0)
        self._decoded: CameraImage | None = None

    def connect(self) -> None:
        """Open a connection for this camera, and wait for its first image, else `StaleState`. Idempotent."""
        if self._link is not None:
            return
        self._mailbox = mailbox = Mailbox(self._clock)
        self._age, self._decoded = SourceAge(0.0), None
        link = RosbridgeLink(self._endpoint, name="camera")
        link.subscribe(
            self._topic, self.source.type, lambda message, caller: mailbox.put([_SLOT], message), compression="cbor"
        )
        try:
            link.connect()
            timeout = self._endpoint.timeout or FIRST_IMAGE
            if not mailbox.wait_for(bool, timeout):
                raise StaleState(
                    f"{self._topic} ({self.source.type}): no image in {timeout:g} s. "
                    "Does the camera run, and is the topic called so?"
                )
        except BaseException:
            link.close()
            raise
        self._link = link

    def latest(self) -> CameraImage:
        """The newest image; each is decoded at most once.

        Raises:
            StaleState: It is older than the profile allows.
            ProtocolError: It is not an image.
            MissingExtra: Pillow is not installed.
        """
        image, age, limit = self._newest(), self._age.at(self._clock()), self.source.max_age
        if age > limit:
            what = f"{self._topic}: the newest image is {age:.3f} s old, and at most {limit:g} s are allowed."
            raise StaleState(what, age, limit)
        return image

    def taken_at(self, stamp: float, timeout: float, ends: Callable[[], bool]) -> CameraImage:
        """The newest image, once one with this stamp or a later one has come: its age is that of the state.

        `StaleState` if none comes within `timeout` [s], or before the wait `ends`; else as `latest`.
        """

        def came(slots: Mapping[str, Letter]) -> bool:
            taken = None if _SLOT not in slots else read_stamp(slots[_SLOT].message, self._topic)
            return taken is not None and taken >= stamp

        last = time.monotonic() + timeout
        while not self._mailbox.wait_for(came, self.source.max_age):
            if ends() or time.monotonic() > last:
                raise StaleState(f"{self._topic}: no image of the newest state in {timeout:g} s. Does the camera run?")
        return self._newest()

    def _newest(self) -> CameraImage:
        """The newest image, however old."""
        letter = None if self._link is None else self._mailbox.newest().get(_SLOT)
        if letter is None:
            raise ResetNeeded(f"The camera {self.source.name} at {self.url} is not connected. Call connect() first.")
        # Compared with the quickest image by their stamps: a link that hung delivers old images late.
        self._age.look(letter, self._topic, None)
        if self._decoded is None or self._decoded.number != letter.number:
            pixels = decode_pixels(letter.message, self._topic)
            self._decoded = CameraImage(pixels, self._age.stamp, letter.number)
        return self._decoded

    def file(self) -> tuple[int, str, bytes] | None:
        """Number, ``"png"`` or ``"jpeg"``, and bytes of the newest image, as they arrived; None for anything else."""
        letter = None if self._link is None else self._mailbox.newest().get(_SLOT)
        if letter is None or "data" not in letter.message or "encoding" in letter.message:
            return None
        try:
            data = message_bytes(letter.message)
        except ProtocolError:
            return None
        form = next((name for name, start in SIGNATURES.items() if data.startswith(start)), None)
        return None if form is None else (letter.number, form, data)

    def close(self) -> None:
        """Drop the connection. Idempotent."""
        link, self._link = self._link, None
        if link is not None:
            link.close()


def fitted(pixels: Pixels, box: spaces.Box) -> Pixels:
    """An image as a task sees it: the middle, as wide to high as `box` (height, width, channels), in its size; a copy.

    Colours are averaged; distances and ids are not. A distance of 0, which stands for no measurement, counts as the
    farthest, as where a simulation sees nothing.

    Raises:
        ProtocolError: Colours are expected and it is grey, or the other way round.
        MissingExtra: It has another size, and Pillow is not installed.
    """
    wanted_height, wanted_width, channels = box.shape
    image = pixels[:, :, None] if pixels.ndim == 2 else pixels[:, :, :channels]
    if image.shape[2] != channels or image.dtype != box.dtype:
        found = f"{image.dtype} with {image.shape[2]} channels"
        raise ProtocolError(f"An image must be {box.dtype} with {channels} channels, not {found}.")
    height, width = image.shape[:2]
    if (height, width) != (wanted_height, wanted_width):
        scale = min(height / wanted_height, width / wanted_width)
        high, wide = round(scale * wanted_height), round(scale * wanted_width)
        top, left = (height - high) // 2, (width - wide) // 2
        middle = image[top : top + high, left : left + wide]
        image = resized(middle, wanted_height, wanted_width, smooth=channels == 3)
    if image.dtype == np.float32:
        image = np.where(image == 0.0, box.high.flat[0], image)
    fit: Pixels = np.clip(image, box.low, box.high)
    return fit


def decode_pixels(message: Mapping[str, Any], where: str) -> Pixels:
    """The pixels of a CompressedImage or a raw Image, see `CameraImage`; `ProtocolError` for anything else."""
    try:
        pixels = _raw(message) if "encoding" in message else read_color_message(message)
    except ProtocolError as error:
        raise ProtocolError(f"{where}: {error}") from error
    if pixels is None or pixels.size == 0:
        raise ProtocolError(f"{where}: the image is empty.")
    return pixels


def _raw(message: Mapping[str, Any]) -> Pixels | None:
    encoding = str(message["encoding"])
    if encoding in _DEPTHS:
        return read_depth_message(message)
    if encoding not in _COLOURS:
        raise ProtocolError(f"encoding must be one of {', '.join([*_COLOURS, *_DEPTHS])}, not {encoding!r}.")
    order = _COLOURS[encoding]
    try:
        rows = np.frombuffer(message_bytes(message), np.uint8).reshape(message["height"], -1)
        pixels = rows[:, : message["width"] * len(order)].reshape(message["height"], message["width"], len(order))
    except (KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"data must be height x width pixels of {len(order)} bytes: {error}.") from error
    return np.ascontiguousarray(pixels[:, :, 0 if len(order) == 1 else order])
