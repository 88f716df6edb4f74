"""The journal of a deployment, updated at every tick, and the report made from it."""

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from bam_envs.core.timing import Lateness, Pacer
from bam_envs.safety.link_guards import LateTicks
from bam_envs.safety.unusual import UnusualObservations
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.agreement import Shadow
from bam_train.deploy.trials import Trials
from bam_train.files.log_lines import counted
from bam_train.recording.recorder import Recorder


@dataclass
class EpisodeRecord:
    """One episode, complete or cut short."""

    seed: int
    total: float = 0.0
    """Undiscounted sum of its rewards so far."""
    length: int = 0
    """Number of steps so far."""
    success: bool | None = None
    """`is_success` of the last info; None if the environment does not report it."""
    end: str = "stopped"
    """``"terminated"`` (the task's end), ``"truncated"`` (the time limit) or ``"stopped"`` (cut short)."""
    slow: int = 0
    """Number of ticks that its policy made late; see `TickTimes`."""

    def to_json(self) -> dict[str, Any]:
        """The record as JSON values; a return that is not finite is None."""
        total = self.total if math.isfinite(self.total) else None
        return {"seed": self.seed, "length": self.length, "return": total, "success": self.success, "end": self.end}


UNUSUAL = UnusualObservations().title
LATE = f"{LateTicks.name} ({LateTicks.number})"
KEPT = 1000
"""Maximum number of records kept; older episodes are only counted, so that memory is bounded."""


@dataclass
class Journal:
    """The episodes of one deployment."""

    wanted: int
    """Number of episodes to run."""
    records: deque[EpisodeRecord] = field(default_factory=lambda: deque(maxlen=KEPT))
    """The last `KEPT` episodes."""
    begun: int = 0
    """Episodes begun."""
    completed: int = 0
    """Episodes that the environment ended."""
    successes: int | None = 0
    """Successful episodes among these; None if the environment does not report success."""
    startup: float | None = None
    """CPU time of this process from its start to the first observation [s]; None before it."""
    marks: tuple[str, ...] = ()
    """Marks of this deployment, such as ``"UNSIGNED"``, which every status line shows."""
    warnings: dict[str, str] = field(default_factory=dict)
    """The newest warning of each guard of a live robot, by its title; see `SafeRobot.warnings`."""

    unusual: float | None = None
    """Newest level of the detector, above 1 if the observations are unusual for the policy; None without a detector."""
    highest: float | None = None
    """Highest of these."""
    alarms: int = 0
    """Number of episodes with a level above 1."""
    _alarmed: bool = False

    @property
    def marked(self) -> str:
        """The marks as the end of a status line: ``", UNSIGNED"``; empty without any."""
        return "".join(f", {mark}" for mark in self.marks)

    def warn(self, warnings: Sequence[str]) -> None:
        """Keep the warnings of the guards, each of which begins with the guard's title."""
        self.warnings.update(warning.split(": ", 1) for warning in warnings)  # type: ignore[misc]

    def compare(self, level: float, text: str, *, begins: bool) -> None:
        """Keep the detector's level of a tick, and the reason if it is above 1; `begins`: the episode's first one."""
        self.unusual, self.highest = level, max(level, self.highest or 0.0)
        self._alarmed = self._alarmed and not begins
        if text and not self._alarmed:
            self._alarmed, self.alarms = True, self.alarms + 1
            self.warnings[UNUSUAL] = text

    def begin(self, seed: int) -> EpisodeRecord:
        """Append the record of a new episode, and return it."""
        if self.startup is None:
            self.startup = time.process_time()
        self.records.append(EpisodeRecord(seed))
        self.begun += 1
        return self.records[-1]

    def step(self, reward: float, success: bool | None, end: str = "stopped") -> EpisodeRecord:
        """Add a step to the newest record and return it; the step ends the episode unless `end` is ``"stopped"``."""
        record = self.records[-1]
        record.total += float(reward)
        record.length += 1
        record.success = record.success if success is None else bool(success)
        record.end = end
        if end != "stopped":
            self.completed += 1
            if record.success is not None:
                self.successes = (self.successes or 0) + record.success
            elif self.completed == 1:
                self.successes = None
        return record

    def judged(self, record: EpisodeRecord, success: bool) -> None:
        """Take that a person says whether an ended episode, whose environment does not, was a success."""
        record.success, self.successes = success, (self.successes or 0) + success


@dataclass(frozen=True)
class Ending:
    """The reason for the end of a deployment."""

    reason: str
    """``"episodes done"``, ``"interrupted"``, ``"link lost: ..."``, ``"safety stop: ..."`` or ``"fault: ..."``."""
    status: int
    """Exit status of the program: 0, 128 + the signal, 4, 3 or 1."""


MISSED_SHARE = 0.05
"""Share of missed ticks above which the report has a warning."""


@dataclass(frozen=True)
class DeployReport:
    """The outcome of one deployment."""

    checkpoint: Checkpoint
    seed: int
    """Seed of the first episode."""
    ending: Ending
    journal: Journal
    pacer: Pacer
    robot: str = "simulated here"
    """Address of the robot, or the simulation."""
    guards: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Counts of the guards of a live robot, by name; see `SafeRobot.report`."""
    trials: Trials | None = None
    """The trials of this deployment."""
    agent_guards: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """The same of the live agent that drives the robot otherwise, without limits; see `TakeOver.guards`."""
    shadow: Shadow | None = None
    """The comparison with whoever drove the robot."""
    recorder: Recorder | None = None
    """The recorder, if the deployment was recorded."""
    identity: str = ""
    """Serial number or name of the robot; empty if neither is known."""

    def to_json(self) -> dict[str, Any]:
        """The report as JSON values; times in the unit of their name."""
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
            "startup_cpu_s": None if journal.startup is None else {"total": round(journal.startup, 3)},
            "seed": self.seed,
            "env": manifest.env,
            "algorithm": manifest.algorithm,
            "checkpoint": str(self.checkpoint.path),
            "robot": self.robot,
            "identity": self.identity,
            "marks": list(journal.marks),
            "trials": None if self.trials is None else self.trials.evidence.to_json(),
            "uncounted": "" if self.trials is None else self.trials.uncounted,
            "shadow": None if self.shadow is None else self.shadow.agreement.to_json(),
            "guards": finite_limits(self.guards),
            "agent_guards": finite_limits(self.agent_guards),
            "per_episode": [record.to_json() for record in journal.records],
            **({} if journal.highest is None else {"unusual": {"highest": journal.highest, "alarms": journal.alarms}}),
            **({} if self.recorder is None else {"recording": str(self.recorder.path)}),
        }

    def warnings(self) -> list[str]:
        """Warnings for the user, also about a deployment that ended well."""
        missed, period = self.pacer.missed, self.pacer.period
        planned = self.pacer.ticks + missed
        faults = [f"{title}: {text}" for title, text in self.journal.warnings.items()]
        if self.recorder is not None and self.recorder.fault:
            faults.append(f"recording: {self.recorder.fault}")
        if period is None or missed <= MISSED_SHARE * planned or LATE in self.journal.warnings:
            return faults
        return [
            *faults,
            f"{missed} of {planned} deadlines were missed: policy and robot take longer than the {1e3 * period:g} ms "
            "that the policy was made for; use a faster computer, or stop what else runs on it",
        ]

    def lines(self) -> list[str]:
        """The report as text, without details of a fault, which were shown when it occurred.

        Before the first episode there are no figures.
        """
        journal, reason = self.journal, self.ending.reason.partition(":")[0]
        successes = journal.successes
        succeeded = "" if successes is None else f", {successes} success{'' if successes == 1 else 'es'}"
        episodes = f"{journal.completed} of {counted(journal.wanted, 'episode')}{succeeded}"
        figures = [
            f"{reason}: {episodes}, {counted(self.pacer.ticks, 'tick')}, {rate_text(self.pacer)}{journal.marked}",
            *([f"lateness {lateness_text(self.pacer)}"] if self.pacer.period is not None else []),
            *([guards_text(self.guards, self.pacer.ticks)] if self.guards else []),
            *([f"live agent: {guards_text(self.agent_guards, self.pacer.ticks)}"] if self.agent_guards else []),
        ]
        return [
            *(figures if journal.begun else []),
            *([f"the last trial does not count: {one.uncounted}" for one in (self.trials,) if one and one.uncounted]),
            *([self.trials.evidence.text] if self.trials and self.trials.begun else []),
            *([self.shadow.agreement.text] if self.shadow and journal.begun else []),
            *([recorded_text(self.recorder)] if self.recorder is not None else []),
        ]


def finite_limits(guards: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """The counts of guards as JSON values: the limit of one that is off is infinite, which JSON cannot represent."""
    return {name: {**row, "limit": None} if row.get("limit") == math.inf else dict(row) for name, row in guards.items()}


def rate_text(pacer: Pacer) -> str:
    """The measured and the wanted rate, such as ``20.00 Hz of 20``."""
    measured = "no rate yet" if pacer.rate is None else f"{pacer.rate:.2f} Hz"
    return f"{measured}, no waiting" if pacer.period is None else f"{measured} of {1 / pacer.period:g}"


def lateness_text(pacer: Pacer) -> str:
    """The lateness, such as ``p50 0.08 ms, p99 0.30 ms, max 1.20 ms, no deadline missed``."""
    late = _milliseconds(pacer.lateness)
    figures = [f"{name} {value:.2f} ms" for name, value in late.items()] if late else ["none yet"]
    return ", ".join([*figures, f"{counted(pacer.missed, 'deadline') if pacer.missed else 'no deadline'} missed"])


def recorded_text(recorder: Recorder) -> str:
    """Where the recording is, and whether it failed."""
    return f"not recorded to the end: {recorder.fault}" if recorder.fault else f"recorded in {recorder.path}"


def guards_text(guards: Mapping[str, Mapping[str, Any]], ticks: int) -> str:
    """Counts of the guards, such as ``guards changed the command: joint speed (G8) in 3 of 60 ticks (5.0 %)``.

    On the way to a start pose there are no ticks.
    """
    of = counted(ticks, "tick")

    def count(times: int) -> str:
        return f"in {times} of {of} ({100 * times / ticks:.1f} %)" if times <= ticks else f"{times} times"

    counts = {
        what: ", ".join(f"{name} ({row['number']}) {count(row[what])}" for name, row in guards.items() if row.get(what))
        for what in ("altered", "held")
    }
    changed = f"guards changed the command: {counts['altered']}" if counts["altered"] else "no guard changed a command"
    return f"{changed}; held the robot: {counts['held']}" if counts["held"] else changed


def _milliseconds(lateness: Lateness | None) -> dict[str, float] | None:
    if lateness is None:
        return None
    return {name: round(1e3 * getattr(lateness, name), 3) for name in ("p50", "p99", "max")}
