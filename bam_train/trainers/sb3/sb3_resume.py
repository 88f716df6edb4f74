"""``bam/resume/…`` in a checkpoint of stable-baselines3: written, and put back into a freshly made model."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.nested_state import pack, unpack
from bam_train.errors import AlteredCheckpoint, FormatError
from bam_train.trainers.sb3 import sb3_state as state
from bam_train.trainers.sb3.sb3_vec_env import BatchVecEnv

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
            state.load_noise(model, self.noise)
            state.load_random_states(model, self.random)


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
        "counters": state.counters(model),
        "normaliser": state.normaliser(normaliser),
        "env": venv.state_dict() if _can_be_saved(venv) and model._last_obs is not None else None,
        "random": waiting.random if waiting else state.random_states(model),
        "noise": waiting.noise if waiting else state.noise(model),
    }
    packed = {MODEL: pack(state.weights(model)), STATE: pack(tree)}
    replay = state.replay(model)
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
        state.load_weights(model, _read(checkpoint, MODEL))
    tree = _read(checkpoint, STATE)
    with _fits(checkpoint, STATE):
        state.load_counters(model, tree["counters"])
        if normaliser is not None:
            state.load_normaliser(normaliser, tree["normaliser"])
        same = _load_episodes(model, venv, tree["env"])
        waiting = Waiting(tree["random"], tree["noise"], same, checkpoint)
    if checkpoint.has(f"{REPLAY}.json"):
        with _fits(checkpoint, REPLAY):
            state.load_replay(model, _read(checkpoint, REPLAY))
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
