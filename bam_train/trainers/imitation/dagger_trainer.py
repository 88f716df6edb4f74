"""`DaggerTrainer`: a run of DAgger that can be stopped, saved and resumed between two steps."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from gymnasium.vector import VectorEnv

from bam_envs.core.spaces import space_to_json
from bam_envs.core.validation import read_table
from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, write_checkpoint
from bam_train.checkpoint.safetensors_file import pack
from bam_train.environments import control_period, make_env, make_vector_env, require_fit
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.finite_envs import FiniteVectorEnv
from bam_train.policy import FrozenPolicy
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import IMITATION_ALGORITHMS
from bam_train.trainers.base import OnProgress, Progress, manifest
from bam_train.trainers.imitation.dagger import Dagger, DaggerLearner
from bam_train.trainers.imitation.imitation_network import ImitationPolicy
from bam_train.trainers.imitation.teacher import Teacher
from bam_train.trainers.resolve_settings import own_settings
from bam_train.trainers.tensorboard_files import TensorBoardFiles

STATE, NOTES = "bam/resume/state", "bam/resume/notes.json"
_LOGGED = 200  # entries of TensorBoard in a run


class DaggerTrainer:
    """Made by `create` or `load`."""

    evaluations = "choose"

    def __init__(self, settings: TrainSettings) -> None:
        torch.set_num_threads(settings.threads)
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.notices: list[str] = []
        envs = make_vector_env(settings.env, settings.env_kwargs, settings.num_envs, settings.place)
        self.envs: Any = FiniteVectorEnv(envs, settings.env)
        self._spaces = envs.single_observation_space, envs.single_action_space
        try:
            values = read_table(Dagger, settings.hyperparameters, "hyperparameters", SettingsError)
            self.learner = DaggerLearner(values, settings.seed, self.envs, Teacher(settings, envs))
        except BaseException:
            envs.close()
            raise
        self._steps = self._logged = 0
        self._board: TensorBoardFiles | None = None

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

    def log_to(self, folder: Path) -> None:
        """Write TensorBoard files into a folder from now on."""
        self._board = TensorBoardFiles(folder)

    @property
    def steps(self) -> int:
        """Steps trained since the start of the run."""
        return self._steps

    def _done(self, steps: int) -> float:
        return min(1.0, self._steps / steps)

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` steps, or `on_progress` returns False."""
        while self._steps < steps:
            self._steps += self.learner.step(self._done(steps))
            self.learner.learn(self._done(steps))
            if self._steps - self._logged >= steps // _LOGGED:
                self._logged = self._steps
                self._require_finite()
                self.log(self.learner.metrics)
            if not on_progress(Progress(self._steps, steps, self.learner.statistics)):
                return

    def _require_finite(self) -> None:
        if not all(bool(torch.isfinite(one).all()) for one in self.learner.network.parameters()):
            text = f"the network's weights are NaN or infinite at step {self._steps}"
            raise TrainingFailed(f"{text}; expected finite numbers: try a smaller learning_rate")

    @functools.cached_property
    def _described(self) -> tuple[dict[str, Any], float | None]:
        """Signals and period [s] of the environment."""
        with contextlib.closing(make_env(self.settings.env, self.settings.env_kwargs)) as env:
            describe = getattr(env.unwrapped, "describe", None)
            return describe() if describe else {}, control_period(env)

    def _policy(self) -> ImitationPolicy:
        self._require_finite()
        return ImitationPolicy(self.learner.network, *self._spaces)

    def save(self, path: Path, scores: Mapping[str, Any], notes: Mapping[str, Any]) -> Checkpoint:
        """Write a checkpoint that can be resumed and deployed."""
        with self.undisturbed():
            onnx, golden = self._policy().members()
        state = {"learner": self.learner.state_dict(), "torch": torch.get_rng_state()}
        members = {POLICY: onnx, GOLDEN: golden, NOTES: json.dumps(dict(notes)).encode(), **pack(STATE, state)}
        signals, period = self._described
        known = {"signals": signals, "period": period, "steps": self.steps, "scores": scores}
        return write_checkpoint(path, manifest(self.settings, self._spaces, known), members)

    def freeze(self) -> FrozenPolicy:
        """Freeze the current policy."""
        with self.undisturbed():
            graph = self._policy().onnx_file()
        return FrozenPolicy.from_graph(graph, *map(space_to_json, self._spaces))

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Restore the random number generator of training after the ``with`` block."""
        before = torch.get_rng_state()
        try:
            yield
        finally:
            torch.set_rng_state(before)

    @contextlib.contextmanager
    def evaluation_envs(self) -> Iterator[VectorEnv[Any, Any, Any] | None]:
        """None: others are made."""
        yield None

    def log(self, metrics: Mapping[str, float]) -> None:
        """Write numbers into TensorBoard's files."""
        if self._board is not None:
            self._board.write(dict(metrics), self.steps)

    def close(self) -> None:
        """Close environments and log files."""
        if self._board is not None:
            self._board.close()
        self.envs.close()
