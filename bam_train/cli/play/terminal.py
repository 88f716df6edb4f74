"""A terminal as keyboard and screen, also over SSH. It sends no releases: a key is held while it is repeated."""

import os
import re
import select
import sys
import termios
import time
import tty
from collections.abc import Sequence
from contextlib import ExitStack

from bam_train.files.log_lines import shown
from bam_train.signals import at_quit

_TOKEN = re.compile(rb"\x1b[\[O][0-9;]*[A-Za-z~]|\x1b|[^\x1b]")
_CUT = re.compile(rb"\x1b(?:[\[O][0-9;]*)?$")
_NAMES = {
    **{b"\x1b[" + end: key for end, key in ((b"5~", "PageUp"), (b"6~", "PageDown"))},
    **{
        begin + end: key
        for begin in (b"\x1b[", b"\x1bO")
        for end, key in ((b"A", "ArrowUp"), (b"B", "ArrowDown"), (b"C", "ArrowRight"), (b"D", "ArrowLeft"))
    },
    **{bytes([one]): f"Key{chr(one).upper()}" for one in b"abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ"},
    **{bytes([one]): f"Digit{chr(one)}" for one in b"0123456789"},
    b" ": "Space",
    b"\r": "Enter",
    b"\n": "Enter",
    b"\x7f": "Backspace",
    b"\x08": "Backspace",
    b".": "Period",
    b"?": "Slash",
    b"/": "Slash",
    b"+": "Equal",
    b"=": "Equal",
    b"-": "Minus",
    b"_": "Minus",
}
_ENTER, _LEAVE = b"\x1b[?1049h\x1b[?25l", b"\x1b[?25h\x1b[?1049l"  # the other screen, without a cursor; and back


def keys_in(data: bytes) -> tuple[list[str], bytes]:
    """The keys in what a terminal sent, and the beginning of one that is cut off."""
    cut = _CUT.search(data)
    whole, rest = (data, b"") if cut is None else (data[: cut.start()], data[cut.start() :])
    return [_NAMES[one] for one in _TOKEN.findall(whole) if one in _NAMES], rest


class Terminal:
    """The terminal that is standard input, while the ``with`` block runs; its settings come back however that ends.

    Args:
        draws: Whether there is a screen to `show`, if standard error is a terminal.
    """

    def __init__(self, *, draws: bool = True) -> None:
        self._in, self._out = sys.stdin.fileno(), sys.stderr.fileno()
        self._draws = draws and sys.stderr.isatty()
        self._rest = b""
        self._keys: list[tuple[str, float]] = []
        self.let: list[str] = []
        """The keys that were let go since the last look: none, a terminal does not say."""
        self._stack = ExitStack()

    def __enter__(self) -> "Terminal":
        before = termios.tcgetattr(self._in)

        def restore() -> None:
            termios.tcsetattr(self._in, termios.TCSADRAIN, before)
            if self._draws:
                os.write(self._out, _LEAVE)

        self._stack.callback(restore)
        self._stack.enter_context(at_quit(restore))
        tty.setcbreak(self._in)
        raw = termios.tcgetattr(self._in)
        raw[0] &= ~termios.IXON  # Ctrl-S would stop the screen, and with it the commands
        raw[6][termios.VSUSP] = b"\0"  # so would Ctrl-Z
        termios.tcsetattr(self._in, termios.TCSADRAIN, raw)
        if self._draws:
            os.write(self._out, _ENTER)
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def wait(self, seconds: float) -> None:
        """Wait so long [s], and note what is pressed meanwhile, and when."""
        end = time.monotonic() + seconds
        while select.select([self._in], [], [], max(0.0, end - time.monotonic()))[0]:
            data = os.read(self._in, 4096)
            keys, self._rest = keys_in(self._rest + data)
            now = time.monotonic()
            self._keys += [(key, now) for key in keys] if data else [("KeyX", now)]  # the terminal is gone
            if not data:
                return

    def take(self) -> list[tuple[str, float, bool]]:
        """What was pressed since the last look: key, time [s, monotonic], and False for a key without a release."""
        taken, self._keys = [(key, at, False) for key, at in self._keys], []
        return taken

    @property
    def size(self) -> tuple[int, int]:
        """Columns and lines; a terminal may say 0 for both."""
        columns, lines = os.get_terminal_size(self._out) if self._draws else (0, 0)
        return columns or 100, lines or 40

    def show(self, lines: Sequence[str], picture: object = None) -> None:
        """Draw the screen, unless the terminal has not taken the last one yet."""
        if self._draws and select.select([], [self._out], [], 0.0)[1]:
            text = "".join(f"{shown(line)}\x1b[K\n" for line in lines[:-1]) + f"{shown(lines[-1])}\x1b[K"
            os.write(self._out, b"\x1b[H" + text.encode(errors="replace") + b"\x1b[J")
