"""Zips written by stable-baselines3 itself: loading one runs any code pickled in it, so it needs the user's consent."""

import pickle
import textwrap
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint.manifest import MANIFEST
from bam_train.checkpoint.zip_members import open_zip
from bam_train.environments import make_env
from bam_train.errors import CheckpointMismatch, NotACheckpoint
from bam_train.policy import FrozenPolicy
from bam_train.trainers.algorithms import SB3_ALGORITHMS
from bam_train.trainers.zero_based_spaces import from_zero

# Exceptions of SB3's load for a file of another algorithm or another version, then those for a damaged one.
_MISFIT = (ValueError, TypeError, KeyError, AttributeError, RuntimeError, AssertionError, ImportError)
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, pickle.UnpicklingError)


def is_plain_sb3(path: Path) -> bool:
    """Whether the file is a zip of stable-baselines3 without our manifest; reads only the list of members."""
    try:
        with open_zip(path) as archive:
            names = set(archive.namelist())
    except NotACheckpoint:
        return False  # missing or damaged; `Checkpoint.open` raises the error
    return "data" in names and MANIFEST not in names


def load_trusted(
    path: Path, algo: str, env_id: str, env_kwargs: Mapping[str, Any] | None = None
) -> tuple[FrozenPolicy, int]:
    """Load with stable-baselines3, which UNPICKLES the file; only for files whose maker is trusted.

    Such a file lacks the statistics of a VecNormalize.

    Returns:
        The frozen policy, and its number of training steps.

    Raises:
        CheckpointMismatch: The file is of another algorithm, or for another environment.
    """
    from bam_train.trainers.sb3.sb3_freezing import freeze

    algorithm = SB3_ALGORITHMS[algo].load()
    env = make_env(env_id, env_kwargs)
    try:
        model = algorithm.load(path, env=from_zero(env), device="cpu")
        graph = freeze(model, None, env.observation_space, env.action_space)
    except (*_MISFIT, *_DAMAGE) as error:
        why = textwrap.shorten(str(error) or type(error).__name__, 160, placeholder=" ...")
        why = why if why.endswith("...") else f"{why.rstrip('.')}."
        text = f"{algorithm.__name__}.load cannot use it with {env_id}: {why} Check --algo and --env"
        raise CheckpointMismatch(path, text) from error
    policy = FrozenPolicy.from_graph(graph, space_to_json(env.observation_space), space_to_json(env.action_space))
    env.close()  # type: ignore[no-untyped-call]
    return policy, int(model.num_timesteps)
