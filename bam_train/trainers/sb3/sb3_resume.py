"""The state from which a run of stable-baselines3 resumes exactly: ``bam/resume/…`` in its checkpoints.

It is taken between two updates, without a partial rollout or a partial gradient step.
"""

import json
import random
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import VecNormalize

from bam_envs.core.spaces import leaves
from bam_envs.core.validation import check
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.safetensors_file import pack

MODEL, STATE, REPLAY, NOTES = "bam/resume/model", "bam/resume/state", "bam/resume/replay", "bam/resume/notes.json"

_Count = Annotated[int, Meta(ge=0, le=2**53, description="a count")]
_Share = Annotated[float, Meta(ge=-1, le=1, description="a share of the run")]
_COUNTERS = {
    **dict.fromkeys(("num_timesteps", "_episode_num", "_n_updates", "_n_calls"), _Count),
    **dict.fromkeys(("_current_progress_remaining", "exploration_rate"), _Share),
}
"""Counters of a model, each of which some algorithms have."""
_LAST = ("_last_obs", "_last_original_obs", "_last_episode_starts")
"""Attributes with the last observations, from which the next rollout starts."""
_DEQUES = ("ep_info_buffer", "ep_success_buffer")
_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@dataclass(frozen=True)
class Waiting:
    """State that is restored just before the next training step: setting up draws random numbers and resets noise."""

    checkpoint: Checkpoint
    """The checkpoint of this state."""
    random: dict[str, Any]
    noise: list[Any]
    same_episodes: bool
    """Whether the episodes that ran when the checkpoint was saved continue."""

    def restore(self, model: Any) -> None:
        """Restore the state into a model."""
        with self.checkpoint.fitting(STATE):
            for process, previous in zip(_correlated_noises(model), self.noise, strict=True):
                process.noise_prev = previous
            load_random_states(model, self.random)


def members(
    model: Any, venv: Any, normaliser: VecNormalize | None, waiting: Waiting | None, notes: Mapping[str, Any]
) -> dict[str, bytes]:
    """The members of a checkpoint from which a run of `model` on `venv` continues.

    `waiting` is the state that a loaded run has not restored yet; `notes` are JSON values.
    """
    _, loose = model._get_torch_save_params()  # such as SAC's entropy coefficient
    weights = {"states": model.get_parameters(), "loose": {name: recursive_getattr(model, name) for name in loose}}
    tree = {
        "counters": _counters(model),
        "normaliser": _statistics(normaliser),
        "env": venv.state_dict() if getattr(venv, "can_be_saved", False) and model._last_obs is not None else None,
        "random": waiting.random if waiting else random_states(model),
        "noise": waiting.noise if waiting else [one.noise_prev for one in _correlated_noises(model)],
    }
    written = {NOTES: json.dumps(dict(notes)).encode(), **pack(MODEL, weights), **pack(STATE, tree)}
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        # + 1: a buffer with optimize_memory_usage keeps the newest next observation at `pos`.
        filled = buffer.buffer_size if buffer.full else min(buffer.pos + 1, buffer.buffer_size)
        arrays: dict[str, Any] = {name: getattr(buffer, name, None) for name in _REPLAY}
        for name, stored in arrays.items():
            if stored is not None:
                keyed = isinstance(stored, dict)
                arrays[name] = {key: array[:filled] for key, array in stored.items()} if keyed else stored[:filled]
        written |= pack(REPLAY, {"pos": buffer.pos, "full": buffer.full, "filled": filled, "arrays": arrays})
    return written


def load_weights(checkpoint: Checkpoint, model: Any, *, own_noise: bool = False) -> None:
    """Restore the weights of a checkpoint, and the state of its optimisers, into a new model of the same networks.

    With `own_noise`, a model whose actions have another kind of noise keeps it, and its new optimiser.
    """
    with checkpoint.fitting(MODEL):
        weights = checkpoint.state(MODEL, torch.from_numpy)
        saved, own = weights["states"], model.get_parameters()
        theirs, ours = (states["policy"].get("log_std") for states in (saved, own))
        if own_noise and theirs is not None and ours is not None and theirs.shape != ours.shape:
            saved["policy"]["log_std"], saved["policy.optimizer"] = ours, own["policy.optimizer"]
        model.set_parameters(weights["states"], exact_match=True, device=model.device)
        for name, value in weights["loose"].items():
            if value is not None:
                recursive_getattr(model, name).data.copy_(value)


def begin_with(checkpoint: Checkpoint, model: Any, normaliser: VecNormalize | None) -> None:
    """Give a new run the weights of a checkpoint, and what its observations and rewards are normalised by."""
    load_weights(checkpoint, model, own_noise=True)
    if normaliser is not None:
        with checkpoint.fitting(STATE):
            _load_statistics(normaliser, checkpoint.state(STATE, torch.from_numpy)["normaliser"])


def load(checkpoint: Checkpoint, model: Any, venv: Any, normaliser: VecNormalize | None) -> Waiting:
    """Restore a checkpoint's state into a new model of the same settings; returns the part to be restored later."""
    load_weights(checkpoint, model)
    tree = checkpoint.state(STATE, torch.from_numpy)
    with checkpoint.fitting(STATE):
        _load_counters(model, tree["counters"])
        if normaliser is not None:
            _load_statistics(normaliser, tree["normaliser"])
        same = getattr(venv, "can_be_saved", False) and tree["env"] is not None
        if same:
            venv.load_state_dict(tree["env"])
        else:  # `learn` begins new episodes, with a seed that depends on the steps trained
            model._last_obs = None
            venv.seed(model.seed + model.num_timesteps)
        waiting = Waiting(checkpoint, tree["random"], tree["noise"], same)
    if checkpoint.has(f"{REPLAY}.json"):
        with checkpoint.fitting(REPLAY):
            saved = checkpoint.state(REPLAY, torch.from_numpy)
            buffer, filled = model.replay_buffer, saved["filled"]
            for name, arrays in saved["arrays"].items():
                stored = getattr(buffer, name, None)
                if isinstance(stored, dict):
                    for key, array in stored.items():
                        array[:filled] = arrays[key]
                elif stored is not None:
                    stored[:filled] = arrays
            buffer.pos, buffer.full = saved["pos"], saved["full"]
    return waiting


def _counters(model: Any) -> dict[str, Any]:
    """Counters, the last observations, and the returns of the last episodes."""
    tree: dict[str, Any] = {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}
    tree["last"] = {name: getattr(model, name) for name in _LAST}
    tree["deques"] = {name: list(getattr(model, name) or ()) for name in _DEQUES}
    lstm = getattr(model, "_last_lstm_states", None)
    tree["lstm"] = None if lstm is None else {"pi": tuple(lstm.pi), "vf": tuple(lstm.vf)}
    return tree


def _load_counters(model: Any, tree: Mapping[str, Any]) -> None:
    """Check the kinds, ranges and shapes of `_counters`, and restore them."""
    for name, kind in _COUNTERS.items():
        if name in tree:
            setattr(model, name, check(tree[name], kind, name))
    for name in _LAST:
        value = tree["last"][name]
        if value is not None:  # None before the first step
            wanted = {key: (model.n_envs, *(leaf.shape or ())) for key, leaf in leaves(model.observation_space).items()}
            if name == "_last_episode_starts":
                wanted = {"": (model.n_envs,)}
            found = {key: np.shape(part) for key, part in (value if isinstance(value, dict) else {"": value}).items()}
            if found != wanted:
                raise ValueError(f"{name}: expected arrays of shape {wanted}, found {found!s:.80}")
        setattr(model, name, value)
    for name in _DEQUES:  # returns and lengths of episodes, or whether they succeeded
        for value in tree["deques"][name]:
            numbers = [value["r"], value["l"]] if name == "ep_info_buffer" else [value]
            if not all(isinstance(number, (bool, int, float, np.bool_, np.number)) for number in numbers):
                raise ValueError(f"{name}: expected numbers of episodes, found {value!r:.40}")
        setattr(model, name, deque(tree["deques"][name], maxlen=model._stats_window_size))
    if tree["lstm"] is not None:
        model._last_lstm_states = type(model._last_lstm_states)(tree["lstm"]["pi"], tree["lstm"]["vf"])


def _statistics(env: VecNormalize | None) -> dict[str, Any] | None:
    """The running statistics of a `VecNormalize`."""
    if env is None:
        return None
    observed, returns = _running(env)
    moments = {key: {"mean": rms.mean, "var": rms.var, "count": rms.count} for key, rms in observed.items()}
    rewards = {"mean": returns.mean, "var": returns.var, "count": returns.count}
    return {"observations": moments, "returns": rewards, "running": np.array(env.returns)}


def _load_statistics(env: VecNormalize, tree: Mapping[str, Any]) -> None:
    """Restore `_statistics`."""
    observed, returns = _running(env)
    pairs = [(observed[key], moments) for key, moments in tree["observations"].items()]
    for rms, moments in [*pairs, (returns, tree["returns"])]:
        rms.mean, rms.var, rms.count = moments["mean"], moments["var"], moments["count"]
    env.returns = np.array(tree["running"])


def _running(env: VecNormalize) -> tuple[dict[str, Any], Any]:
    """The running moments of observations, by key of a Dict or ``""``, and of returns."""
    observed = getattr(env, "obs_rms", None)
    keyed = observed if isinstance(observed, dict) else {"": observed}
    return {key: rms for key, rms in keyed.items() if rms is not None}, env.ret_rms


def _correlated_noises(model: Any) -> list[Any]:
    """The action noises with a state, one for each environment; `learn` makes these of a single one."""
    shared = model.action_noise
    noises = shared.noises if isinstance(shared, VectorizedActionNoise) else [shared]
    return [noise for noise in noises if hasattr(noise, "noise_prev")]


def random_states(model: Any) -> dict[str, Any]:
    """The states of all random number generators of training, without those inside environments."""
    kind, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)
    return {
        "python": random.getstate(),
        "numpy": {"kind": kind, "keys": keys, "position": position, "has_gauss": has_gauss, "gauss": gauss},
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if model.device.type == "cuda" else [],
        "actions": model.action_space.np_random.bit_generator.state,
    }


def load_random_states(model: Any, tree: Mapping[str, Any]) -> None:
    """Restore `random_states`, as the last step before training continues."""
    random.setstate(tree["python"])
    saved = tree["numpy"]
    np.random.set_state((saved["kind"], saved["keys"], saved["position"], saved["has_gauss"], saved["gauss"]))
    torch.set_rng_state(tree["torch"].cpu())
    if tree["cuda"] and model.device.type == "cuda":
        torch.cuda.set_rng_state_all([state.cpu() for state in tree["cuda"]])
    model.action_space.np_random.bit_generator.state = tree["actions"]
