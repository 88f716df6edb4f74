"""The table of algorithms; reading it imports neither torch nor stable-baselines3."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from bam_train.trainers.algorithm import BOX, DISCRETE, AlgorithmRow

ANY = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")


@dataclass(frozen=True)
class Algorithm(AlgorithmRow):
    """One algorithm of stable-baselines3 or sb3-contrib."""

    on_policy: bool
    """Whether it learns from fresh rollouts; the others keep a replay buffer."""
    recurrent: bool = False
    """Whether its policy has a memory."""

    def alternatives(self) -> Iterable[AlgorithmRow]:
        """All of the table."""
        return _ROWS


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
