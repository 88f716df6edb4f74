"""`SB3Trainer`: a run of a stable-baselines3 algorithm that can be stopped, saved and resumed between two updates.

Progress is reported where the algorithm starts a rollout: the last update is done, and the next step not yet taken.
"""

from __future__ import annotations

import contextlib
import functools
import io
import math
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from bam_train.checkpoint import Checkpoint
from bam_train.data.record_dataset import RecordVectorDataset, info_of
from bam_train.environments import described, require_fit
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.settings import SB3Settings
from bam_train.trainers import sb3_hyperparameters as hyperparameters
from bam_train.trainers.algorithms import SB3_ALGORITHMS
from bam_train.trainers.base import OnProgress, Progress, Statistics, Trainer
from bam_train.trainers.resolve_settings import own_settings, require_start
from bam_train.trainers.run_folder import TensorBoardFiles
from bam_train.trainers.sb3 import sb3_resume as resume
from bam_train.trainers.sb3.mirrored_buffer import mirror
from bam_train.trainers.sb3.sb3_freezing import FrozenModel
from bam_train.trainers.sb3.sb3_model import make_model
from bam_train.trainers.sb3.sb3_vec_env import BatchVecEnv, make_training_env, one_env

_FINITE = "expected finite numbers: try a smaller learning_rate"
_REFUSED = ("Expected parameter", "expects all elements of std", "probability tensor")
"""Parts of torch's errors about a distribution: finite weights can still overflow in the network."""


class _Stop(Exception):  # noqa: N818 - never leaves this module
    """Ends `learn` between two updates."""


class SB3Trainer(Trainer[SB3Settings]):
    """A run of one algorithm of stable-baselines3 or sb3-contrib; made by `create` or `load`."""

    def __init__(self, settings: SB3Settings, model: Any, venv: VecEnv) -> None:
        self.settings, self.model, self.venv = settings, model, venv
        self.notices: list[str] = []
        env = one_env(venv)
        self.described = described(env)
        # The environment's spaces, before normalisation, image transposition and counting from 0.
        name = "single_{}_space" if isinstance(venv, BatchVecEnv) else "{}_space"
        self.spaces = getattr(env, name.format("observation")), getattr(env, name.format("action"))
        self._normaliser: VecNormalize | None = model.get_vec_normalize_env()
        self._waiting: resume.Waiting | None = None
        self._on_progress: OnProgress = lambda progress: True
        self._total = self._reported = 0
        model.collect_rollouts = functools.partial(self._roll_out, model.collect_rollouts)

    complete = staticmethod(hyperparameters.complete_settings)

    @classmethod
    def create(cls, settings: SB3Settings) -> SB3Trainer:
        """Set up a new run of complete settings."""
        trainer = cls._made(settings)
        if settings.start is not None:
            checkpoint = require_start(settings, settings.start)
            require_fit(checkpoint, one_env(trainer.venv), settings.place, settings.env)
            resume.begin_with(checkpoint, trainer.model, trainer._normaliser)
        return trainer

    @classmethod
    def _made(cls, settings: SB3Settings) -> SB3Trainer:
        torch.set_num_threads(settings.threads)
        given = settings.env, settings.env_kwargs, settings.num_envs, settings.place
        venv = make_training_env(*given, coarse=settings.coarse_physics, near=settings.near_starts)
        model, notices = make_model(settings, venv)
        if settings.mirror and not settings.transport:
            mirror(model, venv, settings.env)
        model.set_logger(Logger(None, []))
        trainer = cls(settings, model, venv)
        trainer.notices += notices
        return trainer

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: SB3Settings | None = None) -> SB3Trainer:
        """Set up a run that continues from a checkpoint, with the checkpoint's settings or with `settings`."""
        settings = settings or SB3Settings.from_mapping(own_settings(checkpoint), str(checkpoint.path))
        trainer = cls._made(settings)
        require_fit(checkpoint, one_env(trainer.venv), settings.place)
        trainer._waiting = resume.load(checkpoint, trainer.model, trainer.venv, trainer._normaliser)
        if not trainer._waiting.same_episodes:
            text = "cannot save running episodes: new ones begin, so the rest differs from an unbroken run"
            trainer.notices.append(f"{settings.env} {text}")
        before = checkpoint.manifest.settings.get("steps", settings.steps)
        courses = hyperparameters.over_the_whole_run(settings.hyperparameters)
        if courses and before != settings.steps:
            trainer.notices.append(
                f"{' and '.join(courses)} change{'s' if len(courses) == 1 else ''} over all of --steps, which were "
                f"{before} and are {settings.steps}: the result differs from an unbroken run's"
            )
        return trainer

    def record(self, place: str) -> None:
        """Add the episodes of training to the data set at `place` from now on."""
        if not isinstance(self.venv, BatchVecEnv):
            raise SettingsError(
                f"--record: {self.settings.env} is not of bam_envs; use bam-data collect, or RecordDataset"
            )
        batch, facts = self.venv.batch, {"policy": f"{self.settings.algo} in training", "run": self.settings.seed}
        info = info_of(batch.env, self.settings.env, self.settings.env_kwargs)
        batch.env = RecordVectorDataset(batch.env, place, info, facts)

    def log_to(self, folder: Path) -> None:
        """Write TensorBoard files into a folder from now on."""
        self.model.set_logger(Logger(str(folder), [_ToTensorBoard(folder)]))

    @property
    def steps(self) -> int:
        """Steps trained since the start of the run."""
        return int(self.model.num_timesteps)

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` steps, or `on_progress` returns False."""
        if steps <= self.steps:
            return
        self._on_progress, self._total, self._reported = on_progress, steps, self.steps
        log_interval = max(4, self.settings.num_envs)  # episodes, or rollouts, between two entries of the log
        if SB3_ALGORITHMS[self.settings.algo].on_policy:
            log_interval = int(max(1, 2048 // (self.model.n_steps * self.settings.num_envs)))
        with contextlib.suppress(_Stop), self._finite_distributions():
            # reset_num_timesteps=False: the total counts the remaining steps, and a restored episode continues.
            with np.errstate(over="ignore", invalid="ignore"):  # NaN raises TrainingFailed instead of warnings
                self.model.learn(steps - self.steps, log_interval=log_interval, reset_num_timesteps=False)
            self._between()

    @contextlib.contextmanager
    def _finite_distributions(self) -> Iterator[None]:
        """Turn torch's errors about a distribution of NaN, also during an update, into TrainingFailed."""
        try:
            yield
        except (ValueError, RuntimeError) as error:
            if self._is_finite() and not any(text in str(error) for text in _REFUSED):
                raise
            text = f"the policy's weights or actions are NaN or infinite after step {self.steps}; {_FINITE}"
            raise TrainingFailed(text) from error

    def _roll_out(self, collect: Any, *args: Any, **kwargs: Any) -> Any:
        """Replacement of the algorithm's `collect_rollouts`, which it calls between two updates."""
        if self._waiting is not None:
            waiting, self._waiting = self._waiting, None
            waiting.restore(self.model)
        if self.steps > self._reported:
            self._between()
        return collect(*args, **kwargs)

    def _between(self) -> None:
        self._reported = self.steps
        for name, value in self.model.logger.name_to_value.items():
            if "loss" in name and not math.isfinite(value):
                raise TrainingFailed(f"{name} is {value} at step {self.steps}; {_FINITE}")
        if SB3_ALGORITHMS[self.settings.algo].on_policy:
            self._require_finite_weights()
        if not self._on_progress(Progress(self.steps, self._total, self._statistics)):
            raise _Stop

    def _is_finite(self) -> bool:
        """Whether all parameters of the policy, and the standard deviation of its actions, are finite numbers."""
        log_std = getattr(self.model.policy, "log_std", None)
        numbers = [*self.model.policy.parameters(), *([] if log_std is None else [log_std.exp()])]
        return all(bool(torch.isfinite(tensor).all()) for tensor in numbers)

    def _require_finite_weights(self) -> None:
        if not self._is_finite():
            raise TrainingFailed(f"the policy's weights are NaN or infinite at step {self.steps}; {_FINITE}")

    def _statistics(self) -> Statistics:
        episodes, successes = self.model.ep_info_buffer or (), self.model.ep_success_buffer or ()
        logged = self.model.logger.name_to_value.items()
        numbers = {name: float(value) for name, value in logged if name.startswith("train/")}
        return Statistics.of([one["r"] for one in episodes], [one["l"] for one in episodes], successes, numbers)

    def frozen(self) -> FrozenModel:
        """A copy of the current policy."""
        self._require_finite_weights()
        return FrozenModel(self.model, self._normaliser, *self.spaces)

    def members(self) -> tuple[bytes, bytes]:
        """The current policy as an ONNX file, and its golden actions."""
        with self._finite_distributions():
            return super().members()

    def resume_members(self, notes: Mapping[str, Any]) -> dict[str, bytes]:
        """Members of a checkpoint from which the run goes on, and those that stable-baselines3's `load` opens."""
        file = io.BytesIO()
        self.model.save(file, exclude=["collect_rollouts"])
        with zipfile.ZipFile(file) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        return members | resume.members(self.model, self.venv, self._normaliser, self._waiting, notes)

    @contextlib.contextmanager
    def evaluation_envs(self) -> Iterator[VectorEnv[Any, Any, Any] | None]:
        """The training environments, if no others can be made; their running episodes are then truncated."""
        if not self.settings.transport:
            yield None
            return
        try:
            yield one_env(self.venv)
        finally:  # with training's last observations, before normalisation; None before its first step
            last, normaliser = self.model._last_obs, self._normaliser
            if last is not None and normaliser is not None:
                last = normaliser.get_original_obs()
            self.venv.interrupt(last)

    def log(self, metrics: Mapping[str, float]) -> None:
        """Add numbers to the trainer's in TensorBoard."""
        for name, value in metrics.items():
            self.model.logger.record(name, value)

    def close(self) -> None:
        """Close environments and log files."""
        self.model.logger.dump(self.steps)
        self.model.logger.close()
        self.model.env.close()


class _ToTensorBoard(KVWriter):  # type: ignore[misc]
    def __init__(self, folder: Path) -> None:
        self._files = TensorBoardFiles(folder)

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self._files.write(
            {name: one for name, one in key_values.items() if "tensorboard" not in key_excluded[name]}, step
        )

    def close(self) -> None:
        self._files.close()
