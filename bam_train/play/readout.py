"""What the screen shows of a session: every number with its name, unit and limits, and how it went lately."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from bam_train.play.key_map import control_lines
from bam_train.play.session import PLOTTED, Session, flat_numbers

_FEW = 8  # most numbers of an info that are shown
_BARS = "▁▂▃▄▅▆▇█"


def sparkline(values: Iterable[float]) -> str:
    """A plot in one line, from the lowest value to the highest: ``▁▃▅█``; what reads equal (0.001) is flat."""
    numbers = np.array(list(values), np.float64)
    finite = numbers[np.isfinite(numbers)]
    if not finite.size:
        return ""
    low, span = finite.min(), max(float(np.ptp(finite)), 1e-3)
    heights = np.nan_to_num((numbers - low) / span * (len(_BARS) - 1), posinf=len(_BARS) - 1, neginf=0)
    return "".join(_BARS[int(height)] for height in np.clip(heights, 0, len(_BARS) - 1))


def screen_lines(session: Session, title: str, width: int = 100, height: int = 40) -> list[str]:
    """The session as lines of at most `width` characters, at most `height` of them.

    On a low screen numbers stand side by side, without units, limits and plots.
    """
    keys = [*session.hand.lines(), *control_lines()] if session.help else []
    lines, low = [*_state(session, title, width), *keys], list[str]()
    low += lines
    for what, numbers in _numbers(session).items():
        lines += ["", what, *(f"  {number}  {more}" for number, more in numbers)]
        low += [what, *_beside(numbers, width)]
    lines = lines if len(lines) <= height else low
    if len(lines) > height:
        lines = [*lines[: height - 1], f"… {len(lines) - height + 1} more lines on a higher screen"]
    return [line[:width].rstrip() for line in lines]


def _state(session: Session, title: str, width: int) -> list[str]:
    marks = [
        session.status,
        f"{session.driver} drives",
        f"{session.speed:.2f} m/s",
        *(["slow"] if session.slow else []),
    ]
    if session.hand.waits:
        marks = ["every press is a step", f"{session.driver} drives"]
    elif session.status == "paused" and session.is_live:
        marks[0] = "paused: the robot holds"
    time = f"step {session.steps} ({session.steps * session.period:.2f} s)"
    rewards = f"reward {session.reward:+.3f}, return {session.total:.2f}"
    plot = sparkline(step["reward"] for step in session.past)
    is_ready = session.status == "ready" and not session.hand.waits
    first_key = f"{session.hand.lines()[0].split()[0]} or another key starts time; " if is_ready else ""
    usual = f"{first_key}? shows the keys"
    first = _wrapped([title, f"seed {session.seed}", time, f"{rewards} {plot}"], width)
    return [*first, *_wrapped([f"[{', '.join(marks)}]", session.note or usual], width)]


def _wrapped(parts: Sequence[str], width: int) -> list[str]:
    """The parts beside each other, on as many lines as they need."""
    lines = [parts[0]]
    for part in parts[1:]:
        fits = len(lines[-1]) + 2 + len(part.rstrip()) <= width
        lines[-1:] = [f"{lines[-1]}  {part}"] if fits else [lines[-1], part]
    return lines


def _numbers(session: Session) -> dict[str, list[tuple[str, str]]]:
    """Each number of action, info and observation, and what is to be said of it.

    What a policy would do stands beside the action.
    """
    describe = getattr(session.env.unwrapped, "describe", None)
    signals: Mapping[str, Any] = {} if describe is None else describe()
    acted = [] if session.action is None else np.ravel(session.action).tolist()
    wanted = [] if session.suggestion is None else np.ravel(session.suggestion).tolist()
    rows, action, info = signals.get("action", ()), [], []
    for at in range(max(len(acted), len(wanted))):
        value = _text(acted[at]) if at < len(acted) else ""
        policy = f"  policy {_text(wanted[at]):>7}" if at < len(wanted) else ""
        action.append((f"{_name(rows, at)} {value:>9}{policy}", _limits(rows, at)))
    for name, one in session.info.items():
        number = float(one) if isinstance(one, (bool, int, float)) else one
        if isinstance(number, (float, str)):
            info.append((f"{name:<24.24} {_text(number):>9}", _plot(session, f"info {name}")))
        elif isinstance(number, np.ndarray) and number.size <= _FEW:
            info.append((f"{name:<24.24} {' '.join(map(_text, np.ravel(number).tolist()))}", ""))
    rows, seen = signals.get("observation", ()), []
    for at, one in enumerate(flat_numbers(session.observation)):
        plot = f"{_plot(session, f'observation {at}'):<{PLOTTED}}"
        seen.append((f"{_name(rows, at)} {_text(one):>9}", _limits(rows, at, plot)))
    does = f", and what the policy {'does' if session.driver == 'policy' else 'would do'}" if wanted else ""
    return {f"action{does}": action, "info": info, "observation": seen}


def _beside(numbers: Sequence[tuple[str, str]], width: int) -> list[str]:
    """The numbers alone, as many of them beside each other as fit."""
    cell = max((len(one) for one, _ in numbers), default=0)
    count = max(1, width // (cell + 2))
    cells = [f"  {one:<{cell}}" for one, _ in numbers]
    return ["".join(cells[at : at + count]) for at in range(0, len(cells), count)]


def _plot(session: Session, name: str) -> str:
    return sparkline(step[name] for step in session.past if name in step)


def _text(value: Any) -> str:
    return f"{value:+.3f}" if isinstance(value, float) else str(value)


def _name(rows: Sequence[Mapping[str, Any]], at: int) -> str:
    name = rows[at]["name"] if at < len(rows) else f"[{at}]"
    return f"{name:<24.24}"


def _limits(rows: Sequence[Mapping[str, Any]], at: int, plot: str = "") -> str:
    """Such as ``rad / 0.05 [-1, 1]  turn shoulder_pan_joint``, with the plot before the meaning."""
    if at >= len(rows):
        return plot
    row = rows[at]
    unit = f"{row['unit']} {'' if row['scale'] == '1' else row['scale']}".strip()
    limits = f"[{float(row['low']):.4g}, {float(row['high']):.4g}]"
    return f"{unit:<18.24} {limits:<8} {plot and plot + ' '}{row['meaning']}"
