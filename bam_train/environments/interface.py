"""What a policy sees of an environment, and whether a checkpoint fits that, before a robot moves."""

import json
import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.vector import VectorEnv

from bam_envs.core import registry
from bam_envs.core.location import HERE, Location, Remote
from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import Checkpoint, Manifest
from bam_train.errors import CheckpointMismatch

AnyEnv = gym.Env[Any, Any] | VectorEnv[Any, Any, Any]


def control_period(env: gym.Env[Any, Any]) -> float | None:
    """Time between two actions [s]: the environment's `period`, else one frame of its `render_fps`, else None."""
    period = getattr(env.unwrapped, "period", None)
    if period is not None:
        return float(period)
    rate = env.metadata.get("render_fps")
    return 1.0 / float(rate) if rate else None


def described(env: gym.Env[Any, Any]) -> tuple[dict[str, Any], float | None]:
    """The signals of an environment, {} if it describes none, and its `control_period`."""
    describe = getattr(env.unwrapped, "describe", dict)
    return describe(), control_period(env)


def require_fit(checkpoint: Checkpoint, env: AnyEnv, place: Location = HERE, env_id: str | None = None) -> None:
    """Check that `env` fits the checkpoint's policy.

    Both spaces, the name and unit of every signal, and the control period are compared, where both sides give them.
    The error names `env_id`, if that may be another environment than the checkpoint's.

    Raises:
        CheckpointMismatch: Names the first thing that differs, and both values.
    """
    difference = first_difference(*fit_pairs(checkpoint, env))
    if difference is None:
        return
    name, theirs, ours = difference
    if env_id is not None and not registry.are_same(env_id, checkpoint.manifest.env):
        raise CheckpointMismatch(
            checkpoint.path,
            f"was trained on {checkpoint.manifest.env}, where {name} is {theirs}, and it is "
            f"{ours} in {env_id}; give a checkpoint of {env_id}",
        )
    place_text = f"at {place.text}" if isinstance(place, Remote) else f"in {checkpoint.manifest.env} as installed"
    remedy = "serve the version" if isinstance(place, Remote) else "install the version"
    raise CheckpointMismatch(
        checkpoint.path,
        f"{name} is {theirs} in the checkpoint and {ours} {place_text}; train it anew, or {remedy} it was trained with",
    )


def fit_pairs(checkpoint: Checkpoint, env: AnyEnv) -> list[tuple[str, Any, Any]]:
    """What must be equal for the policy of a checkpoint to fit `env`: name, the checkpoint's value, the environment's.

    The values are plain JSON; those that one of the two does not give are left out.
    """
    return interface_pairs(checkpoint, interface_of(env))


def interface_of(env: AnyEnv) -> dict[str, Any]:
    """What a policy sees of `env`, as plain JSON: its spaces, signals and period [s]; {} and None where unknown."""
    single = "single_" if isinstance(env, VectorEnv) else ""
    spaces = {name: space_to_json(getattr(env, single + name)) for name in ("observation_space", "action_space")}
    describe, period = getattr(env.unwrapped, "describe", None), getattr(env.unwrapped, "period", None)
    signals = {} if describe is None else names_and_units(describe())
    plain: dict[str, Any] = json.loads(json.dumps({**spaces, "signals": signals}))  # tuples as lists
    return {**plain, "period": None if period is None else float(period)}


def interface_in(manifest: Manifest) -> dict[str, Any]:
    """As `interface_of`, of the environment of a manifest."""
    spaces = {name: getattr(manifest, name) for name in ("observation_space", "action_space")}
    return {**spaces, "signals": names_and_units(manifest.signals), "period": manifest.period}


def interface_pairs(checkpoint: Checkpoint, interface: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """As `fit_pairs`, for an environment of which `interface_of` is given."""
    manifest = checkpoint.manifest
    pairs = [(name, getattr(manifest, name), interface[name]) for name in ("observation_space", "action_space")]
    if interface["signals"] and manifest.signals:
        pairs.append(("signals", names_and_units(manifest.signals), interface["signals"]))
    period = interface["period"]
    if period is not None and manifest.period is not None:
        same = math.isclose(period, manifest.period, rel_tol=1e-9)
        pairs.append(("period [s]", manifest.period, manifest.period if same else period))
    return pairs


def first_difference(*pairs: tuple[str, Any, Any]) -> tuple[str, str, str] | None:
    """The first difference of pairs of JSON values, each with its name: what differs, and both values in short."""
    found = next(filter(None, (_difference(*pair) for pair in pairs)), None)
    return None if found is None else (found[0], short_json(found[1]), short_json(found[2]))


def _difference(name: str, theirs: Any, ours: Any) -> tuple[str, Any, Any] | None:
    if isinstance(theirs, dict) and isinstance(ours, dict):
        keys: list[Any] = sorted(theirs.keys() | ours.keys(), key=lambda key: (key != "type", key != "shape", key))
        pairs = [(f"{name}.{key}", theirs.get(key), ours.get(key)) for key in keys]
    elif isinstance(theirs, list) and isinstance(ours, list) and len(theirs) == len(ours):
        pairs = [(f"{name}[{i}]", a, b) for i, (a, b) in enumerate(zip(theirs, ours, strict=True))]
    else:
        return None if theirs == ours else (name, theirs, ours)
    return next(filter(None, (_difference(*pair) for pair in pairs)), None)


def names_and_units(signals: Mapping[str, Any]) -> dict[str, Any]:
    """The names and units of the signals that `RobotEnv.describe` returns, or a data set has, by kind."""
    return {kind: [{key: entry.get(key) for key in ("name", "unit")} for entry in signals[kind]] for kind in signals}


def short_json(value: Any, most: int = 60) -> str:
    """`value` as JSON, at most `most` characters of it."""
    text = json.dumps(value)
    return text if len(text) <= most else text[: most - 3] + "..."
