"""A learner that gets transitions and gives candidates, without a connection: networks, experience, checkpoints."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bam_envs.core.validation import read_table
from bam_train.agent.transitions import LiveTransitions
from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, write_checkpoint
from bam_train.checkpoint.safetensors_file import pack
from bam_train.environments import control_period, make_env, make_vector_env, require_fit
from bam_train.errors import CheckpointMismatch, TrainingFailed
from bam_train.policy import FrozenPolicy
from bam_train.settings import TrainSettings
from bam_train.trainers.base import manifest
from bam_train.trainers.live.experience import Experience
from bam_train.trainers.live.live_policy import TAPE, LivePolicy, frozen, members, require_spaces
from bam_train.trainers.live.rlpd import Hyperparameters, Rlpd

ALGORITHM, TRAINER = "rlpd", "live"
STATE, NOTES = "bam/resume/state", "bam/resume/notes.json"
_LARGEST = 500_000  # transitions that are kept
_RECENT = 50  # episodes of the success rate
_VARIANTS: tuple[dict[str, Any], ...] = (
    {},
    *({"link": {"command_delay": [late, late], "state_delay": [0.0, 0.0]}} for late in (0.1, 0.2)),
)
"""Arguments of our environments in which a policy is copied, so that the copy is right on a late robot too."""
_NOISES = (0.0, 0.3)
_ENVS, _STEPS, _FITS = 32, 250, 3000


class LiveLearner:
    """Made by `create` or `load`.

    Args:
        settings: Of which ``hyperparameters`` are those of `Hyperparameters`.
    """

    def __init__(self, settings: TrainSettings) -> None:
        torch.set_num_threads(settings.threads)
        torch.manual_seed(settings.seed)
        self.settings, self.hyperparameters = (
            settings,
            read_table(Hyperparameters, settings.hyperparameters, "hyperparameters"),
        )
        with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
            self.observed, self.acted = require_spaces(env.observation_space, env.action_space)
            describe = getattr(env.unwrapped, "describe", None)
            self._signals, self._period = describe() if describe else {}, control_period(env)
            if settings.start is not None:
                require_fit(Checkpoint.open(settings.start), env)
        history, width = self.hyperparameters.history, int(np.prod(self.observed.shape))
        self.rlpd = Rlpd(width + history * len(self.acted.low), len(self.acted.low), self.hyperparameters)
        size = min(_LARGEST, 2 * settings.steps)
        gamma, ahead = self.hyperparameters.gamma, self.hyperparameters.ahead
        bounds = self.acted.low, self.acted.high
        self.experience = Experience(size, width, *bounds, history=history, gamma=gamma, ahead=ahead)
        self._rng = np.random.default_rng(settings.seed)

    @classmethod
    def create(cls, settings: TrainSettings) -> LiveLearner:
        """A new learner, whose policy is a copy of that of the checkpoint `start`, if there is one."""
        learner = cls(settings)
        if settings.start is not None:
            learner.imitate(FrozenPolicy.load(settings.start))
        return learner

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: TrainSettings) -> LiveLearner:
        """A learner that goes on from a checkpoint of `save`.

        Raises:
            CheckpointMismatch: It is of another trainer, or of a candidate.
        """
        made = checkpoint.manifest
        if (made.trainer, made.algorithm) != (TRAINER, ALGORITHM) or not checkpoint.has(f"{STATE}.json"):
            text = f"was made by {made.algorithm} of {made.trainer}, and not by a run with --learner"
            raise CheckpointMismatch(checkpoint.path, f"{text}: a new run can begin with it by --start")
        learner, state = cls(settings), checkpoint.state(STATE, torch.as_tensor)
        with checkpoint.fitting(STATE):
            learner.rlpd.load_state_dict(state["rlpd"])
            learner.experience.load_state_dict(state["experience"])
            learner._rng.bit_generator.state = state["rng"]
            torch.set_rng_state(state["torch"])
        return learner

    # ---- learning

    @property
    def steps(self) -> int:
        """Steps of the robot that were learnt from, of a person and of policies."""
        return self.experience.added

    def add(self, transitions: LiveTransitions) -> None:
        """Take transitions of the robot.

        Raises:
            TrainingFailed: They are of another environment.
        """
        found = transitions.observation.shape[1:], transitions.action.shape[1:]
        if found != (self.observed.shape, self.acted.shape):
            expected = f"expected those of {self.settings.env}, {self.observed.shape} and {self.acted.shape}"
            raise TrainingFailed(
                f"observations and actions of the agent have shapes {found[0]} and {found[1]}, {expected}"
            )
        self.experience.add(transitions)

    @property
    def due(self) -> int:
        """Updates that are due for the steps so far."""
        return int(self.hyperparameters.update_ratio * self.steps) - self.rlpd.updates

    @property
    def is_ready(self) -> bool:
        """Whether policies have driven long enough for the actor to change."""
        return self.steps - self.experience.interventions >= self.hyperparameters.actor_after

    def learn(self, most: int) -> int:
        """Do the updates that are due, at most `most`; returns how many."""
        count, settings = min(most, self.due), self.hyperparameters
        size, share = settings.batch_size, settings.demonstration_share
        if not self.rlpd.has_critics:  # which alone learn from the rest of a batch
            size, share = max(1, round(share * size)), 1.0
        for _ in range(count):
            self.rlpd.update(partial(self.experience.sample, size, share, self._rng), actor=self.is_ready)
        return max(count, 0)

    def statistics(self) -> dict[str, Any]:
        """Episodes, success rate of the policies' last ones, share of a person's steps, and numbers of the updates."""
        recent = [success for success, person, _ in self.experience.outcomes if not person][-_RECENT:]
        return {
            "episodes": len(self.experience.outcomes),
            "success_rate": sum(recent) / len(recent) if recent else None,
            "interventions": self.experience.interventions,
            "updates": self.rlpd.updates,
            **{name: round(value, 6) for name, value in self.rlpd.metrics.items()},
        }

    # ---- policies and files

    def policy(self, *, explores: bool = False) -> LivePolicy:
        """The policy as it is; one that explores has a new table of noise."""
        noise = self._rng.standard_normal((TAPE, len(self.acted.low))) if explores else None
        return LivePolicy(self.rlpd.average, self.hyperparameters.history, self.observed, self.acted, noise)

    def freeze(self) -> FrozenPolicy:
        """The deterministic policy, for evaluation."""
        return frozen(self.policy(), self.observed, self.acted)

    def save(self, path: Path, *, explores: bool = False, resumable: bool = False) -> Checkpoint:
        """Write a checkpoint: a candidate, or one with everything from which a run goes on."""
        onnx, golden = members(self.policy(explores=explores), self.observed, self.acted)
        written = {POLICY: onnx, GOLDEN: golden, NOTES: json.dumps({"explores": explores}).encode()}
        if resumable:
            state = {"rlpd": self.rlpd.state_dict(), "experience": self.experience.state_dict()}
            state |= {"rng": dict(self._rng.bit_generator.state), "torch": torch.get_rng_state()}
            written |= pack(STATE, state)
        known = {"signals": self._signals, "period": self._period, "steps": self.steps, "scores": {}}
        return write_checkpoint(path, manifest(self.settings, (self.observed, self.acted), known), written)

    # ---- the first policy

    def imitate(self, policy: Any) -> None:
        """Make the actor a copy of `policy`, on observations of the simulation, where it drives with noise."""
        is_ours = self.settings.env.startswith("bam/")
        pieces = [
            self._labelled(policy, {**self.settings.env_kwargs, **dict(variant)}, noise)
            for variant in (_VARIANTS if is_ours else _VARIANTS[:1])
            for noise in _NOISES
        ]
        seen, action = (torch.from_numpy(np.concatenate(column)) for column in zip(*pieces, strict=True))
        limit = 0.97  # tanh never gets to 1
        action = action.clamp(-limit, limit)
        actor = self.rlpd.actor
        rate = torch.optim.Adam(actor.parameters(), lr=1e-3)
        for k in range(_FITS):
            rows = torch.from_numpy(self._rng.integers(len(seen), size=256))
            loss = ((torch.tanh(actor(seen[rows])[0]) - action[rows]) ** 2).mean()
            rate.param_groups[0]["lr"] = 1e-3 * (1 - k / _FITS)
            rate.zero_grad()
            loss.backward()
            rate.step()
        self.rlpd.average.load_state_dict(actor.state_dict())

    def _labelled(self, policy: Any, env_kwargs: Mapping[str, Any], noise: float) -> tuple[Any, Any]:
        """What the actor would see while `policy` drives with noise, and what that policy says there."""
        history = self.hyperparameters.history
        seen, said = [], []
        with contextlib.closing(make_vector_env(self.settings.env, env_kwargs, _ENVS)) as envs:
            observation, _ = envs.reset(seed=self.settings.seed)
            last = np.zeros((_ENVS, history + 1, len(self.acted.low)), np.float32)
            policy.reset()
            for _ in range(_STEPS):
                action = policy.act_batch(observation)
                flat = np.concatenate([observation.reshape(_ENVS, -1), last[:, :history].reshape(_ENVS, -1)], 1)
                seen.append(flat)
                said.append(self.experience.normalised(action))
                tried = (
                    action + noise * self._rng.standard_normal(action.shape) * (self.acted.high - self.acted.low) / 2
                )
                tried = np.clip(tried, self.acted.low, self.acted.high).astype(np.float32)
                observation, _, terminated, truncated, _ = envs.step(tried)
                last = np.roll(last, 1, axis=1)
                last[:, 0] = self.experience.normalised(tried)
                ended = terminated | truncated
                last[ended] = 0.0
                if ended.any():
                    policy.reset(np.flatnonzero(ended))
        return np.concatenate(seen), np.concatenate(said)
