"""The flags of `bam-eval`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class EvalConfig:
    """Evaluate the frozen policy of a checkpoint over seeded episodes."""

    checkpoint: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CHECKPOINT")]
    """The checkpoint.zip that bam-train wrote."""
    episodes: int = 100
    """How many episodes."""
    seed: int = 1_000_000
    """Seed of the first episode; episode k gets seed + k. The default is far from the seeds that training uses."""
    env: Annotated[str | None, tyro.conf.arg(metavar="ID")] = None
    """Refuse the checkpoint unless it was trained on this environment; needed for some_module:Env-v0, and for a plain
    stable-baselines3 zip."""
    algo: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Refuse the checkpoint unless it was trained by this algorithm; needed for a plain stable-baselines3 zip."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """env_kwargs.NAME=VALUE: an argument of the environment, any number of times; it wins over the checkpoint's."""
    num_envs: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Environments stepped side by side; by default as many as is quick."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object on standard output instead of a table."""
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Film the first episodes into this .gif or .mp4 file."""
    video_episodes: int = 3
    """How many episodes the film shows."""
    trust_pickle: tyro.conf.FlagCreatePairsOff[bool] = False
    """Load a plain stable-baselines3 zip, which runs whatever code is in it."""
