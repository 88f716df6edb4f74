"""Numbers that no algorithm can learn with; what the libraries themselves would take without a word."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from bam_train.errors import SettingsError


@dataclass(frozen=True)
class Ranges:
    """Names of hyperparameters by the range of their numbers; every number must be finite."""

    shares: tuple[str, ...]
    """0 to 1."""
    positive: tuple[str, ...]
    """Above 0."""
    counts: tuple[str, ...]
    """At least 1."""
    not_negative: tuple[str, ...]
    """At least 0."""

    def require(self, name: str, number: float, value: Any) -> None:
        """Refuse a number out of its range.

        Args:
            name: Of the hyperparameter.
            number: What it is, or begins with.
            value: As the user gave it.

        Raises:
            SettingsError: Names it, its range and the value.
        """
        if not math.isfinite(number):
            raise SettingsError(f"{name}: expected a finite number, found {value!r}")
        expected = self._complaint(name, number)
        if expected is not None:
            raise SettingsError(f"{name}: expected {expected}, found {value!r}")

    def _complaint(self, name: str, number: float) -> str | None:
        """What was expected instead of `number`; None if it is in range."""
        if name in self.shares and not 0 <= number <= 1:
            return "a number from 0 to 1"
        if name in self.positive and not number > 0:
            return "a number above 0"
        if name in self.counts and not number >= 1:
            return "at least 1"
        if name in self.not_negative and not number >= 0:
            return "at least 0"
        return None
