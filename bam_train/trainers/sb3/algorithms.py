"""The table of algorithms; reading it imports neither torch nor stable-baselines3."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

from bam_train.errors import SettingsError

BOX = ("Box",)
DISCRETE = ("Discrete",)
ANY = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")


@dataclass(frozen=True)
class Algorithm:
    """One algorithm of stable-baselines3 or sb3-contrib."""

    name: str
    """As ``--algo`` takes it."""
    reference: str
    """``"module:Class"``."""
    actions: tuple[str, ...]
    """Kinds of action space that it can learn on."""
    on_policy: bool
    """Whether it learns from fresh rollouts; the others keep a replay buffer."""
    recurrent: bool = False
    """Whether its policy has a memory."""

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
        fitting = ", ".join(sorted(other.name for other in _ROWS if kind in other.actions))
        remedy = f"Use one of: {fitting}." if fitting else "No algorithm here does."
        raise SettingsError(
            f"{self.name} does not fit {env}: it takes {' or '.join(self.actions)} actions, found {kind}. {remedy}"
        )


_ROWS = (
    Algorithm("ppo", "stable_baselines3:PPO", ANY, on_policy=True),
    Algorithm("a2c", "stable_baselines3:A2C", ANY, on_policy=True),
    Algorithm("sac", "stable_baselines3:SAC", BOX, on_policy=False),
    Algorithm("td3", "stable_baselines3:TD3", BOX, on_policy=False),
    Algorithm("ddpg", "stable_baselines3:DDPG", BOX, on_policy=False),
    Algorithm("dqn", "stable_baselines3:DQN", DISCRETE, on_policy=False),
    Algorithm("tqc", "sb3_contrib:TQC", BOX, on_policy=False),
    Algorithm("trpo", "sb3_contrib:TRPO", ANY, on_policy=True),
    Algorithm("qrdqn", "sb3_contrib:QRDQN", DISCRETE, on_policy=False),
    Algorithm("crossq", "sb3_contrib:CrossQ", BOX, on_policy=False),
    Algorithm("recurrent-ppo", "sb3_contrib:RecurrentPPO", ANY, on_policy=True, recurrent=True),
)
ALGORITHMS: dict[str, Algorithm] = {row.name: row for row in _ROWS}
