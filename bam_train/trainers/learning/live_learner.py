"""A learner that gets transitions and gives candidates, without a connection; and the policies that it gives.

A policy is an actor that remembers its last actions, and may explore.

A robot runs frozen policies, which draw no random numbers. So a policy that explores carries its noise: a table of
`TAPE` draws, of which each step takes the next. An episode begins at a place that follows from its first observation;
otherwise the noise of a step would be the same in all episodes of a candidate, and would be imitated like a skill.
"""

from __future__ import annotations

import contextlib
import copy
import json
from collections.abc import Mapping
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from bam_train.agent.transitions import LiveTransitions
from bam_train.checkpoint import Checkpoint
from bam_train.environments import make_env, make_vector_env, require_fit
from bam_train.errors import CheckpointMismatch, SettingsError, TrainingFailed
from bam_train.policy import FrozenPolicy
from bam_train.rollout import play
from bam_train.settings import SB3Settings
from bam_train.trainers.frozen_network import FrozenNetwork, action_head
from bam_train.trainers.learning.experience import Experience
from bam_train.trainers.learning.networks import Descent
from bam_train.trainers.learning.replay_memory import ActionCode
from bam_train.trainers.learning.rlpd import Actor, Rlpd
from bam_train.trainers.learning.torch_trainer import NOTES, STATE, TorchLearner

ALGORITHM, TRAINER = "rlpd", "live"
_LARGEST = 500_000  # transitions that are kept
_RECENT = 50  # episodes of the success rate
_VARIANTS: tuple[dict[str, Any], ...] = (
    {},
    *({"link": {"command_delay": [late, late], "state_delay": [0.0, 0.0]}} for late in (0.1, 0.2)),
)
"""Arguments of our environments in which a policy is copied, so that the copy is right on a late robot too."""
_NOISES = (0.0, 0.3)
_ENVS, _STEPS, _FITS = 32, 250, 3000
_LIMIT = 0.97  # greatest action of a copy: tanh never gets to 1

TAPE = 512
"""Steps of noise in a policy, a power of two; after the last comes the first."""
_FINE = 1000.0  # parts of a number that make another beginning


class LivePolicy(FrozenNetwork):
    """A copy of an actor, from raw observations to actions; its state are the last actions, and a place in the noise.

    Args:
        actor: The actor.
        history: Last actions that it sees.
        seen: The environment's observation space.
        acts: The environment's action space, with bounds.
        noise: Standard normal numbers for exploration, (TAPE, a); None for the deterministic policy.
    """

    def __init__(self, actor: Actor, history: int, seen: spaces.Box, acts: spaces.Box, noise: Any = None) -> None:
        super().__init__(seen)
        self.actor = copy.deepcopy(actor).cpu().eval().requires_grad_(False)
        self.head = action_head(acts, tanh=True, scale=True, clip=True)
        self.kept = (history - 1) * acts.shape[0]
        self.noise = None if noise is None else torch.as_tensor(noise, dtype=torch.float32)
        self.odd = torch.arange(1, 2 * int(np.prod(seen.shape)), 2, dtype=torch.float64)
        if history:
            self.state["actions"] = torch.zeros(2, history * acts.shape[0])
        if noise is not None:
            self.state["place"] = torch.zeros(2, 1)  # 0: an episode begins; else 1 more than the place in the table

    def forward(self, *inputs: torch.Tensor) -> Any:
        """The action, and the next state."""
        observation, *state = inputs
        actions = state[0] if "actions" in self.state else None
        seen = observation.flatten(1) if actions is None else torch.cat([observation.flatten(1), actions], 1)
        mean, log_deviation = self.actor(seen)
        following, place = [], torch.zeros(())
        if self.noise is not None:
            place = torch.where(state[-1] < 0.5, self._beginning(observation.flatten(1)), state[-1] - 1.0)
            mean = mean + self.noise.index_select(0, place[:, 0].long()) * log_deviation.exp()
        if actions is not None:
            following.append(torch.cat([torch.tanh(mean), actions[:, : self.kept]], 1))
        if self.noise is not None:
            place = place + 1.0
            following.append(place * (place < TAPE).float() + 1.0)
        action = self.head(mean)
        return (action, *following) if following else action

    def _beginning(self, observation: torch.Tensor) -> torch.Tensor:
        """A place in the table for the first observation, in whole numbers, which are exact everywhere. (n, 1)."""
        parts = (observation * _FINE).long().abs().double()
        total = (parts * self.odd).sum(1, keepdim=True)
        return (total - TAPE * (total / TAPE).long().double()).float()


def require_spaces(observed: Any, acted: Any) -> tuple[spaces.Box, spaces.Box]:
    """The spaces of observations and actions; raises SettingsError if they are not arrays of bounded numbers."""
    if not isinstance(observed, spaces.Box) or observed.dtype != np.float32:
        raise SettingsError(f"--learner: expected an observation space Box of float32, found {observed}")
    if not isinstance(acted, spaces.Box) or len(acted.shape) != 1 or not acted.is_bounded("both"):
        raise SettingsError(f"--learner: expected an action space Box of one axis with bounds, found {acted}")
    return observed, acted


class LiveLearner(TorchLearner[SB3Settings]):
    """Made by `create` or `load`."""

    def __init__(self, settings: SB3Settings) -> None:
        super().__init__(settings)
        with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
            self.spaces = require_spaces(env.observation_space, env.action_space)
            if settings.start is not None:
                require_fit(Checkpoint.open(settings.start), env)
        options, self._code = self.options, ActionCode(self.spaces[1])
        inputs = int(np.prod(self.spaces[0].shape)) + options.history * self._code.size
        self.rlpd = Rlpd(inputs, self._code.size, options)
        self.experience = Experience(
            min(_LARGEST, 2 * settings.steps),
            self._code,
            history=options.history,
            gamma=options.gamma,
            ahead=options.ahead,
        )
        self.parts = {"rlpd": self.rlpd, "experience": self.experience, "rng": self._rng}

    @classmethod
    def create(cls, settings: SB3Settings) -> LiveLearner:
        """A new learner, whose policy is a copy of that of the checkpoint `start`, if there is one."""
        learner = cls(settings)
        if settings.start is not None:
            learner.imitate(FrozenPolicy.load(settings.start))
        return learner

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint of `save`.

        Raises:
            CheckpointMismatch: It is of another trainer, or of a candidate.
        """
        made = checkpoint.manifest
        if (made.trainer, made.algorithm) != (TRAINER, ALGORITHM) or not checkpoint.has(f"{STATE}.json"):
            text = f"was made by {made.algorithm} of {made.trainer}, and not by a run with --learner"
            raise CheckpointMismatch(checkpoint.path, f"{text}: a new run can begin with it by --start")
        super().restore(checkpoint)

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
        if found != (self.spaces[0].shape, self.spaces[1].shape):
            expected = f"expected those of {self.settings.env}, {self.spaces[0].shape} and {self.spaces[1].shape}"
            raise TrainingFailed(
                f"observations and actions of the agent have shapes {found[0]} and {found[1]}, {expected}"
            )
        self.experience.add(transitions)

    @property
    def due(self) -> int:
        """Updates that are due for the steps so far."""
        return int(self.options.update_ratio * self.steps) - self.rlpd.updates

    @property
    def is_ready(self) -> bool:
        """Whether policies have driven long enough for the actor to change."""
        return bool(self.steps - self.experience.interventions >= self.options.actor_after)

    def learn(self, most: int) -> int:
        """Do the updates that are due, at most `most`; returns how many."""
        count, options = min(most, self.due), self.options
        size, share = options.batch_size, options.demonstration_share
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
        noise = self._rng.standard_normal((TAPE, self._code.size)) if explores else None
        return LivePolicy(self.rlpd.average, self.options.history, *self.spaces, noise)

    def save_candidate(self, path: Path, *, explores: bool = True) -> Checkpoint:
        """Write a checkpoint that can be deployed, without what a run goes on from."""
        members = self.frozen(explores=explores).members()
        return self.write(path, members, {}, {NOTES: json.dumps({"explores": explores}).encode()})

    # ---- the first policy

    def imitate(self, policy: Any) -> None:
        """Make the actor a copy of `policy`, on observations of the simulation, where it drives with noise."""
        driven = [
            self._driven(policy, {**self.settings.env_kwargs, **dict(variant)}, noise)
            for variant in (_VARIANTS if self.settings.env.startswith("bam/") else _VARIANTS[:1])
            for noise in _NOISES
        ]
        seen = torch.from_numpy(np.concatenate([part for one in driven for part in one.seen]))
        action = torch.cat([part for one in driven for part in one.said]).clamp(-_LIMIT, _LIMIT)
        actor = self.rlpd.actor
        optimiser = Descent("copy", actor.parameters(), 1e-3)
        for k in range(_FITS):
            rows = torch.from_numpy(self._rng.integers(len(seen), size=256))
            loss = ((torch.tanh(actor(seen[rows])[0]) - action[rows]) ** 2).mean()
            optimiser.descend(loss, 1 - k / _FITS)
        self.rlpd.average.load_state_dict(actor.state_dict())

    def _driven(self, policy: Any, env_kwargs: Mapping[str, Any], noise: float) -> _Noisy:
        with contextlib.closing(make_vector_env(self.settings.env, env_kwargs, _ENVS)) as envs:
            noisy = _Noisy(policy, self._code, self.options.history, self.spaces[1], noise, self._rng)
            for _ in islice(play(envs, noisy, seed=self.settings.seed), _STEPS):
                pass
        return noisy


class _Noisy:
    """A policy that drives `_ENVS` environments with noise; keeps what an actor would see, and what it says there."""

    def __init__(
        self, policy: Any, code: ActionCode, history: int, acted: spaces.Box, noise: float, rng: np.random.Generator
    ) -> None:
        self._policy, self._code, self._space, self._noise, self._rng = policy, code, acted, noise, rng
        self._last = np.zeros((_ENVS, history + 1, code.size), np.float32)  # newest first, and one more
        self.seen: list[Any] = []
        self.said: list[torch.Tensor] = []

    def reset(self, env_ids: Any = None) -> None:
        self._policy.reset(env_ids)
        self._last[slice(None) if env_ids is None else env_ids] = 0.0

    def act_batch(self, observations: Any) -> Any:
        action, (low, high) = self._policy.act_batch(observations), (self._space.low, self._space.high)
        self.seen.append(np.concatenate([part.reshape(_ENVS, -1) for part in (observations, self._last[:, :-1])], 1))
        self.said.append(self._code.encode(action))
        tried = action + self._noise * self._rng.standard_normal(action.shape) * (high - low) / 2
        tried = np.clip(tried, low, high).astype(np.float32)
        self._last = np.roll(self._last, 1, axis=1)
        self._last[:, 0] = self._code.encode(tried)
        return tried
