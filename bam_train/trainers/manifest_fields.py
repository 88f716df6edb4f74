"""What a training run writes into the manifest of its checkpoints, and where it comes from."""

from __future__ import annotations

import contextlib
import datetime
import functools
import platform
import subprocess
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from gymnasium import Space

from bam_envs.core.spaces import space_to_json
from bam_train.settings import TrainSettings

_PACKAGES = ("bam-train", "gymnasium", "numpy", "mujoco", "torch", "stable-baselines3", "sb3-contrib", "ray", "onnx")
_ROOT = Path(__file__).resolve().parents[2]


@functools.cache
def versions(packages: Iterable[str] = _PACKAGES) -> dict[str, str]:
    """Versions of Python and of those of `packages` that are installed."""
    found = {"python": platform.python_version()}
    for package in packages:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


@functools.cache
def git_commit(root: Path = _ROOT) -> str | None:
    """Commit of the source tree that bam_train is imported from; None if it is installed, or git cannot tell."""
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def now() -> str:
    """The time, UTC, ISO 8601."""
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")


def manifest(
    settings: TrainSettings,
    spaces: tuple[Space[Any], Space[Any]],
    *,
    signals: Mapping[str, Any],
    period: float | None,
    steps: int,
    scores: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the manifest's fields.

    Args:
        settings: Complete ones of the run.
        spaces: The environment's own, of observations and of actions.
        signals: What the environment says of its robot's signals.
        period: Control period, s; None if the environment has none.
        steps: Environment steps so far.
        scores: Of its evaluations.
    """
    return {
        "env": settings.env,
        "env_kwargs": settings.env_kwargs,
        "observation_space": space_to_json(spaces[0]),
        "action_space": space_to_json(spaces[1]),
        "signals": dict(signals),
        "period": period,
        "algorithm": settings.algo,
        "trainer": settings.trainer,
        "settings": settings.to_mapping(),
        "steps": steps,
        "seed": settings.seed,
        "scores": dict(scores),
        **origin(),
    }


def origin() -> dict[str, Any]:
    """What made a checkpoint, and when."""
    return {"versions": versions(), "git_commit": git_commit(), "created": now()}
