"""`OfflineTrainer`: a run on the episodes of a data set, without its environment; and online after that.

A step of the run is an update of the learner; online, a step of the environments. Evaluations in simulation report, and
choose nothing: the checkpoint has the last weights. Online, they choose the best as in any other run, and the learner
goes on with its own experience, half of every batch, beside the data set.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import random
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.registry import are_same
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.detector import Rollout
from bam_train.data import DataSet
from bam_train.environments import make_env, make_vector_env
from bam_train.errors import SettingsError
from bam_train.settings import OfflineSettings, differences
from bam_train.trainers.algorithms import ALGORITHMS
from bam_train.trainers.detection import WANTED, recorded
from bam_train.trainers.learner_hyperparameters import HYPERPARAMETERS
from bam_train.trainers.learning.implicit_q import ImplicitQLearner
from bam_train.trainers.learning.networks import Encoders, LearntPolicy
from bam_train.trainers.learning.replay_memory import ActionCode, ReplayMemory
from bam_train.trainers.learning.torch_trainer import TorchTrainer, restore, state_of
from bam_train.trainers.resolve_settings import learnt_episodes, own_settings

_REPORT_EVERY = 50  # updates between two reports of progress
_LEAST = 1e-3  # standard deviation of a value that was (almost) constant in the data
_LARGEST = 200_000  # transitions of its own that are kept online
_COLUMNS = ("seen", "action", "reward", "after", "terminal")
_DONE = 0.5  # online, the learning rate stays at half of the first one


def transitions(
    data: DataSet, indices: Sequence[int], encoders: Encoders, code: ActionCode
) -> tuple[ReplayMemory, float]:
    """All transitions of some episodes, and the deviation of their rewards; `encoders` learn their moments.

    Columns: seen (n, inputs) and, a step later, after (n, inputs), both encoded; action (n, k), coded; reward (n,), in
    standard deviations; terminal (n,), 1 where the task ended with the step. All float32.

    Raises:
        SettingsError: A number is not finite.
    """
    steps = data.transitions(indices)
    seen, after = encoders.tensors(steps.observations), encoders.tensors(steps.next_observations)
    numbers = map(torch.as_tensor, (*seen, *after, steps.rewards, steps.actions))
    if not all(bool(torch.isfinite(one).all()) for one in numbers):
        raise SettingsError(f"data: {data.place} has a number that is not finite; find it with bam-data check")
    scale, memory = float(steps.rewards.std()) or 1.0, ReplayMemory(len(steps.rewards))
    encoders.learn(seen)
    memory.add(
        seen=encoders(*seen),
        action=code.encode(steps.actions),
        reward=(steps.rewards / scale).astype(np.float32),
        after=encoders(*after),
        terminal=np.asarray(steps.terminals, np.float32),
    )
    return memory, scale


class OfflineTrainer(TorchTrainer[OfflineSettings]):
    """Made by `create` or `load`; `indices` are those of the training episodes.

    Online, the policy that is played is the learner with noise.
    """

    def __init__(
        self, settings: OfflineSettings, data: DataSet | None = None, indices: list[int] | None = None
    ) -> None:
        super().__init__(settings)
        self._data = data = data or _open(settings)
        self._indices = list(range(len(data))) if indices is None else indices
        self.spaces = data.info.observation_space, data.info.action_space
        self._code, self._encoders = ActionCode(self.spaces[1]), Encoders(self.spaces[0], _LEAST)
        memory, self._reward_scale = transitions(data, self._indices, self._encoders, self._code)
        self._manifest_data = {
            "digest": data.digest,
            "episodes": [data.digests[index] for index in self._indices],
            "steps": len(memory),
        }
        made_of = self.options, self._encoders.outputs, self._code, memory
        if settings.algo in HYPERPARAMETERS:
            self.learner: Any = ImplicitQLearner(*made_of)
        else:
            from bam_train.trainers.learning.d3rlpy_learner import D3rlpyLearner

            self.learner = D3rlpyLearner(settings.algo, *made_of, settings.seed)
        self.parts, self.evaluations = {"learner": self.learner.parts}, "report"
        if getattr(self.options, "online_from", None) is not None:
            self.evaluations = "choose"
            self.envs = make_vector_env(settings.env, settings.env_kwargs, settings.num_envs, settings.place)
            self._own, self._acted = ReplayMemory(_LARGEST), (torch.zeros(0), torch.zeros(0))
            self.play()
        elif not _is_here(settings):
            self.evaluations = "none"
            self.notices.append(
                f"{settings.env} is not here: no evaluation in simulation; bam-eval --data estimates the policy's value"
            )

    @classmethod
    def read_options(cls, settings: OfflineSettings) -> Any:
        """The hyperparameters with their defaults: a dataclass, of an algorithm of d3rlpy a dict."""
        if settings.algo in HYPERPARAMETERS:
            return super().read_options(settings)
        from bam_train.trainers.learning.d3rlpy_learner import complete

        return complete(settings.algo, settings.hyperparameters)

    @classmethod
    def complete(cls, settings: OfflineSettings) -> OfflineSettings:
        """Check the settings against the data set, and add the defaults of the algorithm."""
        data = _open(settings)
        for name in ("until_success", "stop_reward"):
            if getattr(settings, name) is not None and settings.hyperparameters.get("online_from") is None:
                raise SettingsError(f"{name}: nothing is chosen by simulation while learning from data; leave it out")
        ALGORITHMS["offline"][settings.algo].require_actions(settings.env, type(data.info.action_space).__name__)
        Encoders(data.info.observation_space, _LEAST), ActionCode(data.info.action_space)
        options = cls.read_options(settings)
        values = options if isinstance(options, dict) else dataclasses.asdict(options)
        env_kwargs, begun = settings.env_kwargs or data.info.env_kwargs, values.get("online_from")
        every = settings.eval_every or (settings.steps if begun is None else max(1000, (settings.steps - begun) // 20))
        return dataclasses.replace(settings, hyperparameters=values, env_kwargs=env_kwargs, eval_every=every)

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: OfflineSettings | None = None) -> OfflineTrainer:
        """Set up a run that continues from a checkpoint, on the same episodes, or online.

        Raises:
            CheckpointMismatch: The data set lacks an episode that the checkpoint was trained on.
        """
        own = own_settings(checkpoint, elsewhere=True) if settings is None else {}
        settings = settings or OfflineSettings.from_mapping(own, str(checkpoint.path))
        data = _open(settings)
        trainer = cls(settings, data, learnt_episodes(checkpoint, data))
        trainer.restore(checkpoint)
        return trainer

    def advance(self, total: int) -> None:
        """Do some updates; online, step all environments once, then do the updates that are due."""
        if self.envs is None:
            for _ in range(min(_REPORT_EVERY, total - self._steps)):
                self.learner.update(self._steps, total)
                self._steps += 1
        else:
            self._advance_online()
        self.metrics = self.learner.metrics

    def _advance_online(self) -> None:
        step, (seen, codes) = next(self.playing), self._acted
        self._own.add(
            seen=seen,
            action=codes,
            reward=(step.rewards / self._reward_scale).astype(np.float32),
            after=self._encoders(*self._encoders.tensors(step.following)),
            terminal=step.terminated.astype(np.float32),
        )
        self.ended += step.ended
        self._steps += len(step.rewards)
        size = self.options.batch_size
        for _ in self.take_due(len(step.rewards) * self.options.update_ratio):
            shown = self.learner.data.draw(size - size // 2)
            self.learner.update_online(self._own.draw(size // 2).joined(shown), _DONE)

    def act_batch(self, observations: Any) -> Any:
        """Actions of the learner, with noise."""
        seen = self._encoders(*self._encoders.tensors(observations))
        with torch.no_grad():
            scores = self.learner.network(seen)
        if self._code.is_discrete:
            choice = scores.argmax(1)
            tried = torch.rand(len(choice)) < self.options.exploration
            choice = torch.where(tried, torch.randint(self._code.size, choice.shape), choice)
            codes = torch.nn.functional.one_hot(choice, self._code.size).float()
        else:
            codes = (torch.tanh(scores) + self.options.exploration * torch.randn_like(scores)).clamp(-1, 1)
        self._acted = seen, codes
        return self._code.decode(codes)

    @functools.cached_property
    def described(self) -> tuple[dict[str, Any], float | None]:
        """Signals and period [s]: the environment's, or those of the data set where it is not here."""
        with contextlib.suppress(SettingsError, BamEnvsError):
            return super().described
        return self._data.info.contract, self._data.info.period

    def policy(self) -> LearntPolicy:
        """A copy of the learner's actor."""
        return LearntPolicy(self._encoders, self.learner.network, *self.spaces, tanh=self.learner.tanh)

    def state(self) -> dict[str, Any]:
        """The learner; online, its own transitions and random numbers too: running episodes begin anew."""
        online = None
        if self.envs is not None:
            own = [*self._own.columns().values()] or None
            online = {"own": own, "added": self._own.added, "due": self._due, "rng": state_of(self._rng)}
        return {**super().state(), "online": online}

    def load_state(self, state: Any) -> None:
        """Restore the result of `state`."""
        super().load_state(state)
        if self.envs is not None and (online := state["online"]) is not None:
            self._own.load(dict(zip(_COLUMNS, online["own"] or (), strict=False)), int(online["added"]))
            restore(self._rng, online["rng"])
            self._due = float(online["due"])
            self.play()

    def facts(self) -> dict[str, Any]:
        """The data that were learnt from."""
        return {"data": self._manifest_data}

    def rollouts(self) -> Iterator[Rollout]:
        """Some of the training episodes in random order, for the detector of unusual observations."""
        if not isinstance(self.spaces[0], spaces.Box) or self.spaces[0].dtype == "uint8":
            return
        ticks, order = 0, list(self._indices)
        random.Random(self.settings.seed).shuffle(order)
        for index in order:
            episode = self._data[index]
            yield recorded(episode, self._data.info.period)
            ticks += len(episode)
            if ticks >= WANTED:
                return


def _open(settings: OfflineSettings) -> DataSet:
    """The data set of a run; raises SettingsError if there is none, or it is of another environment."""
    if settings.data is None:
        raise SettingsError(f"data: {settings.algo} learns from a data set, found none. Give its place with --data")
    data = DataSet.open(settings.data)
    if not len(data):
        raise SettingsError(f"data: {settings.data} has no episodes yet. Record some first")
    if data.info.env != settings.env and not are_same(settings.env, data.info.env):
        raise SettingsError(f"data: {settings.data} is of {data.info.env}, not of {settings.env}; leave --env out")
    differing = differences(settings.env_kwargs, data.info.env_kwargs)
    for name, wanted, found in differing[:1]:
        raise SettingsError(f"env_kwargs.{name}: {settings.data} was recorded with {found!r}, not {wanted!r}")
    return data


def _is_here(settings: OfflineSettings) -> bool:
    """Whether the environment can be made on this computer."""
    with contextlib.suppress(SettingsError, BamEnvsError):
        env: Any = make_env(settings.env, settings.env_kwargs)
        env.close()
        return True
    return False
