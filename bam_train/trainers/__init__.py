"""Training: one protocol, `Trainer`, and the libraries behind it, imported when they are used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from bam_envs.core.errors import MissingExtra
from bam_envs.core.wording import did_you_mean
from bam_train.errors import SettingsError

if TYPE_CHECKING:
    from bam_train.trainers.trainer import Trainer

TRAINERS: dict[str, str] = {
    "rllib": "bam_train.trainers.rllib.trainer:RLlibTrainer",
    "sb3": "bam_train.trainers.sb3.sb3_trainer:SB3Trainer",
}
"""Name of a trainer to its ``"module:Class"``."""

ALGORITHMS: dict[str, str] = {
    "rllib": "bam_train.trainers.rllib_algorithms:ALGORITHMS",
    "sb3": "bam_train.trainers.sb3.sb3_algorithms:ALGORITHMS",
}
"""Name of a trainer to the table of its algorithms; reading it imports no learning library."""


EXTRAS: dict[str, str] = {"rllib": "rllib", "sb3": "train"}
"""Name of a trainer to the extra of bam-train that brings all it needs."""


def load_trainer(name: str) -> type[Trainer]:
    """The class of a trainer; this imports its library.

    Raises:
        SettingsError: No trainer has this name.
        MissingExtra: A package that its library needs is not installed.
    """
    if name not in TRAINERS:
        raise SettingsError(f"Unknown trainer {name!r}. {did_you_mean(name, TRAINERS)}")
    try:
        trainer: type[Trainer] = _resolve(TRAINERS[name])
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name).partition(".")[0], EXTRAS[name], f"The {name} trainer") from error
    return trainer


def require_algorithm(trainer: str, algorithm: str) -> None:
    """Refuse an algorithm that the trainer does not have.

    Raises:
        SettingsError: Carries the closest match, or the other trainer that has it.
    """
    if trainer not in ALGORITHMS:
        raise SettingsError(f"Unknown trainer {trainer!r}. {did_you_mean(trainer, ALGORITHMS)}")
    table = _resolve(ALGORITHMS[trainer])
    if algorithm not in table:
        others = [name for name in ALGORITHMS if algorithm in _resolve(ALGORITHMS[name])]
        if others:
            hint = f"It is one of {others[0]}'s; those of {trainer} are: {', '.join(sorted(table))}."
        else:
            hint = did_you_mean(algorithm, table)
        raise SettingsError(f"Unknown algorithm {algorithm!r}. {hint}")


def _resolve(reference: str) -> Any:
    module, _, name = reference.partition(":")
    return getattr(importlib.import_module(module), name)
