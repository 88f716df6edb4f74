"""The interface of every trainer: train in steps, save, resume, freeze the policy; and its checkpoints' manifest."""

import contextlib
import datetime
import functools
import platform
import subprocess
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

from gymnasium import Space
from gymnasium.vector import VectorEnv

from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import Checkpoint
from bam_train.policy import FrozenPolicy
from bam_train.settings import TrainSettings


@dataclass(frozen=True)
class Statistics:
    """How training goes, over the last hundred or so training episodes; None before the first one ended."""

    episodes: int
    """Training episodes behind the means."""
    return_mean: float | None
    """Undiscounted sum of rewards of an episode."""
    length_mean: float | None
    """Steps of an episode."""
    success_rate: float | None
    """Share of successful episodes; None too if the environment does not say."""
    metrics: dict[str, float]
    """The trainer's own numbers, such as train/loss; finite ones only."""


@dataclass(frozen=True)
class Progress:
    """Where training is, between two updates; cheap to make."""

    steps: int
    """Steps trained since the first of the run."""
    total: int
    """Steps to train."""
    statistics: Callable[[], Statistics]
    """Computes how training goes."""


OnProgress = Callable[[Progress], bool]
"""Called between updates, when the trainer may be saved, frozen or evaluated; False ends training there."""


class Trainer(Protocol):
    """A run of one algorithm on one environment."""

    settings: TrainSettings
    notices: list[str]
    """Messages for the user about this run, one line each."""

    @classmethod
    def complete(cls, settings: TrainSettings) -> TrainSettings:
        """Check the algorithm's own settings and fill in its defaults; no training is set up."""

    @classmethod
    def create(cls, settings: TrainSettings) -> "Trainer":
        """Set up a new run of complete settings; raises SettingsError if the library refuses them."""

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: TrainSettings | None = None) -> "Trainer":
        """Set up a run that continues from a checkpoint, with its settings or with these."""

    def log_to(self, folder: Path) -> None:
        """Write TensorBoard files into a folder from now on."""

    @property
    def steps(self) -> int:
        """Steps trained since the first of the run."""

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` steps, or `on_progress` returns False.

        Raises TrainingFailed when the loss or a weight is no longer finite.
        """

    def save(self, path: Path, scores: Mapping[str, Any], notes: Mapping[str, Any]) -> Checkpoint:
        """Write a checkpoint that can be resumed and deployed; training is not disturbed, not even its random numbers.

        The scores go into the manifest, the notes (JSON values) into ``bam/resume/notes.json``.
        """

    def freeze(self) -> FrozenPolicy:
        """The policy as it is now, raw observation in, deterministic action out; training is not disturbed."""

    def undisturbed(self) -> AbstractContextManager[None]:
        """Do something between two updates, an evaluation say, that leaves training's random numbers as they were."""

    def evaluation_envs(self) -> AbstractContextManager[VectorEnv[Any, Any, Any] | None]:
        """The environments to evaluate on between two updates, if no others can be made; else None."""

    def log(self, metrics: Mapping[str, float]) -> None:
        """Put numbers next to the trainer's own in TensorBoard."""

    def close(self) -> None:
        """Close environments and log files."""


def manifest(
    settings: TrainSettings, spaces: tuple[Space[Any], Space[Any]], known: Mapping[str, Any]
) -> dict[str, Any]:
    """The manifest's fields; `known` has those that only the trainer knows: signals, period, steps and scores."""
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


@functools.cache
def _software() -> tuple[dict[str, str], str | None]:
    """Versions of Python and packages; the commit of a source tree that bam_train is imported from, if git tells."""
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
