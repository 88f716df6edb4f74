"""`DaggerTrainer`: a run of DAgger that can be stopped, saved and resumed between two steps."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

import torch

from bam_envs.core.validation import read_table
from bam_train.checkpoint import Checkpoint
from bam_train.environments import make_env, make_vector_env, require_fit
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.finite_envs import FiniteVectorEnv
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import IMITATION_ALGORITHMS
from bam_train.trainers.base import OnProgress, Progress
from bam_train.trainers.imitation.dagger import Dagger, DaggerLearner
from bam_train.trainers.imitation.imitation_network import ImitationPolicy
from bam_train.trainers.imitation.teacher import Teacher
from bam_train.trainers.resolve_settings import own_settings
from bam_train.trainers.torch_trainer import STATE, TorchTrainer


class DaggerTrainer(TorchTrainer):
    """Made by `create` or `load`."""

    def __init__(self, settings: TrainSettings) -> None:
        super().__init__(settings)
        envs = make_vector_env(settings.env, settings.env_kwargs, settings.num_envs, settings.place)
        self.envs: Any = FiniteVectorEnv(envs, settings.env)
        self.spaces = envs.single_observation_space, envs.single_action_space
        try:
            values = read_table(Dagger, settings.hyperparameters, "hyperparameters", SettingsError)
            self.learner = DaggerLearner(values, settings.seed, self.envs, Teacher(settings, envs))
        except BaseException:
            envs.close()
            raise

    @classmethod
    def complete(cls, settings: TrainSettings) -> TrainSettings:
        """Check the settings, and add the defaults of the algorithm."""
        if settings.teacher is None:
            raise SettingsError(
                "teacher: dagger imitates a teacher, found none. Give --teacher CHECKPOINT or --teacher scripted"
            )
        if settings.transport:
            raise SettingsError("transport: dagger needs the environment here, with its teacher; leave it out")
        with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
            IMITATION_ALGORITHMS[settings.algo].require_actions(settings.env, type(env.action_space).__name__)
        values = read_table(Dagger, settings.hyperparameters, "hyperparameters", SettingsError)
        least = 2 * values.batch_size
        for name, steps in (("steps", settings.steps), ("memory", values.memory)):
            if steps < least:
                raise SettingsError(f"{name}: dagger learns from {least} steps on, twice batch_size, found {steps}")
        every = settings.eval_every or max(1000, settings.steps // 5)
        return dataclasses.replace(settings, hyperparameters=dataclasses.asdict(values), eval_every=every)

    @classmethod
    def create(cls, settings: TrainSettings) -> DaggerTrainer:
        """Set up a new run of complete settings."""
        return cls(settings)

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: TrainSettings | None = None) -> DaggerTrainer:
        """Set up a run that continues from a checkpoint, with new episodes, and without the old steps."""
        settings = settings or TrainSettings.from_mapping(own_settings(checkpoint), str(checkpoint.path))
        trainer = cls(settings)
        require_fit(checkpoint, trainer.envs)
        trainer._steps = checkpoint.manifest.steps
        with checkpoint.fitting(STATE):
            state = checkpoint.state(STATE, torch.as_tensor)
            trainer.learner.load_state_dict(state["learner"], trainer._done(settings.steps))
            torch.set_rng_state(state["torch"])
        text = "the steps that were learnt from are not saved: new ones are collected, so the rest differs from an"
        trainer.notices.append(f"{text} unbroken run")
        return trainer

    def _done(self, steps: int) -> float:
        return min(1.0, self._steps / steps)

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` steps, or `on_progress` returns False."""
        while self._steps < steps:
            self._steps += self.learner.step(self._done(steps))
            self.learner.learn(self._done(steps))
            if self.logs(steps):
                self._require_finite()
                self.log(self.learner.metrics)
            if not on_progress(Progress(self._steps, steps, self.learner.statistics)):
                return

    def _require_finite(self) -> None:
        if not all(bool(torch.isfinite(one).all()) for one in self.learner.network.parameters()):
            text = f"the network's weights are NaN or infinite at step {self._steps}"
            raise TrainingFailed(f"{text}; expected finite numbers: try a smaller learning_rate")

    def policy(self) -> ImitationPolicy:
        """A copy of the network."""
        self._require_finite()
        return ImitationPolicy(self.learner.network, *self.spaces)

    def state(self) -> dict[str, Any]:
        """The learner, without the steps that it has learnt from."""
        return {"learner": self.learner.state_dict()}
