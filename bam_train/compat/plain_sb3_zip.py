"""Zips written by stable-baselines3 itself: loading one runs any code pickled in it, so it needs the user's consent."""

import contextlib
import pickle
import textwrap
import zipfile
import zlib
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from bam_envs.core.errors import UnknownName
from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import safetensors_file
from bam_train.checkpoint.manifest import MANIFEST
from bam_train.checkpoint.zip_members import open_zip
from bam_train.compat.exported import Exported, exported
from bam_train.environments import described, make_env
from bam_train.errors import CheckpointError, CheckpointMismatch
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
    except CheckpointError:
        return False  # missing or damaged; `Checkpoint.open` raises the error
    return "data" in names and MANIFEST not in names


def require_plain_sb3(path: Path) -> None:
    """Raise CheckpointError unless the file is a zip of stable-baselines3 without our manifest."""
    if not is_plain_sb3(path):
        with open_zip(path) as archive:
            is_ours = MANIFEST in archive.namelist()
        text = (
            "is a checkpoint of bam-train already" if is_ours else "is not a zip of stable-baselines3. Check the name"
        )
        raise CheckpointError(path, text)


def export_trusted(
    path: Path, algo: str, env_id: str, env_kwargs: Mapping[str, Any] | None = None, statistics: Path | None = None
) -> Exported:
    """Load with stable-baselines3, which UNPICKLES the file; only for files whose maker is trusted.

    Args:
        path: The zip, for which `is_plain_sb3` holds.
        algo: Its algorithm.
        env_id: Its environment.
        env_kwargs: Arguments of the environment.
        statistics: File of a VecNormalize, which is unpickled too; without it, observations are not normalised.

    Raises:
        CheckpointMismatch: A file is of another algorithm, or for another environment.
        UnknownName: There is no such algorithm.
    """
    if algo not in SB3_ALGORITHMS:
        raise UnknownName("algorithm", algo, SB3_ALGORITHMS)
    with contextlib.closing(make_env(env_id, env_kwargs)) as env:
        model, graph, golden = _frozen(path, algo, env_id, env, statistics)
        policy = FrozenPolicy.from_graph(graph, *map(space_to_json, (env.observation_space, env.action_space)))
        signals, period = described(env)
    facts = {"env": env_id, "env_kwargs": dict(env_kwargs or {}), "signals": signals, "period": period}
    facts |= {"algorithm": algo, "trainer": "sb3", "steps": int(model.num_timesteps), "seed": int(model.seed or 0)}
    by, source = f"stable-baselines3 {metadata.version('stable-baselines3')}", {"file": str(path.absolute())}
    return exported(str(path), policy, graph, safetensors_file.parse(golden), source, by, **facts)


def _frozen(path: Path, algo: str, env_id: str, env: Any, statistics: Path | None) -> tuple[Any, bytes, bytes]:
    """The model of a trusted zip, its graph and golden actions."""
    from bam_train.trainers.sb3.sb3_freezing import FrozenModel

    algorithm, normaliser = SB3_ALGORITHMS[algo].load(), None
    try:
        model = algorithm.load(path, env=from_zero(env), device="cpu")
        if statistics is not None:
            from stable_baselines3.common.vec_env import VecNormalize

            normaliser = VecNormalize.load(str(statistics), model.get_env())
        graph, golden = FrozenModel(model, normaliser, env.observation_space, env.action_space).members()
        return model, graph, golden
    except (*_MISFIT, *_DAMAGE, OSError) as error:
        why = textwrap.shorten(str(error) or type(error).__name__, 160, placeholder=" ...")
        why = why if why.endswith("...") else f"{why.rstrip('.')}."
        text = f"{algorithm.__name__}.load cannot use it with {env_id}: {why} Check --algo and --env"
        raise CheckpointMismatch(path, text) from error
