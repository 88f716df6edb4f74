"""What a run of stable-baselines3 needs to go on exactly: ``bam/resume/…`` in its checkpoints.

It is taken between two updates (before a rollout begins): no rollout is half collected, no gradient half applied. It is
put back into a freshly made model. The file is long because each kind of state is taken and put back in its own way.
"""

from __future__ import annotations

import json
import random
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.nested_state import pack, unpack
from bam_train.errors import AlteredCheckpoint, FormatError
from bam_train.trainers.sb3.sb3_vec_env import BatchVecEnv

Tree = dict[str, Any]

COUNTERS = (
    "num_timesteps",
    "_episode_num",
    "_n_updates",
    "_n_calls",
    "_current_progress_remaining",
    "exploration_rate",
)
"""Numbers that a model counts with, where it has them."""

_SHARES = ("_current_progress_remaining", "exploration_rate")

LAST = ("_last_obs", "_last_original_obs", "_last_episode_starts")
"""What the model saw last, where its next rollout begins."""

_DEQUES = ("ep_info_buffer", "ep_success_buffer")
_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def weights(model: Any) -> Tree:
    """Every network's and optimiser's state, and the loose parameters (SAC's entropy coefficient)."""
    _, loose = model._get_torch_save_params()
    return {"states": model.get_parameters(), "loose": {name: recursive_getattr(model, name) for name in loose}}


def load_weights(model: Any, tree: Mapping[str, Any]) -> None:
    """Put `weights` back."""
    model.set_parameters(tree["states"], exact_match=True, device=model.device)
    for name, value in tree["loose"].items():
        if value is not None:
            recursive_getattr(model, name).data.copy_(value)


def all_finite(model: Any) -> bool:
    """Whether every parameter of the policy is a finite number, and the standard deviation of its actions too."""
    log_std = getattr(model.policy, "log_std", None)
    numbers = [*model.policy.parameters(), *([] if log_std is None else [log_std.exp()])]
    return all(bool(torch.isfinite(one).all()) for one in numbers)


def refused_distribution(error: Exception) -> bool:
    """Whether torch refused a distribution: weights that are finite can still overflow on their way to it."""
    text = str(error)
    return "Expected parameter" in text or "expects all elements of std" in text or "probability tensor" in text


def counters(model: Any) -> Tree:
    """How far the run is, what it saw last, and the last episodes' returns."""
    tree: Tree = {name: getattr(model, name) for name in COUNTERS if hasattr(model, name)}
    tree["last"] = {name: getattr(model, name) for name in LAST}
    tree["deques"] = {name: list(getattr(model, name) or ()) for name in _DEQUES}
    lstm = getattr(model, "_last_lstm_states", None)
    tree["lstm"] = None if lstm is None else {"pi": tuple(lstm.pi), "vf": tuple(lstm.vf)}
    return tree


def load_counters(model: Any, tree: Mapping[str, Any]) -> None:
    """Put `counters` back.

    Raises:
        ValueError: One is of another kind, or what was seen last has another shape than the environments'.
    """
    for name in COUNTERS:
        if name in tree:
            setattr(model, name, _counter(name, tree[name], share=name in _SHARES))
    for name in LAST:
        setattr(model, name, _seen(name, model, tree["last"][name]))
    for name in _DEQUES:
        setattr(model, name, deque(_episodes(name, tree["deques"][name]), maxlen=model._stats_window_size))
    if tree["lstm"] is not None:
        model._last_lstm_states = type(model._last_lstm_states)(tree["lstm"]["pi"], tree["lstm"]["vf"])


def _counter(name: str, value: Any, *, share: bool) -> Any:
    """A count, or a share of the run."""
    kinds, most = ((int, float), 1) if share else ((int,), 2**53)
    if type(value) not in kinds or not -1 <= value <= most:
        raise ValueError(f"{name}: expected {'a share of the run' if share else 'a count'}, found {value!r:.40}")
    return value


def _seen(name: str, model: Any, value: Any) -> Any:
    """Arrays of the environments' shape, one row each; None before the first step."""
    if value is None:
        return None
    space, n = model.observation_space, model.n_envs
    if name == "_last_episode_starts":
        wanted = {"": (n,)}
    elif isinstance(space, spaces.Dict):
        wanted = {key: (n, *(one.shape or ())) for key, one in space.spaces.items()}
    else:
        wanted = {"": (n, *(space.shape or ()))}
    found = {key: np.shape(one) for key, one in (value if isinstance(value, dict) else {"": value}).items()}
    if found != wanted:
        raise ValueError(f"{name}: expected arrays of shape {wanted}, found {found!s:.80}")
    return value


def _episodes(name: str, values: Any) -> list[Any]:
    """What the statistics average: returns and lengths of episodes, or whether they succeeded."""
    for value in values:
        numbers = [value["r"], value["l"]] if name == "ep_info_buffer" else [value]
        if not all(isinstance(number, (bool, int, float, np.bool_, np.number)) for number in numbers):
            raise ValueError(f"{name}: expected numbers of episodes, found {value!r:.40}")
    return list(values)


def normaliser_state(env: VecNormalize | None) -> Tree | None:
    """The running statistics of a `VecNormalize`."""
    if env is None:
        return None
    observed = getattr(env, "obs_rms", None)
    keyed = observed if isinstance(observed, dict) else {"": observed}
    return {
        "observations": {key: _moments(one) for key, one in keyed.items() if one is not None},
        "returns": _moments(env.ret_rms),
        "running": np.array(env.returns),
    }


def load_normaliser(env: VecNormalize, tree: Mapping[str, Any]) -> None:
    """Put `normaliser_state` back."""
    observed = getattr(env, "obs_rms", None)
    for key, moments in tree["observations"].items():
        _load_moments(observed[key] if isinstance(observed, dict) else observed, moments)
    _load_moments(env.ret_rms, tree["returns"])
    env.returns = np.array(tree["running"])


def _moments(one: RunningMeanStd) -> Tree:
    return {"mean": one.mean, "var": one.var, "count": one.count}


def _load_moments(one: Any, tree: Mapping[str, Any]) -> None:
    one.mean, one.var, one.count = tree["mean"], tree["var"], tree["count"]


def noise_state(model: Any) -> list[Any]:
    """What correlated action noise remembers, for each environment; [] if nothing."""
    return [one.noise_prev for one in _noises(model.action_noise) if hasattr(one, "noise_prev")]


def load_noise(model: Any, tree: list[Any]) -> None:
    """Put `noise_state` back; after `learn` began, which spreads the noise over the environments."""
    remembering = [one for one in _noises(model.action_noise) if hasattr(one, "noise_prev")]
    for one, previous in zip(remembering, tree, strict=True):
        one.noise_prev = previous


def _noises(one: ActionNoise | None) -> list[Any]:
    if one is None:
        return []
    return list(one.noises) if isinstance(one, VectorizedActionNoise) else [one]


def replay_state(model: Any) -> Tree | None:
    """The filled part of the replay buffer; None if the algorithm keeps none."""
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None:
        return None
    # + 1: a buffer with optimize_memory_usage keeps the newest next observation at `pos`.
    filled = buffer.buffer_size if buffer.full else min(buffer.pos + 1, buffer.buffer_size)
    arrays = {name: _each(getattr(buffer, name, None), lambda array: array[:filled]) for name in _REPLAY}
    return {"pos": buffer.pos, "full": buffer.full, "filled": filled, "arrays": arrays}


def load_replay(model: Any, tree: Mapping[str, Any]) -> None:
    """Put `replay_state` back into the empty buffer of a new model."""
    buffer, filled = model.replay_buffer, tree["filled"]
    for name, saved in tree["arrays"].items():
        own = getattr(buffer, name, None)
        if isinstance(own, dict):
            for key, array in own.items():
                array[:filled] = saved[key]
        elif own is not None:
            own[:filled] = saved
    buffer.pos, buffer.full = tree["pos"], tree["full"]


def _each(arrays: Any, change: Any) -> Any:
    if isinstance(arrays, dict):
        return {key: change(array) for key, array in arrays.items()}
    return None if arrays is None else change(arrays)


def random_states(model: Any) -> Tree:
    """Every generator that training draws from, but for those inside environments."""
    kind, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)
    return {
        "python": random.getstate(),
        "numpy": {"kind": kind, "keys": keys, "position": position, "has_gauss": has_gauss, "gauss": gauss},
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if _on_cuda(model) else [],
        "actions": model.action_space.np_random.bit_generator.state,
    }


def load_random_states(model: Any, tree: Mapping[str, Any]) -> None:
    """Put `random_states` back; the last thing to do before going on."""
    _load_global(tree)
    if tree["cuda"] and _on_cuda(model):
        torch.cuda.set_rng_state_all([state.cpu() for state in tree["cuda"]])
    model.action_space.np_random.bit_generator.state = tree["actions"]


def _load_global(tree: Mapping[str, Any]) -> None:
    version, numbers, gauss = tree["python"]
    random.setstate((version, tuple(numbers), gauss))
    saved = tree["numpy"]
    np.random.set_state((saved["kind"], saved["keys"], saved["position"], saved["has_gauss"], saved["gauss"]))
    torch.set_rng_state(tree["torch"].cpu())


def _on_cuda(model: Any) -> bool:
    return bool(model.device.type == "cuda")


@contextmanager
def undisturbed(model: Any) -> Iterator[None]:
    """Do something between two updates that leaves training's random numbers as they were."""
    before = random_states(model)
    try:
        yield
    finally:
        load_random_states(model, before)


MODEL, STATE, REPLAY, NOTES = "bam/resume/model", "bam/resume/state", "bam/resume/replay", "bam/resume/notes.json"


@dataclass(frozen=True)
class Waiting:
    """What is put back only when training takes its next step: setting up draws random numbers and resets noise."""

    random: dict[str, Any]
    noise: list[Any]
    same_episodes: bool
    """Whether the episodes that ran when the checkpoint was saved go on."""
    checkpoint: Checkpoint
    """Where it comes from."""

    def restore(self, model: Any) -> None:
        """Put it back.

        Raises:
            AlteredCheckpoint: It does not fit the model.
        """
        with _fits(self.checkpoint, STATE):
            load_noise(model, self.noise)
            load_random_states(model, self.random)


def members(
    model: Any, venv: VecEnv, normaliser: VecNormalize | None, waiting: Waiting | None, notes: Mapping[str, Any]
) -> dict[str, bytes]:
    """Everything that the run needs to go on.

    Args:
        model: The model, between two updates.
        venv: Its environments, without wrappers.
        normaliser: Its `VecNormalize`, if any.
        waiting: What a loaded run has not put back yet.
        notes: JSON values to keep.
    """
    tree = {
        "counters": counters(model),
        "normaliser": normaliser_state(normaliser),
        "env": venv.state_dict() if _can_be_saved(venv) and model._last_obs is not None else None,
        "random": waiting.random if waiting else random_states(model),
        "noise": waiting.noise if waiting else noise_state(model),
    }
    packed = {MODEL: pack(weights(model)), STATE: pack(tree)}
    replay = replay_state(model)
    if replay is not None:
        packed[REPLAY] = pack(replay)
    written = {NOTES: json.dumps(dict(notes)).encode()}
    for name, pair in packed.items():
        written |= {f"{name}{suffix}": data for suffix, data in zip(_SUFFIXES, pair, strict=True)}
    return written


_SUFFIXES = (".json", ".safetensors")


def load(checkpoint: Checkpoint, model: Any, venv: VecEnv, normaliser: VecNormalize | None) -> Waiting:
    """Put a checkpoint's state into a new model of the same settings; what is left is returned.

    Raises:
        AlteredCheckpoint: A member is missing, or does not fit the model.
    """
    with _fits(checkpoint, MODEL):
        load_weights(model, _read(checkpoint, MODEL))
    tree = _read(checkpoint, STATE)
    with _fits(checkpoint, STATE):
        load_counters(model, tree["counters"])
        if normaliser is not None:
            load_normaliser(normaliser, tree["normaliser"])
        same = _load_episodes(model, venv, tree["env"])
        waiting = Waiting(tree["random"], tree["noise"], same, checkpoint)
    if checkpoint.has(f"{REPLAY}.json"):
        with _fits(checkpoint, REPLAY):
            load_replay(model, _read(checkpoint, REPLAY))
    return waiting


@contextmanager
def _fits(checkpoint: Checkpoint, name: str) -> Iterator[None]:
    """What goes wrong when a state is put into a model that is not made like the saved one, in one line."""
    try:
        yield
    except (RuntimeError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        reason = " ".join(str(error).split())
        raise AlteredCheckpoint(checkpoint.path, name, f"{name} does not fit these settings: {reason:.200}") from error


def _load_episodes(model: Any, venv: VecEnv, tree: Mapping[str, Any] | None) -> bool:
    """Go on with the running episodes, or let `learn` begin new ones, seeded by how far the run is."""
    if _can_be_saved(venv) and tree is not None:
        venv.load_state_dict(tree)
        return True
    model._last_obs = None
    venv.seed(model.seed + model.num_timesteps)
    return False


def _can_be_saved(venv: VecEnv) -> bool:
    """Whether running episodes can."""
    return isinstance(venv, BatchVecEnv) and venv.can_be_saved


def _read(checkpoint: Checkpoint, name: str) -> Any:
    skeleton, arrays = (checkpoint.read(f"{name}{suffix}") for suffix in _SUFFIXES)
    try:
        return unpack(skeleton, arrays, _to_tensor)
    except FormatError as error:
        raise AlteredCheckpoint(checkpoint.path, name, str(error)) from error


def _to_tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array)
