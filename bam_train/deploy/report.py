"""What a deployment did, for people and for programs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bam_envs.core.timing import Lateness, Pacer
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.deployment import Ending
from bam_train.deploy.journal import Journal

MISSED_SHARE = 0.05
"""More missed ticks than this share are worth a warning."""


@dataclass(frozen=True)
class DeployReport:
    """The outcome of one deployment."""

    checkpoint: Checkpoint
    seed: int
    """Of the first episode."""
    ending: Ending
    journal: Journal
    pacer: Pacer
    robot: str = "simulated here"
    """What was driven: an address, or the simulation."""
    guards: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """What the guards of a live robot did, by name; see `SafeRobot.report`."""

    def to_json(self) -> dict[str, Any]:
        """Plain values; times in the unit that their name says."""
        journal, manifest = self.journal, self.checkpoint.manifest
        return {
            "stop_reason": self.ending.reason,
            "episodes": journal.completed,
            "successes": journal.successes,
            "ticks": self.pacer.ticks,
            "rate_hz": None if self.pacer.rate is None else round(self.pacer.rate, 3),
            "target_rate_hz": None if self.pacer.period is None else round(1 / self.pacer.period, 3),
            "lateness_ms": _milliseconds(self.pacer.lateness),
            "missed_ticks": self.pacer.missed,
            "warnings": self.warnings(),
            "startup_cpu_s": _startup(journal),
            "seed": self.seed,
            "env": manifest.env,
            "algorithm": manifest.algorithm,
            "checkpoint": str(self.checkpoint.path),
            "robot": self.robot,
            "guards": {name: _finite(row) for name, row in self.guards.items()},
            "per_episode": [record.to_json() for record in journal.records],
        }

    def warnings(self) -> list[str]:
        """What a person should know of a deployment that ended well, too."""
        missed, period = self.pacer.missed, self.pacer.period
        planned = self.pacer.ticks + missed
        if period is None or missed <= MISSED_SHARE * planned:
            return []
        return [
            f"{missed} of {planned} ticks were missed: policy and robot take longer than the {1e3 * period:g} ms that "
            "the policy was made for; use a faster computer, or stop what else runs on it"
        ]

    def lines(self) -> list[str]:
        """The same for people, a few lines."""
        reason, ticks = self.ending.reason.rstrip("."), f"{self.pacer.ticks} ticks"
        return [
            f"{reason}: {episodes_text(self.journal)}, {ticks}, {rate_text(self.pacer)}",
            *([f"lateness {lateness_text(self.pacer)}"] if self.pacer.period is not None else []),
            *([guards_text(self.guards)] if self.guards else []),
            *([startup_text(self.journal)] if self.journal.startup.finished else []),
        ]


def episodes_text(journal: Journal) -> str:
    """Such as ``5 of 5 episodes, 4 successes``."""
    successes = journal.successes
    text = f"{journal.completed} of {journal.wanted} episodes"
    return text if successes is None else f"{text}, {successes} success{'' if successes == 1 else 'es'}"


def rate_text(pacer: Pacer) -> str:
    """Such as ``20.00 Hz of 20``."""
    measured = "no rate yet" if pacer.rate is None else f"{pacer.rate:.2f} Hz"
    return f"{measured}, no waiting" if pacer.period is None else f"{measured} of {1 / pacer.period:g}"


def lateness_text(pacer: Pacer) -> str:
    """Such as ``p50 0.08 ms, p99 0.30 ms, max 1.20 ms, 0 missed``."""
    late = _milliseconds(pacer.lateness)
    figures = [f"{name} {value:.2f} ms" for name, value in late.items()] if late else ["none yet"]
    return ", ".join([*figures, f"{pacer.missed} missed"])


def guards_text(guards: Mapping[str, Mapping[str, Any]]) -> str:
    """Such as ``guards changed the command: joint speed (G8) in 3 ticks``."""
    altered, held = (
        ", ".join(f"{name} ({row['number']}) in {row[what]} ticks" for name, row in guards.items() if row.get(what))
        for what in ("altered", "held")
    )
    changed = f"guards changed the command: {altered}" if altered else "no guard changed a command"
    return f"{changed}; held the robot: {held}" if held else changed


def startup_text(journal: Journal) -> str:
    """Where the CPU time up to the first action went."""
    stages = ", ".join(f"{name} {seconds:.2f}" for name, seconds in journal.startup.stages.items())
    return f"first action after {journal.startup.total:.2f} s of CPU time: {stages}"


def _finite(row: Mapping[str, Any]) -> dict[str, Any]:
    """The row of one guard; a limit that is off is infinite, which JSON does not have."""
    return {**row, "limit": None} if row.get("limit") == math.inf else dict(row)


def _milliseconds(lateness: Lateness | None) -> dict[str, float] | None:
    if lateness is None:
        return None
    return {name: round(1e3 * getattr(lateness, name), 3) for name in ("p50", "p99", "max")}


def _startup(journal: Journal) -> dict[str, float] | None:
    if not journal.startup.finished:
        return None
    stages = {name: round(seconds, 3) for name, seconds in journal.startup.stages.items()}
    return {"total": round(journal.startup.total, 3), **stages}
