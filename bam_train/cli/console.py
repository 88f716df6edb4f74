"""What the programs print, on standard output, standard error or a rich console, and the question before a robot moves.

What is printed may come from a file or from the network: every text passes `shown`, so that nothing in it acts on a
terminal.
"""

from __future__ import annotations

import logging
import sys
import traceback
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text


def shown(text: str) -> str:
    r"""One line of text with ``\x1b``, ``\n`` and the like instead of the characters.

    Control characters (C0, C1), those that turn the direction of writing, line separators and halves of surrogate pairs
    are shown as in Python's string literals.
    """
    return text if text.isprintable() else "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


def say(text: str = "") -> None:
    """Print one plain line on standard error."""
    print(shown(text), file=sys.stderr, flush=True)


def tell(*lines: str) -> None:
    """Print the results of a program on standard output, line by line."""
    print("\n".join(map(shown, lines)), flush=True)


def is_terminal() -> bool:
    """Whether standard error is a terminal."""
    return sys.stderr.isatty()


def make_console() -> Console:
    """A rich console on standard error; standard output is kept for results that programs read."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, markup=False, emoji=False)


def rich_text(text: str, style: str = "", **arguments: Any) -> Text:
    """Text for a rich console, without markup."""
    from rich.text import Text

    return Text(shown(text), style, **arguments)


class ShownFormatter(logging.Formatter):
    """Formats what is logged."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: D102, N802 - logging's name
        return shown(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: D102, N802
        return "\n".join(map(shown, super().formatException(ei).split("\n")))


def show_logs_and_tracebacks() -> None:
    """Pass what Python itself prints through `shown`: unhandled logs, and the traceback of an error in our code."""

    def say_traceback(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        for line in "".join(traceback.format_exception(kind, error, trace)).rstrip("\n").split("\n"):
            say(line)

    if logging.lastResort is not None:
        logging.lastResort.setFormatter(ShownFormatter())
    sys.excepthook = say_traceback


# Numbers to read


def count(number: float) -> str:
    """A count in short: 950, 12.3k, 1.25M."""
    if number < 10_000:
        return f"{number:.0f}"
    return f"{number / 1e3:.4g}k" if number < 1e6 else f"{number / 1e6:.4g}M"


def duration(seconds: float | None) -> str:
    """A duration in short: 4.2 s, 3 min 05 s, 2 h 04 min; a dash if it is not known."""
    if seconds is None or seconds != seconds or seconds == float("inf"):
        return "-"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def percent(share: float | None) -> str:
    """A share: 98.5 %; a dash if it is not known."""
    return "-" if share is None else f"{100 * share:.1f} %".replace(".0 %", " %")


def number(value: float | None) -> str:
    """A measured value to four digits; a dash if it is not known."""
    return "-" if value is None else f"{value:.4g}"


# Before a real robot moves


def guards_of(env: Any) -> dict[str, dict[str, Any]]:
    """What the guards of an environment's live robot did; empty for a simulated one."""
    report = getattr(getattr(env.unwrapped, "robot", None), "report", None)
    return {} if report is None else dict(report())


def plan_lines(env: Any, env_id: str, address: str, episodes: int) -> list[str]:
    """What a person should know of the episodes to come."""
    from bam_envs.core.robot import RobotSpec
    from bam_envs.safety.guard import is_base

    spec = getattr(getattr(env.unwrapped, "robot", None), "spec", None)
    planned = "1 episode" if episodes == 1 else f"{episodes} episodes, one after the other without a pause"
    begin = "where the base stands"
    if isinstance(spec, RobotSpec) and not is_base(spec):
        gripper = "opening the gripper and " if "m" in spec.command.units else ""
        begin = f"by {gripper}going to the start pose"
    return [f"  address: {address}", f"  {env_id}: {planned}", f"  each begins {begin}"]


def require_consent(env: Any, who: str, *, yes: bool, plan: Sequence[str] = ()) -> None:
    """Ask once before a real robot moves; it is connected, and stands still.

    Args:
        env: The environment, single or vector; without a real robot there is no question.
        who: What will move it, as the first line begins.
        yes: Show it, and do not ask.
        plan: Lines that say what it will do.

    Raises:
        SettingsError: The robot says that it cannot move now, the answer is not yes, or there is nobody to ask.
    """
    from bam_train.errors import SettingsError

    robot = getattr(env.unwrapped, "robot", None)
    info = getattr(robot, "info", None)
    if robot is None or info is None or info.simulated:
        return
    what = [f"{who} will move {info.text}:", *plan, "within"] if plan else [f"{who} will move {info.text}, within"]
    guards: Mapping[str, Mapping[str, Any]] = guards_of(env)
    limited = [(name, guard) for name, guard in guards.items() if guard["limit"] not in (None, "")]
    for line in what + [f"  {name} ({one['number']}): {one['limit']:.3g} {one['unit']}" for name, one in limited]:
        say(line.rstrip())
    why = robot.not_ready()
    if why is not None:
        raise SettingsError(f"not ready: {why}; nothing has moved")
    if yes:
        return
    if not sys.stdin.isatty():
        raise SettingsError("a real robot would move, and there is nobody to ask; give --yes to go on without asking")
    question = "Is the robot clear of people, and a hand on its emergency stop? Type yes to go on: "
    print(question, end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() != "yes":
        raise SettingsError("the answer was not yes; nothing has moved")
