"""`OfflineTrainer`: a run on the episodes of a data set, without its environment; and online after that.

A step of the run is an update of the learner; online, a step of the environments. Evaluations in simulation report, and
choose nothing: the checkpoint has the last weights. Online, they choose the best as in any other run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import random
from collections.abc import Iterator
from typing import Any

import torch
from gymnasium import spaces

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.registry import are_same
from bam_envs.core.validation import read_table
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.detector import Rollout
from bam_train.data import DataSet
from bam_train.environments import control_period, make_env, require_fit
from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings, differences
from bam_train.trainers.algorithms import OFFLINE_ALGORITHMS
from bam_train.trainers.base import OnProgress, Progress, Statistics
from bam_train.trainers.detection import WANTED, recorded
from bam_train.trainers.offline.implicit_q import Cloning, ImplicitQ, ImplicitQLearner
from bam_train.trainers.offline.offline_policy import OfflinePolicy
from bam_train.trainers.offline.online_phase import OnlinePhase
from bam_train.trainers.offline.training_data import ActionCode, Normaliser, read_batch
from bam_train.trainers.resolve_settings import learnt_episodes, own_settings
from bam_train.trainers.torch_trainer import STATE, TorchTrainer

_OWN: dict[str, type[Cloning]] = {"bc": Cloning, "iql": ImplicitQ}
_REPORT_EVERY = 50  # updates between two reports of progress


class OfflineTrainer(TorchTrainer):
    """Made by `create` or `load`; `indices` are those of the training episodes."""

    def __init__(self, settings: TrainSettings, data: DataSet, indices: list[int]) -> None:
        super().__init__(settings)
        self._data, self._indices = data, indices
        self.spaces = data.info.observation_space, data.info.action_space
        self._code, self._normaliser = ActionCode(self.spaces[1]), Normaliser(self.spaces[0])
        batch, self._reward_scale = read_batch(data, indices, self._normaliser, self._code, fit=True)
        self._manifest_data = {
            "digest": data.digest,
            "episodes": [data.digests[index] for index in indices],
            "steps": len(batch),
        }
        own = _OWN.get(settings.algo)
        if own is not None:
            values = read_table(own, settings.hyperparameters, "hyperparameters", SettingsError)
            self.learner: Any = ImplicitQLearner(values, self._normaliser.inputs, self._code, batch)
        else:
            from bam_train.trainers.offline.d3rlpy_learner import D3rlpyLearner

            self.learner = D3rlpyLearner(
                settings.algo, settings.hyperparameters, self._normaliser.inputs, self._code, batch, settings.seed
            )
        self._online: OnlinePhase | None = None
        if settings.hyperparameters.get("online_from") is not None:
            self._online = OnlinePhase(settings, self._normaliser, self._code, self._reward_scale)
            self.envs = self._online.envs
        self.evaluations = "choose" if self._online else "report"
        if self._online is None and not _is_here(settings):
            self.evaluations = "none"
            self.notices.append(
                f"{settings.env} is not here: no evaluation in simulation; bam-eval --data estimates the policy's value"
            )

    @classmethod
    def complete(cls, settings: TrainSettings) -> TrainSettings:
        """Check the settings against the data set, and add the defaults of the algorithm."""
        data = _open(settings)
        for name in ("until_success", "stop_reward"):
            if getattr(settings, name) is not None and settings.hyperparameters.get("online_from") is None:
                raise SettingsError(f"{name}: nothing is chosen by simulation while learning from data; leave it out")
        OFFLINE_ALGORITHMS[settings.algo].require_actions(settings.env, type(data.info.action_space).__name__)
        Normaliser(data.info.observation_space), ActionCode(data.info.action_space)
        own = _OWN.get(settings.algo)
        if own is not None:
            table = read_table(own, settings.hyperparameters, "hyperparameters", SettingsError)
            values = dataclasses.asdict(table)
        else:
            from bam_train.trainers.offline.d3rlpy_learner import complete

            values = complete(settings.algo, settings.hyperparameters)
        env_kwargs = settings.env_kwargs or data.info.env_kwargs
        begun = values.get("online_from")
        every = settings.eval_every or (settings.steps if begun is None else max(1000, (settings.steps - begun) // 20))
        return dataclasses.replace(settings, hyperparameters=values, env_kwargs=env_kwargs, eval_every=every)

    @classmethod
    def create(cls, settings: TrainSettings) -> OfflineTrainer:
        """Set up a new run of complete settings."""
        data = _open(settings)
        return cls(settings, data, list(range(len(data))))

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: TrainSettings | None = None) -> OfflineTrainer:
        """Set up a run that continues from a checkpoint, on the same episodes, or online.

        Raises:
            CheckpointMismatch: The data set lacks an episode that the checkpoint was trained on.
        """
        own = own_settings(checkpoint, elsewhere=True) if settings is None else {}
        settings = settings or TrainSettings.from_mapping(own, str(checkpoint.path))
        data = _open(settings)
        trainer = cls(settings, data, learnt_episodes(checkpoint, data))
        with checkpoint.fitting(STATE):
            state = checkpoint.state(STATE, torch.as_tensor)
            trainer.learner.load_state_dict(state["learner"])
            if trainer._online is not None and state["online"] is not None:
                trainer._online.load_state_dict(state["online"])
            torch.set_rng_state(state["torch"])
        if trainer._online is not None:
            require_fit(checkpoint, trainer._online.envs)
        trainer._steps = checkpoint.manifest.steps
        return trainer

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` steps, or `on_progress` returns False."""
        while self._steps < steps:
            if self._online is None:
                for _ in range(min(_REPORT_EVERY, steps - self._steps)):
                    self.learner.update(self._steps, steps)
                    self._steps += 1
            else:
                self._steps += self._online.step(self.learner)
            if self.logs(steps):
                self.log(self.learner.metrics)
            if not on_progress(Progress(self._steps, steps, self._statistics)):
                return

    def _statistics(self) -> Statistics:
        return Statistics.of(() if self._online is None else self._online.ended, self.learner.metrics)

    @functools.cached_property
    def described(self) -> tuple[dict[str, Any], float | None]:
        """Signals and period [s]: the environment's, or those of the data set where it is not here."""
        info = self._data.info
        with contextlib.suppress(SettingsError, BamEnvsError), contextlib.closing(_make(self.settings)) as env:
            describe = getattr(env.unwrapped, "describe", None)
            return describe() if describe else {}, control_period(env)
        return info.contract, info.period

    def policy(self) -> OfflinePolicy:
        """A copy of the learner's actor."""
        return OfflinePolicy(self.learner.network(), self._normaliser, *self.spaces, tanh=self.learner.tanh)

    def state(self) -> dict[str, Any]:
        """The learner, and the environments of a run online."""
        online = None if self._online is None else self._online.state_dict()
        return {"learner": self.learner.state_dict(), "online": online}

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


def _open(settings: TrainSettings) -> DataSet:
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


def _make(settings: TrainSettings) -> Any:
    return make_env(settings.env, settings.env_kwargs)


def _is_here(settings: TrainSettings) -> bool:
    """Whether the environment can be made on this computer."""
    try:
        _make(settings).close()
    except (SettingsError, BamEnvsError):
        return False
    return True
