"""What one gets wrong when one writes robo-gym's environments anew, beside what the tests of the tasks have."""

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.robots.ur import ur_model


def make(name, **options):
    return gym.make(name, parity=True, disable_env_checker=True, **options).unwrapped


def joints(env):
    return env.last_state.signals["joint_position"][0]


@pytest.fixture
def base():
    """A base that looks at a target 1.5 m ahead."""
    env = make("NoObstacleNavigationMir100Sim-v0")
    env.reset(seed=0, options={"start_pose": [0.0, 0.0, 0.0], "target_pose": [1.5, 0.0, 0.0]})
    return env


def test_the_reward_of_an_end_replaces_the_steps(base):
    total = [base.step(np.array([1.0, 0.0], np.float32)) for _ in range(27)]
    assert [step[1] for step in total if step[2]] == [200.0]
    assert total[-1][4]["final_status"] == "success"


def test_the_base_is_the_first_joint():
    env = make("EmptyEnvironmentURSim-v0")
    observation, _ = env.reset(seed=0, options={"joint_positions": [0.3, -2.5, 1.5, 0.1, -1.4, 0.2]})
    assert env.get_rs_state()["base_joint_position"] == 0.3
    np.testing.assert_allclose(observation[[0, 2]], [0.3 / (2 * np.pi), 1.5 / np.pi], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "steps", "status", "options"),
    [
        ("EmptyEnvironmentURSim-v0", 300, "success", {}),
        ("EndEffectorPositioningURSim-v0", 300, "max_steps_exceeded", {"ee_target_pose": [0.0, -0.4, 0.6, 0, 0, 0]}),
        ("BasicAvoidanceURSim-v0", 1000, "success", {"fixed_object_position": [0.5, 0.6, 0.9]}),
        ("AvoidanceRaad2022URSim-v0", 1000, "success", {"fixed_object_position": [0.9, 0.9, 0.95]}),
        ("NoObstacleNavigationMir100Sim-v0", 500, "max_steps_exceeded", {}),
        ("ObstacleAvoidanceMir100Sim-v0", 500, "max_steps_exceeded", {}),
    ],
)
def test_the_time_limit_terminates_and_has_a_status(name, steps, status, options):
    env = make(name, rs_state_to_info=False)
    env.reset(seed=0, options=options)
    action = np.zeros(env.action_space.shape, np.float32)
    if name.startswith("E"):
        action = (joints(env) / ur_model("ur5").joint_limits[1])[:5].astype(np.float32)
    if name.startswith("EndEff"):
        action[3] = 2 * (-1.5 + 3.48) / (0.31 + 3.48) - 1
    env.task.elapsed[:] = steps - 3
    for step in range(3):
        _, _, terminated, truncated, info = env.step(action)
        assert (terminated, truncated) == (step == 2, False)
    assert info["final_status"] == status


@pytest.mark.parametrize(
    ("name", "steps", "status"),
    [
        ("EndEffectorPositioningURSim-v0", 300, "max_steps_exceeded"),
        ("NoObstacleNavigationMir100Sim-v0", 500, "max_steps_exceeded"),
    ],
)
def test_by_default_the_time_limit_truncates_and_says_so(name, steps, status):
    options = {"ee_target_pose": [0.0, -0.4, 0.6, 0, 0, 0]} if name.startswith("EndEff") else {}
    env = gym.make(name, disable_env_checker=True, rs_state_to_info=False)
    rows = gym.make_vec(name, num_envs=2, rs_state_to_info=False)
    env.reset(seed=0, options=options)
    rows.reset(seed=0, options=options)
    action = np.zeros(env.action_space.shape, np.float32)
    if name.startswith("E"):
        action = (joints(env.unwrapped) / ur_model("ur5").joint_limits[1])[:5].astype(np.float32)
        action[3] = 2 * (-1.5 + 3.48) / (0.31 + 3.48) - 1 if name.startswith("EndEff") else action[3]
    for step in range(1, steps + 1):
        _, _, terminated, truncated, info = env.step(action)
        *_, ended, infos = rows.step(np.stack([action, action]))
        assert (terminated, truncated, ended.tolist()) == (False, step == steps, [step == steps] * 2)
        assert ("final_status" in info) == (step == steps)
    assert info["final_status"] == status
    assert infos["final_info"]["final_status"].tolist() == [status] * 2
    assert infos["final_info"]["_final_status"].tolist() == [True, True]


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("EndEffectorPositioningURSim-v0", {"target_coord"}),
        ("BasicAvoidanceURSim-v0", {"target_coord"}),
        ("AvoidanceRaad2022URSim-v0", {"targets_reached"}),
        ("IsaacReachURSim-v0", {"dist_coord", "dist_rot"}),
        ("NoObstacleNavigationMir100Sim-v0", set()),
    ],
)
def test_keys_of_infos(name, keys):
    env = make(name)
    env.reset(seed=0)
    assert keys <= env.step(np.zeros(env.action_space.shape, np.float32))[4].keys()
