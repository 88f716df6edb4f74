"""What every row of a table of algorithms says, whichever library it is of."""

from __future__ import annotations

import abc
import importlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from bam_train.errors import SettingsError

BOX = ("Box",)
DISCRETE = ("Discrete",)


@dataclass(frozen=True)
class AlgorithmRow(abc.ABC):
    """One algorithm of a library."""

    name: str
    """As ``--algo`` takes it."""
    reference: str
    """``"module:Class"`` of what `load` gives."""
    actions: tuple[str, ...]
    """Kinds of action space that it can learn on."""

    @abc.abstractmethod
    def alternatives(self) -> Iterable[AlgorithmRow]:
        """What may take its place where it does not fit."""

    def load(self) -> Any:
        """The class; imports its library."""
        module, _, name = self.reference.partition(":")
        return getattr(importlib.import_module(module), name)

    def require_actions(self, env: str, kind: str) -> None:
        """Refuse an action space that this algorithm cannot learn on.

        Args:
            env: Environment id, as the error names it.
            kind: Class name of its action space.

        Raises:
            SettingsError: Names the algorithms that can.
        """
        if kind in self.actions:
            return
        fitting = ", ".join(sorted(row.name for row in self.alternatives() if kind in row.actions))
        remedy = f"Use one of: {fitting}." if fitting else "No algorithm here does."
        raise SettingsError(
            f"{self.name} does not fit {env}: it takes {' or '.join(self.actions)} actions, found {kind}. {remedy}"
        )
