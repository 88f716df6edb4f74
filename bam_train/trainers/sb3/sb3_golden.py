"""Golden actions: observations, and what the trainer itself does on them, to check the frozen policy against."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize, VecTransposeImage, unwrap_vec_wrapper
from torch import nn

from bam_train.trainers.frozen_network import affordable, clearest, draw_array, pack
from bam_train.trainers.sb3.sb3_freezing import FrozenModule, leaves
from bam_train.trainers.zero_based_spaces import less_start, plus_start


def golden(
    model: BaseAlgorithm,
    normaliser: VecNormalize | None,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    n: int = 256,
    seed: int = 0,
) -> bytes:
    """Draw observations and record ``model.predict(..., deterministic=True)``.

    Args:
        model: The trained model; left as it was, and no random number of torch, NumPy or SB3 is drawn.
        normaliser: What its observations were normalised with, if anything.
        observation_space: The environment's own.
        action_space: The environment's own; its ``start`` is added to what SB3 counts from 0.
        n: Rows; fewer if they are large. Of a recurrent policy: steps of one episode.
        seed: Of the observations.

    Returns:
        A safetensors file with ``observation`` (or ``observation.<key>``), (n, ...), and ``action``, (n, ...).
    """
    recurrent = hasattr(model.policy, "lstm_actor")
    n = affordable(leaves(observation_space).values(), n)
    rng = np.random.default_rng(seed)
    observations = draw(observation_space, n if recurrent else 2 * n, rng, normaliser)
    if not recurrent:
        observations = clearest(FrozenModule(model, normaliser, observation_space, action_space), observations, n)
    actions = trainer_actions(model, normaliser, observation_space, action_space, observations)
    return pack(observations, actions)


def draw(
    space: spaces.Space[Any], n: int, rng: np.random.Generator, normaliser: VecNormalize | None = None
) -> dict[str, np.ndarray]:
    """Draw n observations; the keys are those of a Dict, or just ``""``.

    Normalised numbers are drawn about their running mean, so that few of them end at the normaliser's limits.
    """
    return {key: draw_array(leaf, n, rng, _moments(normaliser, key)) for key, leaf in leaves(space).items()}


def trainer_actions(
    model: BaseAlgorithm,
    normaliser: VecNormalize | None,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    observations: dict[str, np.ndarray],
) -> np.ndarray:
    """Return the trainer's own actions for raw observations, in the environment's action space."""
    seen = less_start(
        observation_space, observations if isinstance(observation_space, spaces.Dict) else observations[""]
    )
    if normaliser is not None:
        transpose = unwrap_vec_wrapper(normaliser, VecTransposeImage)
        seen = normaliser.normalize_obs(seen if transpose is None else transpose.transpose_observations(seen))
    with _evaluating(model.policy):
        if hasattr(model.policy, "lstm_actor"):
            actions = _episode(model, seen)
        else:
            actions = model.predict(seen, deterministic=True)[0]
    if isinstance(action_space, spaces.MultiBinary):
        return actions.astype(np.int8)
    return np.asarray(plus_start(action_space, actions))


def _episode(model: BaseAlgorithm, observations: Any) -> np.ndarray:
    """Run a recurrent policy over one episode, a row a step."""
    rows = len(next(iter(observations.values())) if isinstance(observations, dict) else observations)
    state, actions = None, []
    for t in range(rows):
        one = (
            {k: v[t : t + 1] for k, v in observations.items()}
            if isinstance(observations, dict)
            else observations[t : t + 1]
        )
        action, state = model.predict(one, state=state, episode_start=np.array([t == 0]), deterministic=True)
        actions.append(action[0])
    return np.stack(actions)


@contextlib.contextmanager
def _evaluating(policy: nn.Module) -> Iterator[None]:
    """Undo the switch to evaluation mode that ``predict`` makes."""
    before = [(module, module.training) for module in policy.modules()]
    try:
        yield
    finally:
        for module, training in before:
            module.training = training


def _moments(normaliser: VecNormalize | None, key: str) -> Any:
    if normaliser is None or not normaliser.norm_obs or (key and key not in normaliser.norm_obs_keys):
        return None
    rms = normaliser.obs_rms[key] if key else normaliser.obs_rms
    return rms.mean, np.sqrt(rms.var + normaliser.epsilon)
