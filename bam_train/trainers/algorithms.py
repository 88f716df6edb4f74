"""Tables of the trainers and their algorithms, which import no learning library."""

from __future__ import annotations

import contextlib
import io
import pkgutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from gymnasium import spaces

from bam_envs.core.errors import MissingExtra
from bam_envs.core.spaces import leaves_by_path
from bam_envs.core.wording import did_you_mean
from bam_train.errors import SettingsError

if TYPE_CHECKING:
    from bam_train.trainers.base import Trainer


class TrainerRow(NamedTuple):
    """A trainer in the table."""

    reference: str
    """``"module:Class"``."""
    extra: str = "train"
    """Extra of bam-train that installs its packages."""


TRAINERS: dict[str, TrainerRow] = {
    "bandit": TrainerRow("bam_train.trainers.learning.grasp_q:GraspTrainer"),
    "imitation": TrainerRow("bam_train.trainers.learning.dagger:DaggerTrainer"),
    "offline": TrainerRow("bam_train.trainers.learning.offline_trainer:OfflineTrainer", "offline"),
    "rllib": TrainerRow("bam_train.trainers.rllib.rllib_trainer:RLlibTrainer", "rllib"),
    "sb3": TrainerRow("bam_train.trainers.sb3.sb3_trainer:SB3Trainer"),
}
"""Trainers by name; `bam_train.settings.SETTINGS` has their settings, `ALGORITHMS` their algorithms."""


@dataclass(frozen=True)
class Algorithm:
    """One algorithm of a library."""

    name: str
    """The value of ``--algo``."""
    reference: str
    """``"module:Class"`` of the algorithm in stable-baselines3 or sb3-contrib, of its configuration in RLlib."""
    actions: tuple[str, ...]
    """Kinds of action space that it supports."""
    on_policy: bool = False
    """Whether it learns from fresh rollouts; the others keep a replay buffer or recorded episodes."""
    recurrent: bool = False
    """Whether its policy is recurrent."""
    offline: bool = False
    """Whether it learns from recorded episodes only, without stepping an environment."""

    def load(self) -> Any:
        """The class; imports its library."""
        return pkgutil.resolve_name(self.reference)

    def require_actions(self, env: str, kind: str) -> None:
        """Refuse `env` if this algorithm cannot learn on its `kind` of action space, such as ``Box``."""
        if kind in self.actions:
            return
        table = next(table for table in ALGORITHMS.values() if self in table.values())
        near = [*table.values(), *(() if self.offline or len(table) > 1 else SB3_ALGORITHMS.values())]
        others = [other for other in near if other.offline == self.offline and kind in other.actions]
        fitting = ", ".join(sorted(other.name for other in others))
        remedy = f"Use one of: {fitting}." if fitting else "No algorithm here does."
        raise SettingsError(
            f"{self.name} does not fit {env}: it takes {' or '.join(self.actions)} actions, found {kind}. {remedy}"
        )

    def require_observations(self, env: str, space: Any, several: tuple[type, ...] = (spaces.Dict,)) -> None:
        """Refuse `env` if an observation, also in one of `several`, is neither a Box nor a choice."""
        for path, leaf in leaves_by_path(space, lambda part: not isinstance(part, several)):
            if type(leaf).__name__ not in ANY:
                name = f"observation {path[-1]!r}" if path else "the observation"
                nested = " or ".join(kind.__name__ for kind in several)
                raise SettingsError(
                    f"{self.name} does not fit {env}: {name} is a {type(leaf).__name__}, expected "
                    f"{', '.join(ANY[:-1])} or {ANY[-1]}, or a {nested} of them. "
                    "Leave it out, or turn it into numbers, in the environment"
                )


_BOX = ("Box",)
_DISCRETE = ("Discrete",)
_CHOICES = ("Box", "Discrete", "MultiDiscrete")
ANY = (*_CHOICES, "MultiBinary")


def _table(*rows: Algorithm) -> dict[str, Algorithm]:
    return {row.name: row for row in rows}


ALGORITHMS = {
    "bandit": _table(Algorithm("grasp-q", "bam_train.trainers.learner_hyperparameters:GraspQ", ("MultiDiscrete",))),
    "imitation": _table(Algorithm("dagger", "bam_train.trainers.learner_hyperparameters:Dagger", ("Box", "Discrete"))),
    "offline": _table(
        Algorithm("bc", "bam_train.trainers.learner_hyperparameters:Cloning", ("Box", "Discrete"), offline=True),
        Algorithm("iql", "bam_train.trainers.learner_hyperparameters:ImplicitQ", ("Box", "Discrete"), offline=True),
        Algorithm("awac", "d3rlpy.algos:AWACConfig", _BOX, offline=True),
        Algorithm("cal-ql", "d3rlpy.algos:CalQLConfig", _BOX, offline=True),
        Algorithm("cql", "d3rlpy.algos:CQLConfig", _BOX, offline=True),
        Algorithm("plas", "d3rlpy.algos:PLASConfig", _BOX, offline=True),
        Algorithm("rebrac", "d3rlpy.algos:ReBRACConfig", _BOX, offline=True),
        Algorithm("td3bc", "d3rlpy.algos:TD3PlusBCConfig", _BOX, offline=True),
    ),
    "rllib": _table(
        Algorithm("ppo", "ray.rllib.algorithms.ppo:PPOConfig", _CHOICES, on_policy=True),
        Algorithm("appo", "ray.rllib.algorithms.appo:APPOConfig", _CHOICES, on_policy=True),
        Algorithm("impala", "ray.rllib.algorithms.impala:IMPALAConfig", _CHOICES, on_policy=True),
        Algorithm("sac", "ray.rllib.algorithms.sac:SACConfig", ("Box", "Discrete")),
        Algorithm("tqc", "ray.rllib.algorithms.tqc:TQCConfig", _BOX),
        Algorithm("dqn", "ray.rllib.algorithms.dqn:DQNConfig", _DISCRETE),
        Algorithm("bc", "ray.rllib.algorithms.bc:BCConfig", _CHOICES, offline=True),
        Algorithm("marwil", "ray.rllib.algorithms.marwil:MARWILConfig", _CHOICES, offline=True),
        Algorithm("cql", "ray.rllib.algorithms.cql:CQLConfig", _BOX, offline=True),
        Algorithm("iql", "ray.rllib.algorithms.iql:IQLConfig", _BOX, offline=True),
    ),
    "sb3": _table(
        Algorithm("ppo", "stable_baselines3:PPO", ANY, on_policy=True),
        Algorithm("a2c", "stable_baselines3:A2C", ANY, on_policy=True),
        Algorithm("sac", "stable_baselines3:SAC", _BOX),
        Algorithm("td3", "stable_baselines3:TD3", _BOX),
        Algorithm("ddpg", "stable_baselines3:DDPG", _BOX),
        Algorithm("dqn", "stable_baselines3:DQN", _DISCRETE),
        Algorithm("tqc", "sb3_contrib:TQC", _BOX),
        Algorithm("trpo", "sb3_contrib:TRPO", ANY, on_policy=True),
        Algorithm("qrdqn", "sb3_contrib:QRDQN", _DISCRETE),
        Algorithm("crossq", "sb3_contrib:CrossQ", _BOX),
        Algorithm("recurrent-ppo", "sb3_contrib:RecurrentPPO", ANY, on_policy=True, recurrent=True),
    ),
}
"""Algorithms by trainer and name."""
RLLIB_ALGORITHMS, SB3_ALGORITHMS = ALGORITHMS["rllib"], ALGORITHMS["sb3"]


def without_notice() -> contextlib.AbstractContextManager[object]:
    """Hide what is printed on standard error while a library is imported.

    gym, which d3rlpy needs and stable-baselines3 imports where it is installed, prints that it is no longer maintained.
    """
    return contextlib.redirect_stderr(io.StringIO())


def load_trainer(name: str) -> type[Trainer[Any]]:
    """Import the class of a trainer with its library; raises MissingExtra without the library."""
    if name not in TRAINERS:
        raise SettingsError(f"Unknown trainer {name!r}. {did_you_mean(name, TRAINERS)}")
    try:
        with without_notice():
            trainer: type[Trainer[Any]] = pkgutil.resolve_name(TRAINERS[name].reference)
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name).partition(".")[0], TRAINERS[name].extra, f"The {name} trainer") from error
    return trainer


def require_algorithm(trainer: str, algorithm: str) -> None:
    """Refuse an algorithm that the trainer lacks; the error names the closest match or the trainer that has it."""
    if trainer not in ALGORITHMS:
        raise SettingsError(f"Unknown trainer {trainer!r}. {did_you_mean(trainer, ALGORITHMS)}")
    table = ALGORITHMS[trainer]
    if algorithm not in table:
        others = [name for name, algorithms in ALGORITHMS.items() if algorithm in algorithms]
        if trainer == "offline" and "sb3" in others:
            choices = ", ".join(sorted(table))
            text = f"{algorithm} learns in the environment, and not from a data set. Leave --data out"
            raise SettingsError(f"{text}, or choose from: {choices}.")
        if others:
            hint = f"It is one of {others[0]}'s; those of {trainer} are: {', '.join(sorted(table))}."
        else:
            hint = did_you_mean(algorithm, table)
        raise SettingsError(f"Unknown algorithm {algorithm!r}. {hint}")
