"""What `bam-deploy` shows on standard error: a panel on a terminal, a line for each episode elsewhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from time import monotonic
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from bam_envs.core.timing import Pacer
from bam_train.cli.console import ask, rich_text
from bam_train.deploy.journal import EpisodeRecord, Journal, lateness_text, rate_text
from bam_train.files.log_lines import counted

if TYPE_CHECKING:
    from rich.console import Console
    from rich.live import Live

_ASKED = 3
"""How often the operator is asked for a yes or no."""
_MOST_NUMBERS = 16
"""Numbers of an action or a state signal that are shown; the rest (of an image, say) is left out."""


class PlainDeployment:
    """Writes one line for each episode."""

    def __init__(self, journal: Journal, write: Callable[[str], None]) -> None:
        self._journal, self._write, self._warned = journal, write, 0

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> None:
        """Write the first warning of each guard; a line for each tick is too many."""
        for title, text in [*self._journal.warnings.items()][self._warned :]:
            self._write(f"warning: {title}: {text}")
        self._warned = len(self._journal.warnings)

    def has_written(self, warning: str) -> bool:
        """Whether a warning of the report was written while the robot moved."""
        return warning.partition(": ")[0] in [*self._journal.warnings][: self._warned]

    def ended(self, record: EpisodeRecord) -> None:
        """Write such as ``episode 2/5 (seed 8): success after 47 steps, return 12.31``."""
        how = {True: "success", False: "no success", None: record.end}[record.success]
        steps = counted(record.length, "step")
        which = f"episode {self._journal.begun}/{self._journal.wanted} (seed {record.seed})"
        self._write(f"{which}: {how} after {steps}, return {record.total:.2f}{self._journal.marked}")

    def judge(self, record: EpisodeRecord) -> bool | None:
        """Ask the operator whether the policy did its task, which the environment does not say; None: no answer."""
        next_ = "; the next episode begins then" if self._journal.begun < self._journal.wanted else ""
        for _ in range(_ASKED):
            answer = self._ask(f"Did it do its task in the episode with seed {record.seed}? Type yes or no{next_}:")
            if answer in ("yes", "no"):
                return answer == "yes"
        return None

    def _ask(self, question: str) -> str:
        return ask(question, self._write)


class LiveDeployment(PlainDeployment):
    """A panel below those lines, redrawn ten times a second at most, and only when there is time until a deadline.

    Rich's live area has no thread of its own; `now` is the clock of the redraws [s].
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
        now: Callable[[], float] = monotonic,
    ) -> None:
        super().__init__(journal, lambda line: live.console.print(rich_text(line)))
        self._live, self._env, self._title, self._now, self._drawn = live, env, title, now, -math.inf

    def _ask(self, question: str) -> str:
        from rich.control import Control
        from rich.segment import ControlType

        answer = super()._ask(question)
        self._live.console.control(Control((ControlType.CURSOR_UP, 1)))  # back to the last line of the panel
        return answer

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> None:
        """As there, and redraw if it is time and there is time."""
        super().ticked(record, action, pacer)
        now = self._now()
        if now - self._drawn < self.EVERY or pacer.slack < self.COST:
            return
        self._drawn = now
        from rich.console import Group
        from rich.table import Table

        successes = self._journal.successes
        succeeded = "" if successes is None else f", {successes} succeeded"
        rows = {
            "episode": f"{self._journal.begun} of {self._journal.wanted}{succeeded}",
            "step": f"{record.length}, return {record.total:.2f}",
            "loop": rate_text(pacer),
            **({} if pacer.period is None else {"lateness": lateness_text(pacer)}),
            **({} if self._journal.unusual is None else {"unusual": f"{self._journal.unusual:.2f} of 1"}),
            **numbers_of(self._env, action),
        }
        table = Table.grid(padding=(0, 2))
        for name, text in rows.items():
            table.add_row(rich_text(name, "dim"), rich_text(text, no_wrap=name != "action", overflow="ellipsis"))
        self._live.update(Group(rich_text(self._title, "bold"), table), refresh=True)


def numbers_of(env: gym.Env[Any, Any], action: Any) -> dict[str, str]:
    """The action, and each signal that the robot of a `RobotEnv` measured last, as rows of the panel."""
    describe = getattr(env.unwrapped, "describe", None)
    labels = [] if describe is None else [str(one["name"]) for one in describe()["action"]]
    rows = {"action": _text(action, labels)}
    signals = getattr(getattr(env.unwrapped, "state", None), "signals", {})
    for spec in env.unwrapped.robot.spec.signals if signals else ():  # type: ignore[attr-defined]
        if spec.name in signals:
            unit = spec.units[0] if len(set(spec.units)) == 1 and spec.units[0] != "1" else ""
            rows[spec.name.replace("_", " ")] = f"{_text(signals[spec.name][0])} {unit}".rstrip()
    return rows


def _text(values: Any, labels: Sequence[str] = ()) -> str:
    """Such as ``dx +0.500 dy -1.000``; a number without a label alone."""
    numbers = np.ravel(values)[:_MOST_NUMBERS]
    texts = [f"{number:+.3f}" if numbers.dtype.kind == "f" else str(number) for number in numbers]
    return " ".join(f"{label} {text}".lstrip() for label, text in zip_longest(labels, texts, fillvalue=""))


@contextmanager
def live_display(console: Console, env: gym.Env[Any, Any], title: str, journal: Journal) -> Iterator[LiveDeployment]:
    """The live panel on `console`; it stays on the screen at the end."""
    from rich.live import Live

    with Live(console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        yield LiveDeployment(live, env, title, journal)
