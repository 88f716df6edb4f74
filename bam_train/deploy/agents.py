"""The small agents that stand beside robot and policy in a deployment's chain: they wait, and keep account."""

from __future__ import annotations

from typing import Any, Protocol

from bam_envs.core.timing import Pacer
from bam_train.deploy.journal import EpisodeRecord, Journal, Startup
from bam_train.loop import Agent
from bam_train.loop.robot_agent import SAYS_SUCCESS, SUCCESS

_ENDS = ("terminated", "truncated")


class Watcher(Protocol):
    """What shows the loop to a human; called between ticks, so it has to be quick."""

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> None:
        """A step was taken."""

    def ended(self, record: EpisodeRecord, pacer: Pacer) -> None:
        """An episode ended."""


class JournalAgent(Agent):
    """Keeps the journal, and tells the watcher. Stands behind the robot, and before anything waits."""

    reads = tuple(f"env/{name}" for name in ("reward", "done", *_ENDS, SUCCESS, SAYS_SUCCESS))
    reads_previous = ("action",)
    writes = ()

    def __init__(self, journal: Journal, pacer: Pacer) -> None:
        super().__init__()
        self._journal, self._pacer = journal, pacer
        self._record = EpisodeRecord(0)

    def forward(self, t: int, seed: int, watcher: Watcher, **kwargs: Any) -> None:
        """Begin a record at t = 0; later add the step that led here."""
        if t == 0:
            self._record = self._journal.begin(seed)
            return
        record = self._record
        says = self.get((f"env/{SAYS_SUCCESS}", t))[0]
        record.add(self.get(("env/reward", t))[0], {"is_success": self.get((f"env/{SUCCESS}", t))[0]} if says else {})
        record.end = next((end for end in _ENDS if self.get((f"env/{end}", t))[0]), "stopped")
        watcher.ticked(record, self.get(("action", t - 1))[0], self._pacer)
        if record.complete:
            watcher.ended(record, self._pacer)


class PacerAgent(Agent):
    """Waits for the deadline of the next action. Stands before the policy, so that it acts on time."""

    reads = ("env/done",)
    writes = ()

    def __init__(self, pacer: Pacer) -> None:
        super().__init__()
        self._pacer = pacer

    def forward(self, t: int, **kwargs: Any) -> None:
        """Wait, unless the episode is over."""
        if t == 0:
            self._pacer.start()
        if not self.get(("env/done", t))[0]:
            self._pacer.wait()


class StartupAgent(Agent):
    """Notes when the first action is there. Stands behind the policy."""

    reads = ()
    writes = ()

    def __init__(self, startup: Startup) -> None:
        super().__init__()
        self._startup = startup

    def forward(self, **kwargs: Any) -> None:
        """Nothing but the first time."""
        self._startup.finish("reset and first action")
