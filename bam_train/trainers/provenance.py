"""Where a checkpoint comes from: versions of what made it, and the commit of our own source tree."""

from __future__ import annotations

import contextlib
import datetime
import functools
import platform
import subprocess
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

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
