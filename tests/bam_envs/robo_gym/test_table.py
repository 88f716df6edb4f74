import subprocess
import sys

import gymnasium as gym
import pytest

from bam_envs import ENVIRONMENTS
from bam_envs.aliases import ROBO_GYM
from bam_envs.core.registry import are_same, entry_of, resolve_id

STEMS = {
    "NoObstacleNavigationMir100": "bam/navigation-v0",
    "ObstacleAvoidanceMir100": "bam/avoidance-v0",
    "EmptyEnvironmentUR": "bam/ur-empty-v0",
    "EndEffectorPositioningUR": "bam/ur-reach-v0",
    "BasicAvoidanceUR": "bam/ur-avoidance-v0",
    "AvoidanceRaad2022UR": "bam/ur-track-v0",
    "AvoidanceRaad2022TestUR": "bam/ur-track-v0",
    "EmptyEnvironment2UR": "bam/ur-empty-v0",
    "EndEffectorPositioning2UR": "bam/ur-reach-v0",
    "IsaacReachUR": "bam/isaac-reach-v0",
}


def test_the_ids():
    assert list(ROBO_GYM) == [f"{stem}{kind}-v0" for stem in STEMS for kind in ("Sim", "Rob")]
    for name, entry in ROBO_GYM.items():
        assert (entry.id, entry.env_id) == (name, STEMS[entry.stem])
        assert ROBO_GYM[entry.twin].twin == name
        assert entry.is_live == name.endswith("Rob-v0")


@pytest.mark.parametrize("name", ROBO_GYM)
def test_every_id_is_registered_and_is_one_of_ours(name):
    assert gym.spec(name).max_episode_steps is None
    assert entry_of(name) is ENVIRONMENTS[ROBO_GYM[name].env_id]
    assert resolve_id(name.removesuffix("-v0")) == name
    assert entry_of(f"bam_envs:{name}") is entry_of(name)


def test_the_ids_cost_nothing():
    """Importing bam_envs registers them; their modules are imported when one is made."""
    code = """
import sys, bam_envs
print(sorted(name for name in sys.modules if name.startswith("bam_envs.")))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    core = ("env_options", "errors", "location", "registry", "robot", "validation", "wording")
    modules = ["aliases", "core", *(f"core.{name}" for name in core)]
    assert done.stdout.strip() == str([f"bam_envs.{name}" for name in modules])


def test_two_names_of_one_environment_are_the_same():
    assert are_same("bam/navigation-v0", "NoObstacleNavigationMir100Sim-v0")
    assert are_same("EndEffectorPositioningURRob-v0", "EndEffectorPositioningURSim-v0")
    assert are_same("CartPole-v1", "CartPole-v1")
    assert not are_same("CartPole-v1", "Pendulum-v1")
    assert not are_same("bam/navigation-v0", "bam/avoidance-v0")
    assert not are_same("AvoidanceRaad2022URSim-v0", "AvoidanceRaad2022TestURSim-v0")
    assert are_same("AvoidanceRaad2022TestURRob-v0", "AvoidanceRaad2022TestURSim-v0")
    assert not are_same("EndEffectorPositioning2URSim-v0", "bam/ur-reach-v0")
