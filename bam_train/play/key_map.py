"""What every key means: the one table, which the page of `bam-agent` reads too.

Keys have the names of a browser's ``event.code``, in terminals and windows too: ``KeyW``, ``ArrowUp``, ``PageUp``.
"""

import json
import math
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

Twist = tuple[float, float, float, float]
"""vx, vy, vz [m/s] and wz [rad/s] of the tool, or vx, vy, 0, wz of a base; vy is 0 unless it drives sideways."""
DIGITS = {f"Digit{digit}": digit for digit in range(10)}
CHANGES = {"Equal": 1, "Minus": -1}
"""The keys + and -."""
ARROWS = {"right": "ArrowRight", "up": "ArrowUp", "left": "ArrowLeft", "down": "ArrowDown"}
_SHORT = {
    "Period": ".",
    "Slash": "?",
    "Backspace": "⌫",
    "PageUp": "PgUp",
    "PageDown": "PgDn",
    "Equal": "+",
    "Minus": "-",
}
_SHORT |= {"ArrowUp": "↑", "ArrowDown": "↓", "ArrowLeft": "←", "ArrowRight": "→"}


@cache
def table() -> dict[str, Any]:
    """``keys.json``, which the page of `bam-agent` reads too.

    Moves (a name: its keys, vx, vy, vz, wz, gripper, whether a base has it, or one that drives ``sideways``), speeds
    [m/s], the speed of turning [rad/s], axes and buttons of a gamepad, and the keys that `bam-play` alone has.
    """
    path = Path(__file__).parents[1] / "agent" / "console" / "keys.json"
    read: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return read


@cache
def _move_of() -> dict[str, str]:
    return {key: name for name, (keys, *_) in table()["moves"].items() for key in keys}


def moved(keys: Iterable[str], speed: float, *, is_base: bool = False, sideways: bool = False) -> tuple[Twist, int]:
    """The twist of the keys that are held, and 1 to close the gripper, -1 to open it, 0 to leave it.

    The arithmetic is that of ``jogging.js``, bit for bit: moves add up, and no sum is faster than `speed` [m/s].
    """
    total = [0, 0, 0, 0, 0]
    for name in {_move_of()[key] for key in keys if key in _move_of()}:
        for at, value in enumerate(table()["moves"][name][1:6]):
            total[at] += value
    x, y, z, turn, grip = total
    twist = (x * speed, y * speed, z * speed, turn * table()["turn"])
    return bounded(twist, speed, is_base=is_base, sideways=sideways), _sign(grip)


def stick_moved(
    axes: Sequence[float], buttons: Sequence[bool], speed: float, *, is_base: bool, sideways: bool = False
) -> tuple[Twist, int]:
    """The same of a gamepad: `axes` are left x, left y, right x and right y from -1 to 1, up and left negative."""
    pad = table()["gamepad"]
    left_x, left_y, right_x, right_y = (0.0 if abs(one) < pad["dead"] else one for one in axes)
    twist = (-left_y * speed, -left_x * speed, -right_y * speed, -right_x * table()["turn"])
    twist = bounded(twist, speed, is_base=is_base, sideways=sideways)
    return twist, int(buttons[pad["close"]]) - int(buttons[pad["open"]])


def bounded(twist: Twist, speed: float, *, is_base: bool, sideways: bool = False) -> Twist:
    """The twist, no faster than `speed` [m/s]; of a base what it can do."""
    vx, vy, vz, turn = twist
    if is_base:
        vy, vz = vy if sideways else 0.0, 0.0
    length = math.sqrt(vx * vx + vy * vy + vz * vz)
    share = speed / length if length > speed else 1
    return vx * share, vy * share, vz * share, turn


def _sign(value: int) -> int:
    return (value > 0) - (value < 0)


def next_speed(speed: float) -> float:
    """The speed after this one [m/s]."""
    speeds: list[float] = table()["speeds"]
    return speeds[(speeds.index(speed) + 1) % len(speeds)]


def short(key: str) -> str:
    """A key as people call it: ``W``, ``↑``."""
    return _SHORT.get(key, key.removeprefix("Key").removeprefix("Digit"))


def move_lines(*, is_base: bool, sideways: bool = False) -> list[str]:
    """The key map of the moves, for the screen."""
    has = (True, "sideways") if sideways else (True,)
    rows = [(name, keys) for name, (keys, *_, base) in table()["moves"].items() if base in has or not is_base]
    return [f"{' '.join(map(short, keys)):<7} {name.lower()}" for name, keys in rows]


def control_lines() -> list[str]:
    """The other keys, for the screen."""
    return [f"{short(key):<7} {what}" for key, what in table()["controls"].items()]
