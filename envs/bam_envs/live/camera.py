"""A live robot's camera: the newest image, decoded when it is asked for, on a connection of its own.

Images, compressed or raw, come as CBOR, on a connection and in a thread of their own: as JSON a raw one costs more time
than a control period, and a compressed one holds up the commands and states behind it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError, ResetNeeded, StaleState
from bam_envs.live.mailbox import Letter, Mailbox
from bam_envs.live.state import SourceAge
from bam_envs.ros.images import message_bytes, read_color_message, read_depth_message
from bam_envs.ros.messages import read_stamp, require_message
from bam_envs.ros.profile_tables import CameraSource
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint

Pixels = NDArray[Any]
FIRST_IMAGE = 3.0
"""Longest that a first image is waited for [s]."""
_LOOK_AGAIN = 0.01
_COLOURS: dict[str, tuple[int, list[int]]] = {
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2, 3]),
    "bgra8": (4, [2, 1, 0, 3]),
    "mono8": (1, [0]),
    "8UC1": (1, [0]),
    "8UC3": (3, [2, 1, 0]),
}
"""Encodings of raw images: bytes a pixel, and their order as RGB."""
_DEPTHS = ("16UC1", "mono16", "32FC1")


@dataclass(frozen=True)
class CameraImage:
    """One image."""

    pixels: Pixels
    """uint8, (height, width, 3 or 4) RGB or RGBA, (height, width) if grey; depth: float32, (height, width) [m]."""
    stamp: float | None
    """When it was taken, on the camera's clock [s]; None if it does not say."""
    number: int
    """Counts the images that came."""


class _Feed:
    """The newest image of one topic, on a connection and in a thread of its own."""

    def __init__(self, endpoint: Endpoint, topic: str, kind: str, clock: Callable[[], float]) -> None:
        mailbox = self._mailbox = Mailbox(clock)
        self._link = RosbridgeLink(endpoint, name="camera")
        self._link.subscribe(topic, kind, lambda message, caller: mailbox.put(("",), message), compression="cbor")

    def open(self) -> None:
        self._link.connect()

    def newest(self) -> Letter | None:
        return self._mailbox.newest().get("")

    def close(self) -> None:
        self._link.close()


class LiveCamera:
    """One camera behind a rosbridge server.

    Args:
        url: As of the robot: its namespace goes before the camera's topic.
        source: The camera, as a profile describes it.
        ca_file: PEM file of the authorities to trust instead of the system's.
        token: Shared secret of the server.
        clock: Monotonic clock [s].
    """

    def __init__(
        self,
        url: str,
        source: CameraSource,
        *,
        ca_file: str | None = None,
        token: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.source, self.url = source, url
        self._topic = Endpoint(url).address.namespace + source.topic
        self._ca_file, self._token, self._clock = ca_file, token, clock
        self._feed: _Feed | None = None
        self._decoded: CameraImage | None = None
        self._age, self._judged = SourceAge(0.0), 0  # and the number of the image that was judged last

    def connect(self) -> None:
        """Open a connection for this camera, and wait for its first image. Doing it twice is once.

        Raises:
            NoServer: There is no usable server.
            StaleState: No image came.
        """
        if self._feed is not None:
            return
        feed, self._decoded = self._new_feed(), None
        self._age, self._judged = SourceAge(0.0), 0
        try:
            feed.open()
            self._await_first(feed)
        except BaseException:
            feed.close()
            raise
        self._feed = feed

    def _new_feed(self) -> _Feed:
        endpoint = Endpoint(self.url, self._ca_file, self._token)
        return _Feed(endpoint, self._topic, self.source.type, self._clock)

    def _await_first(self, feed: _Feed) -> None:
        deadline = time.monotonic() + FIRST_IMAGE
        while feed.newest() is None:
            if time.monotonic() > deadline:
                raise StaleState(
                    f"{self._topic} ({self.source.type}): no image in {FIRST_IMAGE:g} s. "
                    "Does the camera run, and is the topic called so?"
                )
            time.sleep(_LOOK_AGAIN)

    def latest(self) -> CameraImage:
        """The newest image; decoded at most once.

        Raises:
            ResetNeeded: Not connected.
            StaleState: It is older than the profile allows.
            ProtocolError: It is no image.
            MissingExtra: Neither OpenCV nor Pillow is installed.
        """
        letter = None if self._feed is None else self._feed.newest()
        if letter is None:
            raise ResetNeeded(f"The camera {self.source.name} at {self.url} is not connected. Call connect() first.")
        self._judge(letter)
        age, limit = self._age.at(self._clock()), self.source.max_age
        if age > limit:
            what = f"{self._topic}: the newest image is {age:.3f} s old, and at most {limit:g} s are allowed."
            raise StaleState(what, age, limit)
        if self._decoded is None or self._decoded.number != letter.number:
            self._decoded = self._decode(letter)
        return self._decoded

    def _judge(self, letter: Letter) -> None:
        """An image is as old as its stamp says, beside the quickest one: a link that hung delivers old ones anew."""
        if letter.number != self._judged:
            stamp = read_stamp(require_message(letter.message, self._topic), self._topic)
            self._age.look(letter.arrived, stamp, None)
            self._judged = letter.number

    def _decode(self, letter: Letter) -> CameraImage:
        message = require_message(letter.message, self._topic)
        return CameraImage(decode_pixels(message, self._topic), read_stamp(message, self._topic), letter.number)

    def close(self) -> None:
        """Drop the connection. As often as one likes."""
        feed, self._feed = self._feed, None
        if feed is not None:
            feed.close()


def decode_pixels(message: Mapping[str, Any], where: str) -> Pixels:
    """The pixels of a CompressedImage or a raw Image; see `CameraImage`.

    Raises:
        ProtocolError: It is neither; `where` names it.
    """
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
    channels, order = _COLOURS[encoding]
    try:
        rows = np.frombuffer(message_bytes(message), np.uint8).reshape(message["height"], -1)
        pixels = rows[:, : message["width"] * channels].reshape(message["height"], message["width"], channels)
    except (KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"data must be height x width pixels of {channels} bytes: {error}.") from error
    return np.ascontiguousarray(pixels[:, :, 0] if channels == 1 else pixels[:, :, order])
