"""A rehearsal: a frozen policy drives a simulated robot behind a link and a live robot's guards, in simulated time."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from bam_envs.core.errors import SafetyStop, StaleState
from bam_envs.core.location import SIMULATED
from bam_envs.core.registry import entry_of
from bam_envs.live.rehearsed_robot import rehearsed_robot, time_to_stop
from bam_envs.robots.linked import LinkedRobot, LinkProfile
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.journal import EpisodeRecord, finite_limits
from bam_train.environments import environment_of, make_env, require_fit
from bam_train.errors import LateChunk, SettingsError
from bam_train.evaluation import success_text, wilson_interval
from bam_train.files.log_lines import counted
from bam_train.policy import FrozenPolicy
from bam_train.policy.background import Background, ChunkRequest
from bam_train.policy.chunks import Plan
from bam_train.rollout import BatchPolicy, play, success_of

HALTS_WITHIN = 1.0
"""Time from the start of an episode within which its halt is tried, while the robot moves [s]."""


@dataclass
class RehearsalReport:
    """The outcome of a rehearsal."""

    checkpoint: Path
    env: str
    link: str
    """Name or file of the link."""
    seed: int
    """Seed of the first episode; episode k has seed + k."""
    records: list[EpisodeRecord] = field(default_factory=list)
    halts: list[float] = field(default_factory=list)
    """Time from a halt to rest, once an episode [s]; infinite if the robot did not come to rest."""
    guards: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Counts of the guards, by name; see `SafeRobot.report`."""

    def to_json(self) -> dict[str, Any]:
        """The report as JSON values."""
        episodes, known = len(self.records), [record.success for record in self.records if record.success is not None]
        successes = sum(known) if known else None
        rested = [seconds for seconds in self.halts if math.isfinite(seconds)]
        return {
            "checkpoint": str(self.checkpoint),
            "env": self.env,
            "link": self.link,
            "seed": self.seed,
            "episodes": episodes,
            "successes": successes,
            "success_rate": None if successes is None else successes / episodes,
            "success_interval": None if successes is None else list(wilson_interval(successes, episodes)),
            "stopped_by": {name: row["stopped"] for name, row in self.guards.items() if row["stopped"]},
            "time_to_stop_s": {"p50": float(np.median(rested)), "max": max(rested)} if rested else None,
            "halts_without_rest": len(self.halts) - len(rested),
            "guards": finite_limits(self.guards),
            "per_episode": [record.to_json() for record in self.records],
        }

    def lines(self) -> list[str]:
        """The report as text."""
        facts, times = self.to_json(), "no halt was tried"
        if facts["time_to_stop_s"] is not None:
            times = "p50 {p50:.2f} s, max {max:.2f} s from a halt to rest".format(**facts["time_to_stop_s"])
        if facts["halts_without_rest"]:
            times += f"; after {facts['halts_without_rest']} of {counted(len(self.halts), 'halt')} it did not rest"
        ticks = sum(record.length for record in self.records)
        rows = [
            ("stopped", "stopped", counted(facts["episodes"], "episode")),
            ("held", "held", counted(ticks, "tick")),
            ("limited", "altered", counted(ticks, "tick")),
        ]
        return [
            f"{self.checkpoint} on {self.env} behind {self.link}, with the guards of a live robot",
            f"  success   {success_text(facts['successes'], facts['episodes'])}",
            *(f"  {title:<8}  {self._by_guard(effect, of)}" for title, effect, of in rows),
            f"  stopping  {times}",
            f"  episodes  {facts['episodes']}, seeds {self.seed} to {self.seed + facts['episodes'] - 1}",
        ]

    def _by_guard(self, effect: str, of: str) -> str:
        """The guards that had an `effect`, each with its count `of` all episodes or ticks."""
        counts = {f"{name} ({row['number']})": row[effect] for name, row in self.guards.items()}
        return ", ".join(f"by {title} in {count} of {of}" for title, count in counts.items() if count) or "never"


class Rehearsal:
    """The environment of a checkpoint, whose simulated robot is behind a link and the guards of a live one.

    Args:
        checkpoint: The checkpoint of the policy that will act.
        link: See `bam_envs.robots.linked.link_profile`.
        named: The environment that the user expects.
        profile: The robot profile with the limits of the guards; by default the shipped one for the robot.
        guards: Limits that replace the profile's.

    Raises:
        SettingsError: The environment is not one of `bam_envs`, and has no robot that could be put behind a link.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        link: str,
        *,
        named: str | None = None,
        profile: str | None = None,
        guards: Mapping[str, float] | None = None,
    ) -> None:
        env_id, saved = environment_of(checkpoint, named)
        if entry_of(env_id) is None:
            raise SettingsError(f"{env_id} has no robot that --rehearse could put behind a link; leave it out")
        self.checkpoint, self.link = checkpoint, link
        self.env = make_env(env_id, {**saved, **SIMULATED, "link": link})
        require_fit(checkpoint, self.env)
        inner: Any = self.env.unwrapped
        self._linked: LinkedRobot = inner.robot
        straight = getattr(inner.task, "moves_straight", False)
        self._gate = rehearsed_robot(self._linked, profile=profile, guards=guards, straight=straight)
        inner.robot = self._gate
        self._envs = SyncVectorEnv([lambda: self.env], autoreset_mode=AutoresetMode.DISABLED)

    def elsewhere(self, policy: FrozenPolicy, seed: int) -> BatchPolicy:
        """The policy with its server behind the same link, in simulated time: a chunk comes some steps late."""
        inner: Any = self.env.unwrapped
        link, rng = self._linked.profile, np.random.default_rng(seed)
        return _Elsewhere(
            policy,
            self._linked.spec.period,
            fade=getattr(inner.task, "action_step", None),
            is_held=lambda: self._gate.is_held,
            request=lambda policy, plan: _LateRequest(policy, plan, link, self._linked.spec.period, rng),
        )

    def run(self, policy: BatchPolicy, *, episodes: int, seed: int, tell: Callable[[str], None]) -> RehearsalReport:
        """Play `episodes`, at least 1; a stop by a guard ends its episode only.

        Args:
            policy: A `FrozenPolicy`, or what `elsewhere` made of it.
            episodes: Number of episodes.
            seed: Seed of the first one.
            tell: Called with a line about each stop by a guard; the first line of each guard has the reason.
        """
        report, shown = RehearsalReport(self.checkpoint.path, self.checkpoint.manifest.env, self.link, seed), set[str]()
        for k in range(episodes):
            report.records.append(EpisodeRecord(seed + k))
            try:
                self._play(policy, report)
            except (SafetyStop, StaleState, LateChunk) as stop:
                why = str(stop).removesuffix(" When it is safe, call resume().")
                short = why.partition(":")[0]
                tell(f"episode with seed {seed + k}: {short if short in shown else why}")
                shown.add(short)
                self._gate.resume()
        report.guards = self._gate.report()
        return report

    def _play(self, policy: BatchPolicy, report: RehearsalReport) -> None:
        """Play one episode; at a moment drawn from its seed a halt is tried, and the robot's state is then restored."""
        record = report.records[-1]
        halt_at = 1 + np.random.default_rng(record.seed).integers(round(HALTS_WITHIN / self._linked.spec.period))
        for step in play(self._envs, policy, seed=record.seed):
            record.total, record.length = record.total + float(step.rewards[0]), record.length + 1
            record.success = success_of(step.infos, 0)
            record.end = "terminated" if step.terminated[0] else "truncated" if step.truncated[0] else "stopped"
            if record.length == halt_at:
                report.halts.append(time_to_stop(self._linked))
            if step.ended:
                return

    def close(self) -> None:
        """Close the environment."""
        self._envs.close()


class _Elsewhere(Background):
    """A policy with chunks for the one environment of a rehearsal."""

    def reset(self, env_ids: Any = None) -> None:
        super().reset()

    def act_batch(self, observations: Any) -> Any:
        one = {key: value[0] for key, value in observations.items()} if isinstance(observations, Mapping) else None
        return self.act(observations[0] if one is None else one)[None]


class _LateRequest(ChunkRequest):
    """A chunk that takes as long as its computation, and the way of the observation there and its own way back.

    A lost message is sent again, and takes the longest time of the link.
    """

    def __init__(
        self, policy: FrozenPolicy, plan: Plan, link: LinkProfile, period: float, rng: np.random.Generator
    ) -> None:
        super().__init__(policy, plan)
        self.wait()
        for delay, loss in ((link.state_delay, link.state_loss), (link.command_delay, link.command_loss)):
            self.took += float(np.quantile(delay, 1.0 if rng.random() < loss else rng.random()))
        self._late = math.ceil(self.took / period)

    @property
    def ended(self) -> bool:
        return self._plan.tick - self._tick >= self._late
