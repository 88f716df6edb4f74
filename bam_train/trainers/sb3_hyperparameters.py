"""Hyperparameters, checked against the constructors of stable-baselines3 and completed, without importing it.

In settings they are JSON: a schedule is ``"lin_3e-4"`` (linear to 0), action noise ``"normal_0.1"`` or
``"ornstein-uhlenbeck_0.1"``, a class its name (``activation_fn="tanh"``), ``train_freq`` ``1`` or ``[1, "episode"]``.
"""

import contextlib
import dataclasses
import json
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from gymnasium import spaces
from msgspec import Meta

from bam_envs.core.spaces import leaves, space_text
from bam_envs.core.validation import Finite, Fraction, NonNegative, Positive, PositiveInt, check
from bam_envs.core.wording import did_you_mean, listed
from bam_train.environments import make_env, make_vector_env
from bam_train.errors import SettingsError
from bam_train.settings import NAMES, SB3Settings
from bam_train.trainers.algorithms import SB3_ALGORITHMS, Algorithm
from bam_train.trainers.library_arguments import linear_start, parameters, table, take

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

NORMALISER = "stable_baselines3.common.vec_env.vec_normalize:VecNormalize"
_POLICY_ELSEWHERE = frozenset({"self", "observation_space", "action_space", "lr_schedule", "use_sde"})

CLASSES = {
    "activation_fn": (
        *("CELU", "ELU", "GELU", "Hardswish", "Identity", "LeakyReLU", "Mish", "ReLU", "SELU", "SiLU", "Tanh"),
    ),
    "optimizer_class": ("Adam", "AdamW", "NAdam", "RAdam", "RMSprop", "SGD"),
    "features_extractor_class": ("CombinedExtractor", "FlattenExtractor", "NatureCNN"),
}
"""Names of the classes that an argument of a policy may be."""

NOISES = ("normal", "ornstein-uhlenbeck")
"""Kinds of action noise."""
_Noise = Annotated[
    str,
    Meta(
        pattern=rf"^({'|'.join(NOISES)})_\d+\.?\d*([eE][-+]?\d+)?$",
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


def complete_settings(settings: SB3Settings) -> SB3Settings:
    """Add the algorithm's defaults, and the number of environments that servers run.

    Raises:
        SettingsError: A setting that the algorithm or its policy does not take, or that does not fit the environment.
    """
    if settings.transport:
        with contextlib.closing(make_vector_env(settings.env, {}, 1, settings.place)) as envs:
            num_envs, seen, acted = envs.num_envs, envs.single_observation_space, envs.single_action_space
    else:
        with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
            num_envs, seen, acted = settings.num_envs, env.observation_space, env.action_space
    algorithm = SB3_ALGORITHMS[settings.algo]
    algorithm.require_actions(settings.env, type(acted).__name__)
    algorithm.require_observations(settings.env, seen)
    check_pictures(seen)
    values = complete(algorithm, settings.hyperparameters, seen)
    normalize = complete_normalize(settings.normalize, values["gamma"], seen)
    eval_every = settings.eval_every or max(1000, settings.steps // 20)
    return dataclasses.replace(
        settings, num_envs=num_envs, hyperparameters=values, normalize=normalize, eval_every=eval_every
    )


def complete(algorithm: Algorithm, given: Mapping[str, Any], observation_space: spaces.Space[Any]) -> dict[str, Any]:
    """Check hyperparameters by name, type and range, and add defaults for missing ones."""
    known = {name: one for name, one in parameters(algorithm.reference).items() if name not in ELSEWHERE}
    hints = {name: _Noise | None if name == "action_noise" else one.annotation for name, one in known.items()}
    values: dict[str, Any] = {"policy": default_policy(algorithm, observation_space)}
    for name, one in known.items():
        if name != "policy":
            values[name] = list(one.default) if isinstance(one.default, tuple) else one.default
    values |= take(given, hints, f"{algorithm.name} hyperparameter", ELSEWHERE, NAMES)
    policies, policy = table(algorithm.reference, "policy_aliases"), values["policy"]
    if policy not in policies:
        raise SettingsError(f"policy: unknown policy {policy!r} of {algorithm.name}. {did_you_mean(policy, policies)}")
    values["policy_kwargs"] = _checked_policy(policies[policy], values["policy_kwargs"] or {})
    _require_policy(policy, values["policy_kwargs"], observation_space)
    _check_ranges(values)
    return values


def is_image(space: spaces.Space[Any]) -> bool:
    """Whether stable-baselines3 takes a space for an image: uint8 from 0 to 255 with three axes."""
    is_bytes = isinstance(space, spaces.Box) and len(space.shape) == 3 and space.dtype == np.uint8
    return is_bytes and bool(np.all(space.low == 0) and np.all(space.high == 255))  # type: ignore[attr-defined]


def is_large(image: spaces.Space[Any]) -> bool:
    """Whether an image fits stable-baselines3's network of convolutions; its channels are its shortest axis."""
    return sorted(image.shape or ())[1] >= SMALLEST_IMAGE


def default_policy(algorithm: Algorithm, observation_space: spaces.Space[Any]) -> str:
    """Name of the policy for an observation space of several inputs, images, or numbers."""
    several = isinstance(observation_space, spaces.Dict)
    kind = "Cnn" if is_image(observation_space) and is_large(observation_space) else "Mlp"
    return f"{'MultiInput' if several else kind}{'Lstm' if algorithm.recurrent else ''}Policy"


def _require_policy(policy: str, given: Mapping[str, Any], space: spaces.Space[Any]) -> None:
    """Refuse a policy for another kind of observation; `given` are its arguments."""
    kind, wanted = policy.partition("Policy")[0].removesuffix("Lstm"), ""
    if (kind == "MultiInput") != isinstance(space, spaces.Dict):
        wanted = "a Dict of observations" if kind == "MultiInput" else "a single observation"
    own = str(given.get("features_extractor_class", "NatureCNN")).lower() == "naturecnn"
    if kind == "Cnn" and own and given.get("normalize_images", True) and not wanted:
        if not is_image(space):
            wanted = "images, uint8 from 0 to 255"
        elif not is_large(space):
            wanted = f"images of at least {SMALLEST_IMAGE} pixels along the shorter side"
    if wanted:
        found = f"a Dict of {listed(space.spaces)}" if isinstance(space, spaces.Dict) else space_text(space)
        raise SettingsError(f"policy: {policy} is for {wanted}, found {found}. Leave policy out")


def complete_normalize(
    given: bool | Mapping[str, Any], gamma: float, space: spaces.Space[Any]
) -> bool | dict[str, Any]:
    """Check the arguments of `VecNormalize`; its gamma is the algorithm's unless given.

    For ``true``, it normalises numbers alone: images are divided by 255, and choices are one-hot codes.
    """
    seen = leaves(space)
    numbers = [key for key, leaf in seen.items() if isinstance(leaf, spaces.Box) and not is_image(leaf)]
    if given is True:
        if not numbers:
            return {"gamma": gamma, "norm_obs": False}
        return {"gamma": gamma} if len(numbers) == len(seen) else {"gamma": gamma, "norm_obs_keys": numbers}
    if given is False:
        return False
    known = parameters(NORMALISER).items()
    hints = {name: one.annotation for name, one in known if name not in ("self", "venv", "training")}
    fitted = take(given, hints, "normalize argument", ELSEWHERE, prefix="normalize.")
    _check_ranges(fitted)
    if fitted.get("norm_obs", True):
        _require_normalisable(fitted.get("norm_obs_keys"), seen, numbers)
    return {"gamma": gamma, **fitted}


def _require_normalisable(keys: Any, seen: Mapping[str, Any], numbers: list[str]) -> None:
    """Refuse to normalise observations, all or those of some `keys`, that are no Box."""
    if "" in seen and keys is not None:
        raise SettingsError("normalize.norm_obs_keys: is for a Dict of observations, and there is one; leave it out")
    instead = f"--set normalize.norm_obs_keys='{json.dumps(numbers)}'"
    if "" in seen or not numbers:
        instead = "--set normalize.norm_obs=false"
    for key in seen if keys is None else keys:
        leaf = seen.get(key)
        if leaf is None:
            raise SettingsError(f"normalize.norm_obs_keys: there is no observation {key!r}. {did_you_mean(key, seen)}")
        if not isinstance(leaf, spaces.Box) or ("" in seen and is_image(leaf)):
            what = f"observation {key!r}" if key else "the observation"
            text = f"{what} is {space_text(leaf)}, which cannot be normalised; give {instead}"
            raise SettingsError(f"normalize: {text}")


def over_the_whole_run(values: Mapping[str, Any]) -> list[str]:
    """Names of complete hyperparameters that change over the run, and depend on its total of steps."""
    schedules = [name for name, value in values.items() if isinstance(value, str) and linear_start(value) is not None]
    return sorted([*schedules, *({"exploration_fraction"} & values.keys())])


def _check_ranges(values: Mapping[str, Any]) -> None:
    """Refuse a number out of its range; of a schedule, the first value is checked, and text such as ``auto`` is not."""
    for name, value in values.items():
        first = value[0] if isinstance(value, list) and value else value
        number = linear_start(first) if isinstance(first, str) else first
        if isinstance(number, (int, float)) and not isinstance(number, bool):
            check(number, _RANGES.get(name, Finite), name, SettingsError)


def _checked_policy(policy: str, given: Mapping[str, Any]) -> dict[str, Any]:
    hints = {name: one.annotation for name, one in parameters(policy).items() if name not in _POLICY_ELSEWHERE}
    values = take(given, hints, "policy_kwargs argument", ELSEWHERE, prefix="policy_kwargs.")
    for name, value in values.items():
        if name in CLASSES and value.lower() not in map(str.lower, CLASSES[name]):
            close = did_you_mean(value.lower(), map(str.lower, CLASSES[name]))
            raise SettingsError(f"policy_kwargs.{name}: unknown {value!r}. {close}")
    return values


def check_pictures(observed: spaces.Space[Any]) -> list[str]:
    """Messages about observations that look like pictures and are learnt as plain numbers.

    Raises:
        SettingsError: A picture has its channels between height and width, or is too small for its network.
    """
    told = []
    for key, leaf in leaves(observed).items():
        if not isinstance(leaf, spaces.Box) or len(leaf.shape) != 3:
            continue
        name = f"observation {key!r}" if key else "the observation"
        if is_image(leaf) and leaf.shape[1] < min(leaf.shape[0], leaf.shape[2]):
            raise SettingsError(
                f"{name} is a picture of shape {leaf.shape}: expected (height, width, channels) or (channels, height, "
                "width); turn it in the environment, with np.moveaxis"
            )
        if key and is_image(leaf) and not is_large(leaf):
            raise SettingsError(
                f"{name} is a picture of shape {leaf.shape}: expected at least {SMALLEST_IMAGE} pixels along the "
                "shorter side, for the network of convolutions; make it larger in the environment"
            )
        if not is_image(leaf):
            told.append(
                f"{name}, {leaf.dtype} of shape {leaf.shape}, is learnt as plain numbers: a picture for a "
                "convolutional network is uint8 from 0 to 255"
            )
    return told
