"""The model of a run: made from settings, refused in one line, written the way stable-baselines3 writes it."""

from __future__ import annotations

import contextlib
import copy
import io
import warnings
import zipfile
from collections.abc import Iterator
from typing import Any

import torch
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from bam_train.environments import control_period
from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import SB3_ALGORITHMS
from bam_train.trainers.sb3 import sb3_hyperparameters as hyperparameters
from bam_train.trainers.sb3.sb3_freezing import leaves
from bam_train.trainers.sb3.sb3_vec_env import BatchVecEnv
from bam_train.trainers.zero_based_spaces import FromZero


def make_model(settings: TrainSettings, venv: VecEnv) -> Any:
    """The algorithm's model; its constructor seeds everything and initialises the weights."""
    env = _normalised(venv, settings.normalize) if settings.normalize else venv
    arguments = hyperparameters.build(settings.hyperparameters, venv.action_space)
    policy = arguments.pop("policy")
    device = _device(settings.device, policy)
    return SB3_ALGORITHMS[settings.algo].load()(policy, env, seed=settings.seed, device=device, verbose=0, **arguments)


def _normalised(venv: VecEnv, given: bool | dict[str, Any]) -> VecNormalize:
    """The normaliser over `venv`, and below it what brings an image's channels to the front, if one stays an image.

    Above it, where stable-baselines3 would put that, the replay buffer is given the images of below: channels last.
    """
    arguments = given if isinstance(given, dict) else {}
    venv.observation_space = copy.deepcopy(venv.observation_space)  # VecNormalize writes into a Dict
    env = VecNormalize(venv, **arguments)
    seen = leaves(env.observation_space).values()
    if any(is_image_space(leaf) and not is_image_space_channels_first(leaf) for leaf in seen):
        return VecNormalize(VecTransposeImage(venv), **arguments)
    return env


def _device(name: str, policy: str) -> str:
    """Where to compute: what was asked for if it is there.

    Raises:
        SettingsError: There is no such device.
    """
    if name == "auto":
        # Copies to a GPU cost more than a small network computes.
        return "cuda" if torch.cuda.is_available() and not policy.startswith("Mlp") else "cpu"
    there = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if name in there or (name == "cuda" and len(there) > 1):
        return name
    raise SettingsError(f"device: {name!r} is not there; expected auto or one of {', '.join(there)}")


@contextlib.contextmanager
def refusals(settings: TrainSettings) -> Iterator[None]:
    """What stable-baselines3 and torch say about settings that cannot be, as our own error."""
    try:
        yield
    except (AssertionError, ValueError, TypeError, RuntimeError, ZeroDivisionError, NotImplementedError) as error:
        if isinstance(error, SettingsError):
            raise
        raise SettingsError(
            f"{settings.algo} on {settings.env} cannot be set up: {' '.join(str(error).split())}"
        ) from error


@contextlib.contextmanager
def library_notices() -> Iterator[list[str]]:
    """Collect warnings as lines for the user."""
    lines: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield lines
    lines += [" ".join(str(one.message).split()) for one in caught]


def one_env(venv: VecEnv) -> Any:
    """What stands behind `venv`: our vector environment, or the first of the others."""
    if isinstance(venv, BatchVecEnv):
        return venv.batch
    env = venv.envs[0]
    while isinstance(env, (Monitor, FromZero)):
        env = env.env
    return env


def meaning(venv: VecEnv) -> tuple[dict[str, Any], float | None]:
    """Signals (labels, units, limits) and control period [s], as far as the environment says."""
    env = one_env(venv)
    describe = getattr(env.unwrapped, "describe", None)
    return (describe() if describe else {}), control_period(env)


def sb3_members(model: Any) -> dict[str, bytes]:
    """What stable-baselines3 itself writes, so that its own `load` opens the checkpoint."""
    stream = io.BytesIO()
    model.save(stream, exclude=["collect_rollouts"])
    with zipfile.ZipFile(stream) as archive:
        return {name: archive.read(name) for name in archive.namelist()}
