"""RLlib's deterministic actions in NumPy: a second computation, to check a frozen graph where RLlib is not there.

It shares nothing with `network` and `layers` but what the weights are called: one matrix product after the other, in
float64, row by row where that is simpler.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_train.errors import PolicyError
from bam_train.trainers.rllib.freezing.parts import Array, PolicyParts, leaf_spaces

_ERF = np.vectorize(math.erf, otypes=[np.float64])
_ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "linear": lambda x: x,
    "none": lambda x: x,
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "silu": lambda x: x / (1 + np.exp(-x)),
    "swish": lambda x: x / (1 + np.exp(-x)),
    "sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "leakyrelu": lambda x: np.where(x > 0, x, 0.01 * x),
    "gelu": lambda x: x * 0.5 * (1 + _ERF(x / math.sqrt(2))),
}


def actions_by_hand(parts: PolicyParts, observations: dict[str, Array]) -> Array:
    """Return the deterministic actions, (n, ...), in the environment's action space.

    Args:
        parts: Of a policy of dense layers.
        observations: (n, ...) by key of a Dict, or just ``""``.

    Raises:
        PolicyError: It is not of dense layers, or its activation is not among those here.
    """
    return _bounded(parts, _scores(parts, _encoded(parts, observations)))


def _encoded(parts: PolicyParts, observations: dict[str, Array]) -> Array:
    """What the network sees, (n, k) float64."""
    given = dict(observations)
    if parts.filter is not None and (parts.filter_first or not parts.flatten):
        (key,) = given
        given[key] = _filtered(parts, given[key])
    columns = [_columns(leaf, given[key]) for key, leaf in leaf_spaces(parts.observation_space).items()]
    seen = np.concatenate(columns, axis=1).astype(np.float32)
    if parts.filter is not None and parts.flatten and not parts.filter_first:
        seen = _filtered(parts, seen)
    return seen.astype(np.float64)


def _filtered(parts: PolicyParts, x: Array) -> Array:
    given = parts.filter
    if given is None:
        return x
    y = (x - given.offset) / given.divisor
    return (np.clip(y, -given.limit, given.limit) if given.limit else y).astype(x.dtype)


def _columns(space: Any, x: Array) -> Array:
    """One array as columns: whole numbers one-hot, everything else flat."""
    if isinstance(space, spaces.Discrete):
        return np.asarray(np.eye(int(space.n))[x - space.start])
    if isinstance(space, spaces.MultiDiscrete):
        chosen = (x - space.start).reshape(len(x), -1)
        return np.concatenate([np.eye(count)[chosen[:, k]] for k, count in enumerate(space.nvec.ravel())], axis=1)
    return np.asarray(x.reshape(len(x), -1))


def _scores(parts: PolicyParts, x: Array) -> Array:
    """Means, logits or values, and whatever follows them among the outputs."""
    config, weights = parts.model_config, parts.weights
    if int(config.get("num_atoms") or 1) > 1:
        raise PolicyError("a distributional DQN is not computed by hand; install ray to check the frozen policy")
    activation = config.get("fcnet_activation", "tanh")
    if parts.old_stack:
        if not config.get("fcnet_hiddens"):
            activation = config.get("post_fcnet_activation")
        stages = [(r"(?:action_model\.)?_hidden_layers\.(\d+)\._model\.0\.", activation, False)]
        stages.append((r"advantage_module\.dueling_A_(\d+)\._model\.0\.", "relu", False))
        stages.append((r"(?:advantage_module\.A|(?:action_model\.)?_logits)\._model\.(0)\.", None, True))
    else:
        encoder = r"(?:encoder\.(?:actor_encoder\.|encoder\.)?|pi_encoder\.|_encoder\.)"
        stages = [(encoder + r"net\.mlp\.(\d+)\.", activation, False)]
        stages.append((r"(?:pi|_pi_head|af)\.net\.mlp\.(\d+)\.", config.get("head_fcnet_activation", "relu"), True))
    for pattern, word, last_is_linear in stages:
        x = _stage(weights, pattern, x, _function(word), last_is_linear)
    return x


def _stage(weights: dict[str, Array], pattern: str, x: Array, activate: Callable[[Array], Array], last: bool) -> Array:
    """One stack of layers whose names match, in the order of their numbers."""
    names = {int(match[1]): match[0] for name in weights if (match := re.match(pattern + r"weight$", name))}
    found = sorted(names.items())
    for k, (_, name) in enumerate(found):
        weight = weights[name].astype(np.float64)
        bias = weights.get(name.removesuffix("weight") + "bias")
        following = weights[found[k + 1][1]] if k + 1 < len(found) else None
        if weight.ndim not in (1, 2):
            raise PolicyError(f"{name} is not computed by hand; install ray to check the frozen policy")
        x = x @ weight.T if weight.ndim == 2 else _normed(x) * weight
        x = x if bias is None else x + bias
        if (following is None or following.ndim == 2) and not (last and following is None):
            x = activate(x)
    return x


def _normed(x: Array) -> Array:
    """Layer norm, with RLlib's epsilon."""
    return np.asarray((x - x.mean(1, keepdims=True)) / np.sqrt(x.var(1, keepdims=True) + 1e-3))


def _function(word: Any) -> Callable[[Array], Array]:
    known = _ACTIVATIONS.get(str(word).lower())
    if known is None:
        raise PolicyError(f"activation {word!r} is not computed by hand; install ray to check the frozen policy")
    return known


def _bounded(parts: PolicyParts, scores: Array) -> Array:
    """From scores to actions of the environment."""
    space = parts.action_space
    if isinstance(space, spaces.Discrete):
        return np.asarray(scores[:, : int(space.n)].argmax(1) + space.start, np.int64)
    if isinstance(space, spaces.MultiDiscrete):
        groups = np.split(scores[:, : int(space.nvec.sum())], np.cumsum(space.nvec)[:-1], axis=1)
        return np.asarray(np.stack([group.argmax(1) for group in groups], 1) + space.start, space.dtype)
    if not isinstance(space, spaces.Box):
        raise PolicyError(f"action space {space} is not computed by hand")
    mean = scores[:, : math.prod(space.shape)]
    mean = np.tanh(mean) if parts.squash else mean
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if parts.normalize_actions and np.isfinite(low).all() and np.isfinite(high).all():
        mean = np.clip(low + (mean + 1) * (high - low) / 2, low, high)
    elif parts.clip_actions and not parts.normalize_actions:
        mean = np.clip(mean, low, high)
    return np.asarray(mean, space.dtype)
