"""The table of RLlib's algorithms on its new API stack; nothing here is imported but when a row is loaded.

It is beside the package `rllib` and not in it: importing that registers our environments, and imports ray for it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from bam_train.trainers.algorithm import BOX, DISCRETE, AlgorithmRow

ANY = ("Box", "Discrete", "MultiDiscrete")


@dataclass(frozen=True)
class Algorithm(AlgorithmRow):
    """One algorithm of RLlib; `load` gives the class of its configuration."""

    on_policy: bool = False
    """Whether it learns from fresh episodes alone; the others keep a replay buffer or recorded episodes."""
    offline: bool = False
    """Whether it learns from recorded episodes, and takes no step in an environment."""

    def alternatives(self) -> Iterable[AlgorithmRow]:
        """Those that learn from the same: recorded episodes, or an environment."""
        return (row for row in _ROWS if row.offline == self.offline)


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
