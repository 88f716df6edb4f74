"""The base class of trainers: train in steps, save, resume, freeze the policy; and what made a checkpoint."""

from __future__ import annotations

import contextlib
import datetime
import functools
import math
import os
import platform
import random
import re
import subprocess
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from gymnasium.vector import VectorEnv

from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, write_checkpoint
from bam_train.environments import described, make_env
from bam_train.policy import FrozenPolicy
from bam_train.settings import TrainSettings
from bam_train.trainers.run_folder import TensorBoardFiles

if TYPE_CHECKING:
    from typing_extensions import Self

    from bam_train.trainers.frozen_network import FrozenNetwork

Settings = TypeVar("Settings", bound=TrainSettings)


@dataclass(frozen=True)
class Statistics:
    """Means over the last training episodes, about a hundred; None before the first one has ended."""

    episodes: int
    """Number of training episodes in the means."""
    return_mean: float | None
    """Undiscounted sum of rewards of an episode."""
    length_mean: float | None
    """Steps of an episode."""
    success_rate: float | None
    """Share of successful episodes; None too if the environment does not report success."""
    metrics: dict[str, float]
    """Finite numbers of the trainer, such as train/loss."""

    @classmethod
    def of(
        cls,
        returns: Collection[float],
        lengths: Collection[float],
        successes: Collection[float],
        metrics: Mapping[str, float],
    ) -> Statistics:
        """The means of the last episodes, of which the success may not be known, and the finite `metrics`."""
        finite = {name: value for name, value in metrics.items() if math.isfinite(value)}
        return cls(len(returns), _mean(returns), _mean(lengths), _mean(successes), finite)


def _mean(values: Collection[float]) -> float | None:
    return float(np.mean([*values])) if values else None


@dataclass(frozen=True)
class Progress:
    """The progress of training, between two updates."""

    steps: int
    """Steps trained since the start of the run."""
    total: int
    """Steps to train."""
    statistics: Callable[[], Statistics]
    """Computes the statistics, which takes longer than the rest."""


OnProgress = Callable[[Progress], bool]
"""Called between updates, when the trainer may be saved, frozen or evaluated; returns False to end training."""


class Trainer(Generic[Settings]):
    """A run of one algorithm on one environment: the base class of all trainers.

    A subclass sets the attributes, and defines `complete`, `create`, `load`, `train`, `frozen` and `resume_members`.
    """

    settings: Settings
    notices: list[str]
    """Messages for the user about this run, one line each."""
    spaces: tuple[Any, Any]
    """The environment's spaces of observations and actions."""
    evaluations = "choose"
    """``choose``: the best evaluation chooses the checkpoint; ``report``: the last weights are it; ``none``: there are
    no environments here to evaluate in."""
    _steps = 0
    _board: TensorBoardFiles | None = None

    @classmethod
    def complete(cls, settings: Settings) -> Settings:
        """Check the algorithm's settings and add its defaults, without setting up training."""
        raise NotImplementedError

    @classmethod
    def create(cls, settings: Settings) -> Self:
        """Set up a new run of complete settings; raises SettingsError if the library refuses them."""
        raise NotImplementedError

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: Settings | None = None) -> Self:
        """Set up a run that continues from a checkpoint, with the checkpoint's settings or with `settings`."""
        raise NotImplementedError

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` steps, or `on_progress` returns False.

        Raises TrainingFailed when the loss or a weight is no longer finite.
        """
        raise NotImplementedError

    def frozen(self) -> FrozenNetwork:
        """A copy of the current policy; raises TrainingFailed if a weight is not finite."""
        raise NotImplementedError

    def resume_members(self, notes: Mapping[str, Any]) -> dict[str, bytes]:
        """Members of a checkpoint from which the run goes on; the notes (JSON values) are one of them."""
        raise NotImplementedError

    def facts(self) -> dict[str, Any]:
        """Further fields of the manifest."""
        return {}

    @property
    def steps(self) -> int:
        """Steps trained since the start of the run."""
        return self._steps

    @functools.cached_property
    def described(self) -> tuple[dict[str, Any], float | None]:
        """Signals and period [s] of the environment."""
        with contextlib.closing(make_env(self.settings.env, self.settings.env_kwargs)) as env:
            return described(env)

    def members(self) -> tuple[bytes, bytes]:
        """The current policy as an ONNX file, and its golden actions."""
        return self.frozen().members()

    def save(self, path: Path, scores: Mapping[str, Any], notes: Mapping[str, Any]) -> Checkpoint:
        """Write a checkpoint that can be resumed and deployed; does not change the random numbers of training.

        The scores go into the manifest, the notes (JSON values) into ``bam/resume/notes.json``.
        """
        with self.undisturbed():
            members = self.members()
        return self.write(path, members, scores, self.resume_members(notes))

    def write(
        self, path: Path, members: tuple[bytes, bytes], scores: Mapping[str, Any], others: Mapping[str, bytes]
    ) -> Checkpoint:
        """Write a checkpoint of the `members` of a policy, and `others`."""
        (observed, acted), (signals, period), settings = self.spaces, self.described, self.settings
        fields = {
            "env": settings.env,
            "env_kwargs": settings.env_kwargs,
            "observation_space": space_to_json(observed),
            "action_space": space_to_json(acted),
            "signals": signals,
            "period": period,
            "algorithm": settings.algo,
            "trainer": settings.trainer,
            "settings": settings.to_mapping(),
            "seed": settings.seed,
            "steps": self.steps,
            "scores": scores,
            **origin(),
            **self.facts(),
        }
        return write_checkpoint(path, fields, {**others, POLICY: members[0], GOLDEN: members[1]})

    def freeze(self) -> FrozenPolicy:
        """Freeze the current policy: raw observation in, deterministic action out. Does not change training."""
        with self.undisturbed():
            graph = self.frozen().onnx_file()
        return FrozenPolicy.from_graph(graph, *map(space_to_json, self.spaces))

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Restore the random number generators of training after the ``with`` block, between two updates."""
        import torch  # cores() and origin() need none

        before = random.getstate(), np.random.get_state(), torch.get_rng_state()
        try:
            yield
        finally:
            random.setstate(before[0])
            np.random.set_state(before[1])
            torch.set_rng_state(before[2])

    @contextlib.contextmanager
    def evaluation_envs(self) -> Iterator[VectorEnv[Any, Any, Any] | None]:
        """Environments for an evaluation between two updates, where no others can be made; else None."""
        yield None

    def log_to(self, folder: Path) -> None:
        """Write TensorBoard files into a folder from now on."""
        self._board = TensorBoardFiles(folder)

    def log(self, metrics: Mapping[str, float]) -> None:
        """Add numbers to the trainer's in TensorBoard."""
        if self._board is not None:
            self._board.write(metrics, self.steps)

    def close(self) -> None:
        """Close environments and log files."""
        if self._board is not None:
            self._board.close()


_PACKAGES = ("bam-train", "gymnasium", "numpy", "mujoco", "torch", "stable-baselines3", "sb3-contrib", "ray", "onnx")


def origin() -> dict[str, Any]:
    """The software that made a checkpoint, and the time (UTC, ISO 8601)."""
    versions, commit = _software()
    created = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    return {"versions": dict(versions), "git_commit": commit, "created": created}


def cores() -> int:
    """CPUs that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def hardware() -> str:
    """The computer in words: the cores that this process may use, and what they are."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        if match := re.search(r"model name\s*: (.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8")):
            name = match[1]
    return f"{cores()} cores, {' '.join(name.split())}"


@functools.cache
def _software() -> tuple[dict[str, str], str | None]:
    """Versions of Python and packages, and the git commit if bam_train is imported from a source tree."""
    versions, commit, root = {"python": platform.python_version()}, None, Path(__file__).resolve().parents[2]
    for package in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    if (root / ".git").exists():
        ask = ["git", "-C", str(root), "rev-parse", "HEAD"]
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            done = subprocess.run(ask, capture_output=True, text=True, timeout=5, check=True)
            commit = done.stdout.strip() or None
    return versions, commit
