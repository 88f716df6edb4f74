"""The table of RLlib's algorithms on its new API stack; nothing here is imported but when a row is loaded.

It is beside the package `rllib` and not in it: importing that registers our environments, and imports ray for it.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

from bam_train.errors import SettingsError

BOX = ("Box",)
DISCRETE = ("Discrete",)
ANY = ("Box", "Discrete", "MultiDiscrete")


@dataclass(frozen=True)
class Algorithm:
    """One algorithm of RLlib."""

    name: str
    """As ``--algo`` takes it."""
    reference: str
    """``"module:Class"`` of its `AlgorithmConfig`."""
    actions: tuple[str, ...]
    """Kinds of action space that it can learn on."""
    on_policy: bool = False
    """Whether it learns from fresh episodes alone; the others keep a replay buffer or recorded episodes."""
    offline: bool = False
    """Whether it learns from recorded episodes, and takes no step in an environment."""

    def load(self) -> Any:
        """The class of its configuration; imports RLlib."""
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
        fitting = ", ".join(sorted(row.name for row in _ROWS if kind in row.actions and row.offline == self.offline))
        remedy = f"Use one of: {fitting}." if fitting else "No algorithm here does."
        raise SettingsError(
            f"{self.name} does not fit {env}: it takes {' or '.join(self.actions)} actions, found {kind}. {remedy}"
        )


_ROWS = (
    Algorithm("ppo", "ray.rllib.algorithms.ppo:PPOConfig", ANY, on_policy=True),
    Algorithm("appo", "ray.rllib.algorithms.appo:APPOConfig", ANY, on_policy=True),
    Algorithm("impala", "ray.rllib.algorithms.impala:IMPALAConfig", ANY, on_policy=True),
    Algorithm("sac", "ray.rllib.algorithms.sac:SACConfig", ("Box", "Discrete")),
    Algorithm("tqc", "ray.rllib.algorithms.tqc:TQCConfig", BOX),
    Algorithm("dqn", "ray.rllib.algorithms.dqn:DQNConfig", DISCRETE),
    Algorithm("bc", "ray.rllib.algorithms.bc:BCConfig", ANY, offline=True),
    Algorithm("marwil", "ray.rllib.algorithms.marwil:MARWILConfig", ANY, offline=True),
    Algorithm("cql", "ray.rllib.algorithms.cql:CQLConfig", BOX, offline=True),
    Algorithm("iql", "ray.rllib.algorithms.iql:IQLConfig", BOX, offline=True),
)
ALGORITHMS: dict[str, Algorithm] = {row.name: row for row in _ROWS}
