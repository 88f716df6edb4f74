"""What `bam-deploy` shows on standard error: a panel on a terminal, a line for each episode elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from bam_envs.core.timing import Pacer
from bam_train.cli.console import rich_text
from bam_train.deploy.journal import EpisodeRecord, Journal, lateness_text, rate_text

if TYPE_CHECKING:
    from rich.console import Console
    from rich.live import Live

_MOST_NUMBERS = 16
"""Numbers of an action or a state signal that are shown; the rest (of an image, say) is left out."""
_BAR = 20
"""Characters of a bar."""


class PlainDisplay:
    """One line for each episode.

    Args:
        journal: Says how many episodes are wanted.
        write: Takes a line.
    """

    def __init__(self, journal: Journal, write: Callable[[str], None]) -> None:
        self._journal, self._write = journal, write

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> None:
        """Nothing: a line for each tick is too many."""

    def ended(self, record: EpisodeRecord, pacer: Pacer) -> None:
        """Write how the episode went."""
        self._write(episode_line(self._journal.begun, self._journal.wanted, record))


class LiveDisplay:
    """A panel redrawn at most ten times a second, and only when the next deadline leaves time for it.

    Args:
        live: Rich's live area, without a thread of its own.
        env: The environment, for the labels and the measured state.
        title: First line.
        journal: The episodes so far.
        now: Clock of the redraws [s].
    """

    EVERY = 0.1
    """Time between redraws [s]."""
    COST = 0.01
    """Time that a redraw may take [s]."""

    def __init__(
        self,
        live: Live,
        env: gym.Env[Any, Any],
        title: str,
        journal: Journal,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._live, self._env, self._title, self._journal, self._now = live, env, title, journal, now
        self._labels = action_labels(env)
        self._drawn = -math.inf

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> None:
        """Redraw if it is time and there is time."""
        now = self._now()
        if now - self._drawn < self.EVERY or pacer.slack < self.COST:
            return
        self._drawn = now
        from rich.console import Group
        from rich.table import Table

        table = Table.grid(padding=(0, 2))
        for name, text in self._lines(record, action, pacer):
            table.add_row(rich_text(name, "dim"), rich_text(text, no_wrap=True, overflow="ellipsis"))
        self._live.update(Group(rich_text(self._title, "bold"), table), refresh=True)

    def ended(self, record: EpisodeRecord, pacer: Pacer) -> None:
        """Write how the episode went above the panel."""
        line = episode_line(self._journal.begun, self._journal.wanted, record)
        self._live.console.print(rich_text(line))

    def _lines(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> Iterator[tuple[str, str]]:
        """What the panel says, line by line: a name and a text; few enough for a screen of 24 lines."""
        successes = self._journal.successes
        succeeded = "" if successes is None else f", {successes} succeeded"
        yield "episode", f"{self._journal.begun} of {self._journal.wanted}{succeeded}"
        yield "step", f"{record.length}, return {record.total:.2f}"
        yield "loop", rate_text(pacer)
        if pacer.period is not None:
            yield "lateness", lateness_text(pacer)
        yield from action_lines(self._labels, action)
        yield from state_lines(self._env)


def _bar(value: float) -> str:
    """A number of [-1, 1] as a mark on a line whose middle is 0; what is outside is at the end."""
    place = round((min(max(value, -1.0), 1.0) + 1) / 2 * _BAR)
    return "".join("#" if i == place else "|" if i == _BAR // 2 else "." for i in range(_BAR + 1))


def episode_line(number: int, wanted: int, record: EpisodeRecord) -> str:
    """Such as ``episode 2/5 (seed 8): success after 47 steps, return 12.31``."""
    how = {True: "success", False: "no success", None: record.end}[record.success]
    steps = f"{record.length} step{'' if record.length == 1 else 's'}"
    return f"episode {number}/{wanted} (seed {record.seed}): {how} after {steps}, return {record.total:.2f}"


def action_labels(env: gym.Env[Any, Any]) -> tuple[str, ...]:
    """Names of the action's numbers, if the environment has any."""
    describe = getattr(env.unwrapped, "describe", None)
    return () if describe is None else tuple(str(one["name"]) for one in describe()["action"])


def action_lines(labels: tuple[str, ...], action: Any) -> Iterator[tuple[str, str]]:
    """One line for each number of the action, with a bar if it is not a choice."""
    numbers = np.ravel(action)
    width = max((len(label) for label in labels), default=1)
    for i, number in enumerate(numbers[:_MOST_NUMBERS]):
        label = (labels[i] if i < len(labels) else str(i) if len(numbers) > 1 else "").ljust(width)
        text = f"{_bar(float(number))} {number:+.3f}" if numbers.dtype.kind == "f" else str(number)
        yield "action" if i == 0 else "", f"{label} {text}".lstrip()


def state_lines(env: gym.Env[Any, Any]) -> Iterator[tuple[str, str]]:
    """One line for each signal that the robot measured last; none if the environment is no `RobotEnv`."""
    signals = getattr(getattr(env.unwrapped, "state", None), "signals", None)
    if signals is None:
        return
    for spec in env.unwrapped.robot.spec.signals:  # type: ignore[attr-defined]
        if spec.name in signals:
            numbers = " ".join(f"{number:+.3f}" for number in np.ravel(signals[spec.name][0])[:_MOST_NUMBERS])
            unit = spec.units[0] if len(set(spec.units)) == 1 and spec.units[0] != "1" else ""
            yield spec.name.replace("_", " "), f"{numbers} {unit}".rstrip()


@contextmanager
def live_display(console: Console, env: gym.Env[Any, Any], title: str, journal: Journal) -> Iterator[LiveDisplay]:
    """The live panel on `console`; it stays on the screen at the end."""
    from rich.live import Live

    with Live(console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        yield LiveDisplay(live, env, title, journal)
