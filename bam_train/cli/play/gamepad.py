"""A gamepad of Linux (/dev/input/js*), without any library."""

import os
import struct
from contextlib import suppress
from pathlib import Path

from bam_train.play.key_map import table

_EVENT = struct.Struct("IhBB")  # time [ms], value, kind, number
_BUTTON, _AXIS = 1, 2
DEVICES = Path("/dev/input")


class Gamepad:
    """The first gamepad that there is, looked for at every `poll` until it is found.

    Args:
        folder: Where its device is.
    """

    def __init__(self, folder: Path = DEVICES) -> None:
        self._folder = folder
        self._device: int | None = None
        self._axes, self._buttons = [0.0] * 16, [False] * 32

    def poll(self) -> str:
        """Read what it did since the last look; ``"came"``, ``"gone"`` when it was pulled out, else an empty text."""
        if self._device is None:
            return self._find()
        try:
            while data := os.read(self._device, 64 * _EVENT.size):
                for _, value, kind, number in _EVENT.iter_unpack(data[: len(data) // _EVENT.size * _EVENT.size]):
                    if kind & _BUTTON and number < len(self._buttons):
                        self._buttons[number] = bool(value)
                    elif kind & _AXIS and number < len(self._axes):
                        self._axes[number] = max(-1.0, value / 32767)
        except BlockingIOError:
            return ""
        except OSError:
            pass  # as at the end of the file: it is gone
        self.close()
        return "gone"

    def _find(self) -> str:
        for path in sorted(self._folder.glob("js*")):
            with suppress(OSError):
                self._device = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
                return "came"
        return ""

    @property
    def state(self) -> tuple[list[float], list[bool]] | None:
        """Left x and y, right x and y from -1 to 1, and the buttons; None unless the enabling button is held."""
        pad = table()["gamepad"]
        axes = [self._axes[one] for one in pad["linux_axes"]]
        return (axes, self._buttons) if self._buttons[pad["enable"]] else None

    @property
    def stops(self) -> bool:
        """Whether the stop button is held."""
        return bool(self._buttons[table()["gamepad"]["stop"]])

    def close(self) -> None:
        """Let it go. Idempotent."""
        if self._device is not None:
            os.close(self._device)
        self._device = None
        self._axes, self._buttons = [0.0] * 16, [False] * 32
