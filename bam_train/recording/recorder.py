"""The recorder of a deployment: it passes the numbers of each tick to another process, which encodes and writes them.

Topics of the file, as JSON with a schema:

=============  ======================================================================================
topic          content
=============  ======================================================================================
/state         each signal of the robot by label, SI units; ``stamp`` is the robot's own time [s]
/truth         values that only a simulation has, such as contacts
/observation   each number of the observation by name
/action        each number of the policy's action by name
/command       each number of the command that was sent, after the guards, by label, SI units
/status        ``code`` (0 is fine, else the guard's number) and the ``guard`` that changed the command
/latency       time of each stage of the tick, by name [s]
/episode       episode, step, reward, terminated, truncated and success
/events        foxglove.Log: actions of the operator, and messages to the operator
/sent          commands outside the ticks, with the state that each led to: on the way to the start pose of a
               live robot, and the last one before a fault
/camera/NAME   foxglove.CompressedImage
/pixels/NAME   foxglove.RawImage: an observation that is a picture
=============  ======================================================================================

The log time of a message is the wall clock; ``t`` in it is the monotonic clock [s]. All messages of a tick have the
same sequence number. /command and /status have the time at which the command was sent, a step before the state that it
led to. A number that is not finite is null. The metadata record ``deployment`` describes the deployment.
"""

import json
import logging
import os
import struct
import subprocess
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bam_train.errors import OutputError
from bam_train.recording.ring import EVENT, IMAGE, LAYOUT, PIXELS, TICK, TIMES, Ring, make_shared_file
from bam_train.signals import start_child

INFO, WARNING, ERROR = 2, 3, 4
"""Levels of events, as of foxglove.Log."""
_LOG = logging.getLogger(__name__)
_PROGRAM = "bam_train.recording.recorder_process:main"
_RING = 16 * 2**20
_START, _END = 20.0, 10.0  # maximum time for the start and the end of the process [s]
_CHECK = 64
"""Number of records between two checks that the process is alive."""


def number_names(arrays: Mapping[str, NDArray[Any]], labels: Iterable[str] | None = None) -> list[str]:
    """A name for each number of arrays (n, ...): the labels if there are as many, else such as ``name.0`` or ``0``."""
    names = [f"{name}.{i}".lstrip(".") for name, array in arrays.items() for i in range(int(np.prod(array.shape[1:])))]
    given = list(labels or ())
    return given if len(given) == len(names) else names


def number_kinds(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Dtype and shape of arrays (n, ...), without n, by name; JSON."""
    return json.dumps({name: [array.dtype.str, *array.shape[1:]] for name, array in arrays.items()})


class Camera(Protocol):
    """A camera whose images are recorded, such as `bam_envs.live.camera.LiveCamera`."""

    source: Any
    """Has its ``name``."""

    def file(self) -> tuple[int, str, bytes] | None:
        """Number, format and bytes of the newest image, or None."""

    def close(self) -> None:
        """Drop its connection."""


class Recorder:
    """Writes one MCAP file from another process; after `start`, only `close` waits for the disk.

    The first failure ends the recording: `fault` has its cause, and a warning is logged.

    Args:
        path: The file; an existing one is refused, missing folders are made.
        metadata: Text by name, for readers of the file; may be changed until `start`.
        guards: Titles of the guards, such as ``"joint speed (G8)"``, for `/status`.
        size: Size of the buffer for data that is not on the disk yet [bytes].
        others: Where there is a file at `path` already, the first of these files that is not there is made instead,
            and is `path` from `start` on.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, str] | None = None,
        guards: Sequence[str] = (),
        size: int = _RING,
        others: Sequence[Path] = (),
    ) -> None:
        self._paths = [path, *others]
        self.path, self.metadata, self.guards = path, dict(metadata or {}), ("", *guards)
        self._places = {title: place for place, title in enumerate(self.guards)}
        self._ring_size, self._writes = size, 0
        self._declared: dict[int, Any] = {}  # by series
        self._numbers: dict[int, int] = {}  # of a tick, by series
        self._fault = ""
        self._cameras: list[Camera] = []
        self._seen: list[int] = []
        self._ring: Ring | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the process and make the file.

        Raises:
            OutputError: The file cannot be made.
        """
        descriptor = make_shared_file(self._ring_size)
        self._ring = ring = Ring(descriptor)
        head = {"paths": [str(path) for path in self._paths], "metadata": self.metadata, "guards": self.guards}
        ring.write(json.dumps(head).encode())
        options = {"pass_fds": [descriptor], "stdout": subprocess.DEVNULL}
        try:
            self._process = start_child(_PROGRAM, str(descriptor), str(os.getpid()), **options)
        finally:
            os.close(descriptor)
        started = time.monotonic()
        while not ring.ready:
            if self._process.poll() is not None or ring.failure or time.monotonic() - started > _START:
                self._process.kill()
                self._process.wait()
                self._process = None
                raise OutputError(ring.failure or f"{self.path}: the recorder's process did not start")
            time.sleep(0.002)
        self.path = self._paths[ring.ready - 1]

    @property
    def pid(self) -> int:
        """Number of the process that writes the file; 0 before `start`."""
        return 0 if self._process is None else self._process.pid

    @property
    def fault(self) -> str:
        """Cause of the end of the recording; "" while it works."""
        return self._fault or ("" if self._ring is None else self._ring.failure)

    def place(self, guard: str) -> int:
        """Index of the guard with this title in `guards`, for a tick; 0 for none."""
        return self._places.get(guard, 0)

    def declare(
        self, layout: Mapping[str, Sequence[str]], extra: Mapping[str, str] | None = None, series: int = 0
    ) -> None:
        """Declare the numbers of a tick from now on.

        Args:
            layout: Topic to the names of its numbers, in the order of a tick; ``group.name`` is shown as a table.
            extra: Text by name for readers of the numbers, stored as the metadata record ``layout``.
            series: Number of the series of ticks; 0 for those of the loop.
        """
        content = {"layout": {topic: list(names) for topic, names in layout.items()}, "extra": dict(extra or {})}
        if content != self._declared.get(series):
            self._declared[series], self._numbers[series] = content, sum(map(len, layout.values()))
            self._write(LAYOUT, json.dumps(content).encode(), series=series)

    def tick(
        self, arrays: Iterable[NDArray[Any]], numbers: Sequence[float] = (), sent_ago: float = 0.0, series: int = 0
    ) -> None:
        """Record one tick, with the numbers in the order of the layout.

        Args:
            arrays: Arrays of any shape and numeric dtype, recorded as float64.
            numbers: The numbers after those of the arrays.
            sent_ago: Time since the command of this tick was sent [s].
            series: As in `declare`.
        """
        if self._fault:
            return
        data = [
            array.tobytes() if array.dtype == np.float64 else array.astype(np.float64).tobytes() for array in arrays
        ]
        content = b"".join((*data, struct.pack(f"={len(numbers)}d", *numbers)))
        declared = self._numbers.get(series, 0)
        if len(content) != 8 * declared:
            self._fail(f"{self.path}: a tick has {len(content) // 8} numbers, and {declared} were declared")
        self._write(TICK, content, sent_ago, series)

    def event(self, text: str, level: int = INFO) -> None:
        """Record an action of the operator, or a message to the operator."""
        self._write(EVENT, bytes([level]) + text.encode(errors="replace"))

    def image(self, camera: str, form: str, data: bytes) -> None:
        """Record one encoded image of a camera; `form` is its format: jpeg, png or webp.

        On a slow disk, images are left out first: half of the buffer is reserved for ticks.
        """
        self._write_picture(IMAGE, [camera, form], data)

    def watch(self, camera: Camera) -> None:
        """Record each new image of `camera` that `look` finds; `close` closes it."""
        self._cameras.append(camera)
        self._seen.append(0)

    def look(self) -> None:
        """Record the new images of the watched cameras."""
        for place, camera in enumerate(self._cameras):
            number, form, data = camera.file() or (self._seen[place], "", b"")
            if number != self._seen[place]:
                self._seen[place] = number
                self.image(camera.source.name, form, data)

    def pixels(self, name: str, pixels: NDArray[np.uint8]) -> None:
        """Record a picture without loss. Shape: (height, width, 1, 3 or 4), grey, RGB or RGBA."""
        self._write_picture(PIXELS, [name, *pixels.shape], pixels.tobytes())

    def _write_picture(self, kind: bytes, head: list[Any], data: bytes) -> None:
        if self._ring is not None and self._ring.room - len(data) > self._ring_size / 2:
            self._write(kind, json.dumps(head).encode() + b"\n" + data)

    def _write(self, kind: bytes, data: bytes, ago: float = 0.0, series: int = 0) -> None:
        if self._fault or self._ring is None:
            return
        self._writes += 1
        if not self._ring.write(b"".join((kind, TIMES.pack(time.time_ns(), time.monotonic(), ago, series), data))):
            self._fail(self._ring.failure or f"{self.path}: the disk is too slow; nothing is recorded from now on")
        elif self._writes % _CHECK == 0 and (fault := self._status()):
            self._fail(fault)

    def _status(self) -> str:
        """Cause of an early end of the process; "" while it runs."""
        status = None if self._process is None else self._process.poll()
        if status is None or self.fault:
            return self.fault
        return f"{self.path}: the recorder's process ended with status {status}; nothing is recorded from now on"

    def _fail(self, fault: str) -> None:
        if not self._fault:
            self._fault = fault
            _LOG.warning("%s", fault)
            if self._ring is not None:
                self._ring.close()

    def close(self) -> str:
        """End the file, wait for it, and return `fault`; idempotent."""
        for camera in self._cameras:
            camera.close()
        if self._process is None or self._ring is None:
            return self.fault
        early = "" if self._ring.closed else self._status()
        self._ring.close()
        try:
            self._process.wait(_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            early = f"{self.path}: the recorder did not end within {_END:g} s; the end of the recording is missing"
        if self._process.returncode and not early:
            status = self._process.returncode
            early = (
                f"{self.path}: the recorder's process ended with status {status}; the end of the recording is missing"
            )
        if early or self.fault:
            self._fail(self._ring.failure or early)
        return self.fault
