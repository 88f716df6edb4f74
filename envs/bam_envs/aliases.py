"""Other ids of these environments: BAM's and former ones, and the table of robo-gym's; importing this is cheap.

For each id of robo-gym the table has the environment in `bam_envs`, and robo-gym's other defaults. `register` adds all
ids, and robo-gym's arithmetic as the flag ``parity`` of the environments.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bam_envs.core.registry import ENVIRONMENTS, Alias, register_alias

_SEED = {"seed": "table_seed"}
BAM_NAMES = {
    "GridWorldEnv-v0": Alias("bam/grid-world-v0"),
    "ClassicBandit-v0": Alias("bam/classic-bandit-v0", options=_SEED),
    "ContextBandit-v0": Alias("bam/context-bandit-v0", options=_SEED),
    "MNISTEnv-v0": Alias("bam/mnist-v0"),
    "GraspXY-v0": Alias("bam/grasp-xy-v0"),
    "ObsEnv-v0": Alias("bam/obs-v0"),
    "GraspXYR-v0": Alias("bam/grasp-xyr-v0"),
}
FORMER_NAMES = {
    "bam/mir100-navigation-v0": Alias("bam/navigation-v0"),
    "bam/mir100-avoidance-v0": Alias("bam/avoidance-v0"),
}
"""Ids from before these tasks were for any base, in checkpoints and in people's commands."""

_UR = {"ur_model": "ur5", "rs_state_to_info": True}
_UR_MODULAR = {"ur_model": "ur5", "rs_state_to_info": False}


@dataclass(frozen=True)
class RoboGymId:
    """One id of robo-gym."""

    stem: str  # the id without ``Sim-v0`` or ``Rob-v0``
    env_id: str  # key of `bam_envs.ENVIRONMENTS`
    is_live: bool  # whether it is the ``Rob-v0`` of the two: the same environment, with a robot
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Task options with other defaults in robo-gym."""

    @property
    def id(self) -> str:
        """Gymnasium's id."""
        return f"{self.stem}{'Rob' if self.is_live else 'Sim'}-v0"

    @property
    def twin(self) -> str:
        """The other id of the two."""
        return f"{self.stem}{'Sim' if self.is_live else 'Rob'}-v0"

    @property
    def variant(self) -> str:
        """`stem`, if it differs from `env_id` by more than the arm and the infos; else empty."""
        return self.stem if self.defaults.keys() - {"ur_model", "rs_state_to_info"} else ""


_STEMS: tuple[tuple[str, str, Mapping[str, Any]], ...] = (
    ("NoObstacleNavigationMir100", "bam/navigation-v0", {}),
    ("ObstacleAvoidanceMir100", "bam/avoidance-v0", {}),
    ("EmptyEnvironmentUR", "bam/ur-empty-v0", _UR),
    ("EndEffectorPositioningUR", "bam/ur-reach-v0", _UR),
    ("BasicAvoidanceUR", "bam/ur-avoidance-v0", _UR),
    ("AvoidanceRaad2022UR", "bam/ur-track-v0", _UR),
    ("AvoidanceRaad2022TestUR", "bam/ur-track-v0", {**_UR, "fixed_paths": True}),
    ("EmptyEnvironment2UR", "bam/ur-empty-v0", _UR_MODULAR),
    ("EndEffectorPositioning2UR", "bam/ur-reach-v0", {**_UR_MODULAR, "modular": True}),
    ("IsaacReachUR", "bam/isaac-reach-v0", {"rs_state_to_info": False}),
)
ROBO_GYM: dict[str, RoboGymId] = {
    entry.id: entry
    for stem, env_id, defaults in _STEMS
    for entry in (RoboGymId(stem, env_id, is_live, defaults) for is_live in (False, True))
}
"""By id, each ``Sim-v0`` followed by its ``Rob-v0``."""

PARITY = {
    "bam/navigation-v0": "bam_envs.robo_gym.parity:Mir100NavigationParity",
    "bam/avoidance-v0": "bam_envs.robo_gym.parity:Mir100AvoidanceParity",
    "bam/ur-reach-v0": "bam_envs.robo_gym.parity:UrReachParity",
    "bam/ur-empty-v0": "bam_envs.robo_gym.parity:UrEmptyParity",
    "bam/ur-avoidance-v0": "bam_envs.robo_gym.parity:UrAvoidanceParity",
    "bam/ur-track-v0": "bam_envs.robo_gym.parity:UrTrackParity",
    "bam/isaac-reach-v0": "bam_envs.robo_gym.parity:IsaacReachParity",
}
"""The task of each environment with ``parity=True``."""


def register() -> None:
    """Add these ids, and the flag ``parity`` to robo-gym's environments; idempotent."""
    for env_id, task in PARITY.items():
        ENVIRONMENTS[env_id].variants["parity"] = task
    for entry in ROBO_GYM.values():
        register_alias(entry.id, Alias(entry.env_id, entry.variant), "bam_envs.robo_gym.making")
    for name, alias in {**BAM_NAMES, **FORMER_NAMES}.items():
        register_alias(name, alias, "bam_envs.make_env", ENVIRONMENTS[alias.env_id].time_limit)
