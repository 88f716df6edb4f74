"""The model of a run, an algorithm of stable-baselines3 with complete hyperparameters."""

import copy
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common import noise, torch_layers, utils
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from bam_envs.core.spaces import leaves
from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import SB3_ALGORITHMS
from bam_train.trainers.library_arguments import linear_start
from bam_train.trainers.sb3.numpy_ppo import NumpyPPO
from bam_train.trainers.sb3_hyperparameters import CLASSES, check_pictures

_MODULES = {"activation_fn": torch.nn, "optimizer_class": torch.optim, "features_extractor_class": torch_layers}
_NOISES = {"normal": noise.NormalActionNoise, "ornstein-uhlenbeck": noise.OrnsteinUhlenbeckActionNoise}


def build(values: Mapping[str, Any], action_space: spaces.Space[Any]) -> dict[str, Any]:
    """Turn complete hyperparameters into arguments of the constructor; `values` does not change."""
    arguments = copy.deepcopy(dict(values))
    for name, value in arguments.items():
        if isinstance(value, str) and (start := linear_start(value)) is not None:  # to 0 over the run
            schedule: Any = getattr(utils, "LinearSchedule", None) or utils.get_linear_fn
            arguments[name] = schedule(start, 0.0, 1.0)
        elif isinstance(value, list) and len(value) == 2 and value[1] in ("step", "episode"):
            arguments[name] = tuple(value)
    if arguments.get("action_noise") is not None:
        kind, _, sigma = arguments["action_noise"].rpartition("_")
        shape = action_space.shape or ()
        arguments["action_noise"] = _NOISES[kind](np.zeros(shape), np.full(shape, float(sigma)))
    policy = arguments["policy_kwargs"]
    for name, module in _MODULES.items():
        if name in policy:
            policy[name] = getattr(module, next(one for one in CLASSES[name] if one.lower() == policy[name].lower()))
    return arguments


_REFUSALS = (AssertionError, ValueError, TypeError, RuntimeError, ZeroDivisionError, NotImplementedError)
"""Exceptions of stable-baselines3 and torch for settings that cannot work."""


def make_model(settings: TrainSettings, venv: VecEnv) -> tuple[Any, list[str]]:
    """Make the algorithm's model, whose constructor sets all seeds; returns it with its warnings, one line each.

    Raises SettingsError if the library refuses the settings, or the device does not exist.
    """
    about_pictures = check_pictures(venv.observation_space)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            env = _normalised(venv, settings.normalize) if settings.normalize else venv
            arguments = build(settings.hyperparameters, venv.action_space)
            kind, policy = SB3_ALGORITHMS[settings.algo].load(), arguments.pop("policy")
            kind = NumpyPPO if kind is PPO else kind
            device = _device(settings.device, policy)
            model = kind(policy, env, seed=settings.seed, device=device, verbose=0, **arguments)
        except SettingsError:
            raise
        except _REFUSALS as error:
            why = " ".join(str(error).split())
            raise SettingsError(f"{settings.algo} on {settings.env} cannot be set up: {why}") from error
    notices = [" ".join(str(warning.message).split()) for warning in caught]
    if any(text.startswith("You have specified a mini-batch size") for text in notices):  # in terms of the settings
        steps, batch = model.n_steps * model.n_envs, model.batch_size
        notices = [
            f"batch_size {batch} does not divide a rollout of n_steps {model.n_steps} x num_envs {model.n_envs} = "
            f"{steps} steps: its last batch has {steps % batch}"
        ]
    return model, [*about_pictures, *notices]


def _normalised(venv: VecEnv, given: bool | dict[str, Any]) -> VecNormalize:
    """Normalise `venv`, below which a wrapper moves the channels of images, if any, to the front.

    With this wrapper on top, as in stable-baselines3, the replay buffer would get images with channels last.
    """
    arguments = given if isinstance(given, dict) else {}
    venv.observation_space = copy.deepcopy(venv.observation_space)  # VecNormalize writes into a Dict
    env = VecNormalize(venv, **arguments)
    seen = leaves(env.observation_space).values()
    if any(is_image_space(leaf) and not is_image_space_channels_first(leaf) for leaf in seen):
        return VecNormalize(VecTransposeImage(venv), **arguments)
    return env


def _device(name: str, policy: str) -> str:
    """The device to compute on: `name` if it exists, or the choice of ``auto``."""
    if name == "auto":
        # Copies to a GPU take longer than the computations of a small network.
        return "cuda" if torch.cuda.is_available() and not policy.startswith("Mlp") else "cpu"
    there = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if name in there or (name == "cuda" and len(there) > 1):
        return name
    raise SettingsError(f"device: {name!r} is not there; expected auto or one of {', '.join(there)}")
