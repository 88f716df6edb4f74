"""The model of a run: made from settings, refused in one line."""

from __future__ import annotations

import copy
import warnings
from typing import Any

import torch
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import SB3_ALGORITHMS
from bam_train.trainers.sb3 import sb3_hyperparameters as hyperparameters
from bam_train.trainers.sb3.sb3_freezing import leaves

_REFUSALS = (AssertionError, ValueError, TypeError, RuntimeError, ZeroDivisionError, NotImplementedError)
"""What stable-baselines3 and torch raise for settings that cannot be."""


def make_model(settings: TrainSettings, venv: VecEnv) -> tuple[Any, list[str]]:
    """The algorithm's model, whose constructor seeds everything, and what it warns of, a line each.

    Raises:
        SettingsError: The library refuses the settings, or there is no such device.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            env = _normalised(venv, settings.normalize) if settings.normalize else venv
            arguments = hyperparameters.build(settings.hyperparameters, venv.action_space)
            kind, policy = SB3_ALGORITHMS[settings.algo].load(), arguments.pop("policy")
            device = _device(settings.device, policy)
            model = kind(policy, env, seed=settings.seed, device=device, verbose=0, **arguments)
        except SettingsError:
            raise
        except _REFUSALS as error:
            why = " ".join(str(error).split())
            raise SettingsError(f"{settings.algo} on {settings.env} cannot be set up: {why}") from error
    return model, [" ".join(str(one.message).split()) for one in caught]


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
