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
    """The session as lines of at most `width` characters, at most `height` of them."""
    keys = [*session.hand.lines(), *control_lines()] if session.help else []
    lines = [*_state(session, title), *keys, *_numbers(session)]
    if len(lines) > height:
        lines = [*lines[: height - 1], f"… {len(lines) - height + 1} more lines on a higher screen"]
    return [line[:width].rstrip() for line in lines]


def _state(session: Session, title: str) -> list[str]:
    marks = [
        session.status,
        f"{session.driver} drives",
        f"{session.speed:.2f} m/s",
        *(["slow"] if session.slow else []),
    ]
    if session.hand.waits:
        marks = ["every press is a step", f"{session.driver} drives"]
    elif session.status == "ready":
        marks[0] = "ready: time begins with the first key"
    elif session.status == "paused" and session.is_live:
        marks[0] = "paused: the robot holds"
    time = f"step {session.steps} ({session.steps * session.period:.2f} s)"
    rewards = f"reward {session.reward:+.3f}, return {session.total:.2f}"
    plot = sparkline(step["reward"] for step in session.past)
    first = f"{title}  seed {session.seed}  {time}  {rewards} {plot}"
    return [first, f"[{', '.join(marks)}]  {session.note or '? shows the keys'}", ""]


def _numbers(session: Session) -> list[str]:
    """The numbers of action, info and observation; what a policy would do stands beside the action."""
    describe = getattr(session.env.unwrapped, "describe", None)
    signals: Mapping[str, Any] = {} if describe is None else describe()
    acted = [] if session.action is None else np.ravel(session.action).tolist()
    wanted = [] if session.suggestion is None else np.ravel(session.suggestion).tolist()
    lines = [
        "action" + (f", and what the policy {'does' if session.driver == 'policy' else 'would do'}" if wanted else "")
    ]
    rows = signals.get("action", ())
    for at in range(max(len(acted), len(wanted))):
        value = _text(acted[at]) if at < len(acted) else ""
        policy = f"  policy {_text(wanted[at]):>7}" if at < len(wanted) else ""
        lines.append(f"  {_name(rows, at)} {value:>9}{policy}  {_limits(rows, at)}")
    lines += ["", "info"]
    for name, one in session.info.items():
        number = float(one) if isinstance(one, (bool, int, float)) else one
        if isinstance(number, (float, str)):
            lines.append(f"  {name:<24.24} {_text(number):>9}  {_plot(session, f'info {name}')}")
        elif isinstance(number, np.ndarray) and number.size <= _FEW:
            lines.append(f"  {name:<24.24} {' '.join(map(_text, np.ravel(number).tolist()))}")
    rows = signals.get("observation", ())
    lines += ["", "observation"]
    for at, one in enumerate(flat_numbers(session.observation)):
        plot = f"{_plot(session, f'observation {at}'):<{PLOTTED}}"
        lines.append(f"  {_name(rows, at)} {_text(one):>9}  {_limits(rows, at, plot)}")
    return lines


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
