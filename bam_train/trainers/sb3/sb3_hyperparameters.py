"""Hyperparameters, checked against the constructors of stable-baselines3 and completed; the model of a run.

In settings they are JSON: a schedule is ``"lin_3e-4"`` (linear to 0), action noise ``"normal_0.1"`` or
``"ornstein-uhlenbeck_0.1"``, a class its name (``activation_fn="tanh"``), ``train_freq`` ``1`` or ``[1, "episode"]``.
"""

import copy
import inspect
import typing
import warnings
from collections.abc import Container, Mapping
from typing import Annotated, Any

import numpy as np
import torch
from gymnasium import spaces
from msgspec import Meta
from stable_baselines3.common import noise, torch_layers, utils
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from bam_envs.core.validation import Finite, Fraction, NonNegative, Positive, PositiveInt, check
from bam_envs.core.wording import did_you_mean
from bam_train.errors import SettingsError
from bam_train.settings import NAMES, TrainSettings
from bam_train.trainers.algorithms import SB3_ALGORITHMS, Algorithm
from bam_train.trainers.frozen_network import leaves
from bam_train.trainers.library_arguments import fit, linear_start, require_known

ELSEWHERE = {
    "seed": "use --seed",
    "device": "use --device",
    **dict.fromkeys(
        (
            *("self", "env", "tensorboard_log", "verbose", "_init_setup_model"),
            *("rollout_buffer_class", "rollout_buffer_kwargs", "replay_buffer_class"),
        ),
        "bam-train takes care of it",
    ),
}
"""Constructor arguments that are not hyperparameters, and the replacement or reason."""

_POLICY_ELSEWHERE = frozenset({"self", "observation_space", "action_space", "lr_schedule", "use_sde"})

_ACTIVATIONS = ("CELU", "ELU", "GELU", "Hardswish", "Identity", "LeakyReLU", "Mish", "ReLU", "SELU", "SiLU", "Tanh")
_OPTIMIZERS = ("Adam", "AdamW", "NAdam", "RAdam", "RMSprop", "SGD")
_EXTRACTORS = ("CombinedExtractor", "FlattenExtractor", "NatureCNN")
CLASSES: dict[str, dict[str, type]] = {
    "activation_fn": {name.lower(): getattr(torch.nn, name) for name in _ACTIVATIONS},
    "optimizer_class": {name.lower(): getattr(torch.optim, name) for name in _OPTIMIZERS},
    "features_extractor_class": {name.lower(): getattr(torch_layers, name) for name in _EXTRACTORS},
}
"""Policy arguments that are classes, by lower-case name."""

_NOISES = {"normal": noise.NormalActionNoise, "ornstein-uhlenbeck": noise.OrnsteinUhlenbeckActionNoise}
_Noise = Annotated[
    str,
    Meta(
        pattern=rf"^({'|'.join(_NOISES)})_\d+\.?\d*([eE][-+]?\d+)?$",
        description='"normal_0.1" or "ornstein-uhlenbeck_0.1"',
    ),
]

_EXPLORATION = ("exploration_fraction", "exploration_initial_eps", "exploration_final_eps")
SMALLEST_IMAGE = 36
"""Pixels along the shorter side from which on an image fits stable-baselines3's network of convolutions."""
_COUNTS = ("n_steps", "batch_size", "n_epochs", "buffer_size", "train_freq", "target_update_interval", "policy_delay")
_RANGES = {
    **dict.fromkeys(("gamma", "gae_lambda", "tau", *_EXPLORATION), Fraction),
    **dict.fromkeys(("learning_rate", "clip_range", "max_grad_norm", "rms_prop_eps", "target_kl"), Positive),
    **dict.fromkeys(_COUNTS, PositiveInt),
    **dict.fromkeys(("learning_starts", "ent_coef", "vf_coef"), NonNegative),
}
"""Ranges of numbers outside which no algorithm can learn, although the library accepts them."""


def complete(algorithm: Algorithm, given: Mapping[str, Any], observation_space: spaces.Space[Any]) -> dict[str, Any]:
    """Check hyperparameters by name, type and range, and add defaults for missing ones."""
    parameters = _parameters(algorithm.load(), ELSEWHERE)
    require_known(given, parameters, f"{algorithm.name} hyperparameter", ELSEWHERE, NAMES)
    values: dict[str, Any] = {"policy": default_policy(algorithm, observation_space)}
    for name, parameter in parameters.items():
        if name in given:
            is_noise = noise.ActionNoise in typing.get_args(parameter.annotation)
            values[name] = fit(name, given[name], _Noise | None if is_noise else parameter.annotation)
        elif name != "policy":
            values[name] = list(parameter.default) if isinstance(parameter.default, tuple) else parameter.default
    policies, policy = algorithm.load().policy_aliases, values["policy"]
    if policy not in policies:
        raise SettingsError(f"policy: unknown policy {policy!r} of {algorithm.name}. {did_you_mean(policy, policies)}")
    values["policy_kwargs"] = _checked_policy(policies[policy], values["policy_kwargs"] or {})
    _check_ranges(values)
    return values


def default_policy(algorithm: Algorithm, observation_space: spaces.Space[Any]) -> str:
    """Name of the policy for an observation space of several inputs, images, or numbers."""
    several = isinstance(observation_space, spaces.Dict)
    is_image = is_image_space(observation_space) and sorted(observation_space.shape or ())[1] >= SMALLEST_IMAGE
    kind = "MultiInput" if several else "Cnn" if is_image else "Mlp"
    return f"{kind}{'Lstm' if algorithm.recurrent else ''}Policy"


def complete_normalize(given: bool | Mapping[str, Any], gamma: float) -> bool | dict[str, Any]:
    """Check the arguments of `VecNormalize`; its gamma is the algorithm's unless given."""
    if isinstance(given, bool):
        return {"gamma": gamma} if given else False
    known = _parameters(VecNormalize, ("self", "venv", "training"))
    require_known(given, known, "normalize argument", ELSEWHERE)
    fitted = {name: fit(f"normalize.{name}", value, known[name].annotation) for name, value in given.items()}
    _check_ranges(fitted)
    return {"gamma": gamma, **fitted}


def over_the_whole_run(values: Mapping[str, Any]) -> list[str]:
    """Names of complete hyperparameters that change over the run, and depend on its total of steps."""
    schedules = [name for name, value in values.items() if isinstance(value, str) and linear_start(value) is not None]
    return sorted([*schedules, *({"exploration_fraction"} & values.keys())])


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
    for name, table in CLASSES.items():
        if name in policy:
            policy[name] = table[policy[name].lower()]
    return arguments


def _parameters(kind: Any, but: Container[str]) -> dict[str, inspect.Parameter]:
    """Parameters of a class's constructor by name, without those in `but`."""
    parameters = inspect.signature(kind.__init__).parameters
    return {name: parameter for name, parameter in parameters.items() if name not in but}


def _check_ranges(values: Mapping[str, Any]) -> None:
    """Refuse a number out of its range; of a schedule, the first value is checked, and text such as ``auto`` is not."""
    for name, value in values.items():
        first = value[0] if isinstance(value, list) and value else value
        number = linear_start(first) if isinstance(first, str) else first
        if isinstance(number, (int, float)) and not isinstance(number, bool):
            check(number, _RANGES.get(name, Finite), name, SettingsError)


def _checked_policy(policy: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    parameters, values = _parameters(policy, _POLICY_ELSEWHERE), {}
    require_known(given, parameters, "policy_kwargs argument", ELSEWHERE)
    for name, value in given.items():
        values[name] = fit(f"policy_kwargs.{name}", value, parameters[name].annotation)
        if name in CLASSES and values[name].lower() not in CLASSES[name]:
            close = did_you_mean(value.lower(), CLASSES[name])
            raise SettingsError(f"policy_kwargs.{name}: unknown {value!r}. {close}")
    return values


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


def check_pictures(observed: spaces.Space[Any]) -> list[str]:
    """Messages about observations that look like pictures and are learnt as plain numbers.

    Raises:
        SettingsError: A picture has its channels between height and width.
    """
    told = []
    for key, leaf in leaves(observed).items():
        if not isinstance(leaf, spaces.Box) or len(leaf.shape) != 3:
            continue
        name = f"observation {key!r}" if key else "the observation"
        if is_image_space(leaf) and leaf.shape[1] < min(leaf.shape[0], leaf.shape[2]):
            raise SettingsError(
                f"{name} is a picture of shape {leaf.shape}: expected (height, width, channels) or (channels, height, "
                "width); turn it in the environment, with np.moveaxis"
            )
        if not is_image_space(leaf):
            told.append(
                f"{name}, {leaf.dtype} of shape {leaf.shape}, is learnt as plain numbers: a picture for a "
                "convolutional network is uint8 from 0 to 255"
            )
    return told


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
