"""The interface of trainers: train in steps, save, resume, freeze the policy; and the manifest of their checkpoints."""

import contextlib
import datetime
import functools
import os
import platform
import re
import subprocess
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium import Space
from gymnasium.vector import VectorEnv

from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import Checkpoint
from bam_train.policy import FrozenPolicy
from bam_train.rollout import PlayedEpisode
from bam_train.settings import TrainSettings


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
    def of(cls, episodes: Collection[PlayedEpisode], metrics: Mapping[str, float]) -> "Statistics":
        """The means over `episodes`."""
        known = [one.success for one in episodes if one.success is not None]
        return cls(
            episodes=len(episodes),
            return_mean=float(np.mean([one.total for one in episodes])) if episodes else None,
            length_mean=float(np.mean([one.length for one in episodes])) if episodes else None,
            success_rate=float(np.mean(known)) if known else None,
            metrics=dict(metrics),
        )


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


class Trainer(Protocol):
    """A run of one algorithm on one environment."""

    settings: TrainSettings
    notices: list[str]
    """Messages for the user about this run, one line each."""
    evaluations: str
    """``choose``: the best evaluation chooses the checkpoint; ``report``: the last weights are it; ``none``: there are
    no environments here to evaluate in."""

    @classmethod
    def complete(cls, settings: TrainSettings) -> TrainSettings:
        """Check the algorithm's settings and add its defaults, without setting up training."""

    @classmethod
    def create(cls, settings: TrainSettings) -> "Trainer":
        """Set up a new run of complete settings; raises SettingsError if the library refuses them."""

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: TrainSettings | None = None) -> "Trainer":
        """Set up a run that continues from a checkpoint, with the checkpoint's settings or with `settings`."""

    def log_to(self, folder: Path) -> None:
        """Write TensorBoard files into a folder from now on."""

    @property
    def steps(self) -> int:
        """Steps trained since the start of the run."""

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` steps, or `on_progress` returns False.

        Raises TrainingFailed when the loss or a weight is no longer finite.
        """

    def save(self, path: Path, scores: Mapping[str, Any], notes: Mapping[str, Any]) -> Checkpoint:
        """Write a checkpoint that can be resumed and deployed; does not change the random numbers of training.

        The scores go into the manifest, the notes (JSON values) into ``bam/resume/notes.json``.
        """

    def freeze(self) -> FrozenPolicy:
        """Freeze the current policy: raw observation in, deterministic action out. Does not change training."""

    def undisturbed(self) -> AbstractContextManager[None]:
        """Restore the random number generators of training after the ``with`` block, between two updates."""

    def evaluation_envs(self) -> AbstractContextManager[VectorEnv[Any, Any, Any] | None]:
        """Environments for an evaluation between two updates, where no others can be made; else None."""

    def log(self, metrics: Mapping[str, float]) -> None:
        """Add numbers to the trainer's in TensorBoard."""

    def close(self) -> None:
        """Close environments and log files."""


def manifest(
    settings: TrainSettings, spaces: tuple[Space[Any], Space[Any]], known: Mapping[str, Any]
) -> dict[str, Any]:
    """The manifest's fields; `known` has those of the trainer: signals, period, steps and scores."""
    return {
        "env": settings.env,
        "env_kwargs": settings.env_kwargs,
        "observation_space": space_to_json(spaces[0]),
        "action_space": space_to_json(spaces[1]),
        "algorithm": settings.algo,
        "trainer": settings.trainer,
        "settings": settings.to_mapping(),
        "seed": settings.seed,
        **known,
        **origin(),
    }


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
