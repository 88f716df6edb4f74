"""What has happened so far, kept up to date tick by tick so that a report can be made at any moment."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class EpisodeRecord:
    """One episode, complete or cut short."""

    seed: int
    total: float = 0.0
    """Undiscounted sum of its rewards so far."""
    length: int = 0
    """Its steps so far."""
    success: bool | None = None
    """`is_success` of the last info; None if the environment has no such thing."""
    end: str = "stopped"
    """``"terminated"`` (the task's end), ``"truncated"`` (the time limit) or ``"stopped"`` (cut short)."""

    @property
    def complete(self) -> bool:
        """Whether the environment ended it."""
        return self.end != "stopped"

    def add(self, reward: float, info: Mapping[str, Any]) -> None:
        """Count one step."""
        self.total += float(reward)
        self.length += 1
        if "is_success" in info:
            self.success = bool(info["is_success"])

    def to_json(self) -> dict[str, Any]:
        """Plain values; a return that is not finite is None."""
        total = self.total if np.isfinite(self.total) else None
        return {"seed": self.seed, "length": self.length, "return": total, "success": self.success, "end": self.end}


@dataclass
class Startup:
    """CPU time of this process from its start to the first action, stage by stage."""

    clock: Callable[[], float] = time.process_time
    """CPU time of the process [s]; counts the interpreter's own start."""
    stages: dict[str, float] = field(default_factory=dict)
    """CPU seconds of each stage, in order."""
    finished: bool = False
    """Whether the first action has been reached."""

    def mark(self, stage: str) -> None:
        """Assign the CPU time since the previous mark to `stage`."""
        self.stages[stage] = self.clock() - self.total

    def finish(self, stage: str) -> None:
        """The first action is decided; later calls change nothing."""
        if not self.finished:
            self.mark(stage)
            self.finished = True

    @property
    def total(self) -> float:
        """CPU seconds so far."""
        return sum(self.stages.values())


KEPT = 1000
"""Episodes whose records are kept; older ones are only counted, so that memory stays flat."""


@dataclass
class Journal:
    """The episodes of one deployment, and what its start cost."""

    wanted: int
    """Episodes asked for."""
    startup: Startup = field(default_factory=Startup)
    records: deque[EpisodeRecord] = field(default_factory=lambda: deque(maxlen=KEPT))
    """The last `KEPT` episodes."""
    begun: int = 0
    """Episodes begun."""
    _earlier: Counter[str] = field(default_factory=Counter)  # of all episodes but the last one

    def begin(self, seed: int) -> EpisodeRecord:
        """A new episode, appended and returned; the one before does not change any more."""
        self._earlier = self._counts()
        self.records.append(EpisodeRecord(seed))
        self.begun += 1
        return self.records[-1]

    @property
    def completed(self) -> int:
        """Episodes that the environment ended."""
        return self._counts()["completed"]

    @property
    def successes(self) -> int | None:
        """How many complete episodes succeeded; None if the environment does not say, 0 before the first."""
        counts = self._counts()
        return counts["succeeded"] if counts["said"] or not counts["completed"] else None

    def _counts(self) -> Counter[str]:
        counts = self._earlier.copy()
        if self.records and self.records[-1].complete:
            success = self.records[-1].success
            counts.update(completed=1, said=success is not None, succeeded=bool(success))
        return counts
