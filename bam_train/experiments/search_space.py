"""What a search varies: ranges and choices among the settings that a user gives.

A value that is text such as ``log:1e-4..1e-2``, ``0.9..0.999``, ``int:1..10`` or ``256,512`` is searched; any other
value is fixed. `SearchSpace.settings` gives the settings of one trial.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bam_envs.core.wording import brief
from bam_train.errors import SettingsError
from bam_train.settings import TABLES, TrainSettings, merge, nested, parse_assignment, walk
from bam_train.trainers.resolve_settings import resolve

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"((?:log:|int:)*)({_NUMBER})\.\.({_NUMBER})")
_LOOKS_LIKE_A_RANGE = re.compile(r"(log:|int:).*|[^./\\]*\d\.\.[-+\d].*")
SEARCHED = frozenset({"num_envs", *TABLES})
"""Settings that may be searched; tables by their entries."""


@dataclass(frozen=True)
class Dimension:
    """One setting that is searched: a range, with both ends, or choices."""

    name: str
    """As of ``--set``, such as ``hyperparameters.learning_rate``."""
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    whole: bool = False
    choices: tuple[str, ...] = ()
    """As JSON."""

    @property
    def title(self) -> str:
        """The name as people write it."""
        return self.name.removeprefix("hyperparameters.")

    @property
    def ends(self) -> list[Any]:
        """Values that must be valid for all of them to be."""
        return [json.loads(one) for one in self.choices] or [self.low, self.high]

    def has(self, value: Any) -> bool:
        """Whether a value is in the range, or among the choices."""
        if self.choices:
            return json.dumps(value) in self.choices
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return is_number and self.low <= value <= self.high and not (self.whole and value % 1)

    def suggest(self, trial: Any) -> None:
        """Let Optuna choose a value for its trial; one that was chosen before stays."""
        if self.choices:
            trial.suggest_categorical(self.name, self.choices)
        elif self.whole:
            trial.suggest_int(self.name, int(self.low), int(self.high), log=self.log)
        else:
            trial.suggest_float(self.name, self.low, self.high, log=self.log)


class SearchSpace:
    """The settings of a search, and what it varies of them.

    Args:
        given: Settings as `resolve` takes them, of which some values are ranges or choices as text.

    Raises:
        SettingsError: Nothing is searched, a range is wrong, or the trainer refuses a name or a value.
    """

    def __init__(self, given: Mapping[str, Any]) -> None:
        found = dict(walk(given))
        self.dimensions = [one for name, value in found.items() if (one := _read(name, value)) is not None]
        searched = {one.name for one in self.dimensions}
        self._fixed = merge(*(nested(name.split("."), value) for name, value in found.items() if name not in searched))
        self.base = resolve(self._fixed)
        """The settings of the preset, without a search."""
        if not self.dimensions:
            example = "--set learning_rate=log:1e-4..1e-2"
            raise SettingsError(f"nothing is searched; give a range or choices, such as {example}")
        self.dimensions = [self._checked(one) for one in self.dimensions]

    def settings(self, values: Mapping[str, Any]) -> TrainSettings:
        """Settings with these values of the dimensions; choices are JSON, as Optuna has them."""
        chosen = {one.name: one for one in self.dimensions}
        plain = {name: json.loads(value) if chosen[name].choices else value for name, value in values.items()}
        return self._resolve(plain)

    def values(self, settings: TrainSettings) -> dict[str, Any] | None:
        """The values of all dimensions in settings, as Optuna has them; None if one is outside."""
        found = dict(walk(settings.to_mapping()))
        if not all(one.has(found.get(one.name)) for one in self.dimensions):
            return None
        return {one.name: json.dumps(found[one.name]) if one.choices else found[one.name] for one in self.dimensions}

    def _resolve(self, values: Mapping[str, Any]) -> TrainSettings:
        return resolve(merge(self._fixed, *(nested(name.split("."), value) for name, value in values.items())))

    def _checked(self, one: Dimension) -> Dimension:
        """The dimension, of whole numbers if the setting takes no others; refuses values that it does not take."""
        for value in one.ends:
            self._resolve({one.name: int(value) if not one.choices and value % 1 == 0 else value})
        if one.choices or one.whole or one.low % 1 or one.high % 1:
            return one
        try:
            self._resolve({one.name: one.low + 0.5})
        except SettingsError:
            return Dimension(one.name, one.low, one.high, one.log, whole=True)
        return one


def _read(name: str, text: Any) -> Dimension | None:
    """The dimension that a value stands for; None if it is a value."""
    if not isinstance(text, str) or name.partition(".")[0] not in SEARCHED or name == "env_kwargs.robot_model":
        return None
    shown = name.removeprefix("hyperparameters.")
    if match := _RANGE.fullmatch(text.strip()):
        kinds, low, high = match[1], float(match[2]), float(match[3])
        if "log:" in kinds and min(low, high) <= 0:
            found = match[2] if low <= 0 else match[3]
            remedy = "give one such as log:1e-4..1e-2, or leave log: out"
            raise SettingsError(f"{shown}={text}: a logarithmic range begins above 0, found {found}; {remedy}")
        if low >= high:
            swapped = f"{kinds}{match[3]}..{match[2]}"
            raise SettingsError(f"{shown}={text}: {match[2]} is not below {match[3]}; give {swapped}")
        if "int:" in kinds and (low % 1 or high % 1):
            raise SettingsError(f"{shown}={text}: expected whole numbers at both ends of int:")
        return Dimension(name, low, high, "log:" in kinds, "int:" in kinds)
    if _LOOKS_LIKE_A_RANGE.fullmatch(text):
        expected = "a range such as log:1e-4..1e-2, 0.9..0.99 or int:1..10"
        raise SettingsError(f"{shown}={text}: expected {expected}, found {brief(text)}")
    if "," not in text:
        return None
    try:
        choices = json.loads(f"[{text}]")
    except ValueError:  # words
        choices = [parse_assignment(f"{name}={part}", "")[1] for part in text.split(",")]
    written = tuple(json.dumps(one) for one in choices)
    if "" in choices or len({*written}) < max(2, len(written)):
        raise SettingsError(f"{shown}={text}: expected different choices such as 256,512, found {brief(text)}")
    return Dimension(name, choices=written)
