"""A window as keyboard and screen, with a picture of the environment; tkinter comes with Python."""

import time
import tkinter
import tkinter.font
from collections.abc import Sequence
from typing import Any

import numpy as np

_NAMES = {"Prior": "PageUp", "Next": "PageDown", "space": "Space", "Return": "Enter", "BackSpace": "Backspace"}
_NAMES |= {"period": "Period", "question": "Slash", "slash": "Slash", "plus": "Equal", "equal": "Equal"}
_NAMES |= {"minus": "Minus", "underscore": "Minus", "KP_Add": "Equal", "KP_Subtract": "Minus"}
_NAMES |= {way: f"Arrow{way}" for way in ("Up", "Down", "Left", "Right")}
_MOST = (160, 80)  # columns and lines
_FRAME = 80  # what a screen has around a window, such as its title and a bar [pixels]
_KEY_REPEAT_PAUSE = 30  # a release that a press follows within this time [ms] is X's own repetition of a key


def key_of(keysym: str) -> str:
    """Tk's name of a key as a browser's; "" for one without a meaning here."""
    if len(keysym) == 1 and keysym.isascii() and keysym.isalnum():
        return f"Digit{keysym}" if keysym.isdigit() else f"Key{keysym.upper()}"
    return _NAMES.get(keysym, "")


class PlayWindow:
    """The window, as long as the ``with`` block runs.

    Args:
        title: Its title.
    """

    def __init__(self, title: str) -> None:
        self._root = tkinter.Tk()
        self._root.title(title)
        self._root.protocol("WM_DELETE_WINDOW", lambda: self._keys.append(("KeyX", time.monotonic(), True)))
        self._image: Any = None
        self._picture = tkinter.Label(self._root)
        self._picture.pack(side="left", anchor="n")
        self._font = tkinter.font.Font(self._root, family="monospace", size=9)
        self._text = tkinter.Label(self._root, font=self._font, justify="left", anchor="nw")
        self._text.pack(side="left", fill="both", expand=True)
        self._keys: list[tuple[str, float, bool]] = []
        self._ups: dict[str, str] = {}
        self.let: list[str] = []
        """The keys that were let go since the last look."""
        self._root.bind("<KeyPress>", self._down)
        self._root.bind("<KeyRelease>", self._up)
        self._root.bind("<FocusOut>", lambda event: self.let.append(""))

    def __enter__(self) -> "PlayWindow":
        return self

    def __exit__(self, *error: object) -> None:
        self._root.destroy()

    def _down(self, event: Any) -> None:
        key = key_of(event.keysym)
        if key in self._ups:
            self._root.after_cancel(self._ups.pop(key))
        if key and not event.state & 0x0C:  # neither Ctrl nor Alt
            self._keys.append((key, time.monotonic(), True))

    def _up(self, event: Any) -> None:
        key = key_of(event.keysym)
        self._ups[key] = self._root.after(_KEY_REPEAT_PAUSE, self._let, key)

    def _let(self, key: str) -> None:
        self._ups.pop(key, None)
        self.let.append(key)

    def wait(self, seconds: float) -> None:
        """Wait so long [s], and note what is pressed meanwhile, and when."""
        over = tkinter.BooleanVar(self._root)
        self._root.after(max(1, round(1000 * seconds)), lambda: over.set(True))
        self._root.wait_variable(over)

    def take(self) -> list[tuple[str, float, bool]]:
        """What was pressed since the last look: key, time [s, monotonic], and True: its release will be told."""
        taken, self._keys = self._keys, []
        return taken

    @property
    def size(self) -> tuple[int, int]:
        """Columns and lines that fit beside the picture: on the screen, or in a window that was made smaller."""
        screen = self._root.winfo_screenwidth() - _FRAME, self._root.winfo_screenheight() - _FRAME
        window = self._root.winfo_width(), self._root.winfo_height()
        wanted = self._root.winfo_reqwidth(), self._root.winfo_reqheight()
        width, height = (min(a, b) if 1 < b < c else a for a, b, c in zip(screen, window, wanted, strict=True))
        columns = (width - self._picture.winfo_reqwidth() - _FRAME // 8) // self._font.measure("0")
        lines = (height - _FRAME // 8) // self._font.metrics("linespace")
        return max(20, min(_MOST[0], columns)), max(5, min(_MOST[1], lines))

    def show(self, lines: Sequence[str], picture: Any = None) -> None:
        """Draw the text, and a picture (h, w, 3) uint8 beside it."""
        self._text.configure(text="\n".join(lines))
        if picture is not None:
            data = np.ascontiguousarray(picture, np.uint8)
            header = f"P6 {data.shape[1]} {data.shape[0]} 255\n".encode()
            self._image = tkinter.PhotoImage(data=header + data.tobytes(), format="PPM")
            self._picture.configure(image=self._image)
