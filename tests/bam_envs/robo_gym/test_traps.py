"""Thirteen things that one gets wrong when one writes robo-gym's environments anew, each with its numbers."""

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.robo_gym.parity_bases import BEAMS
from bam_envs.robots.ur import ur_model

STAY = np.zeros(5, np.float32)


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


@pytest.fixture
def reach():
    env = make("EndEffectorPositioningURSim-v0")
    env.reset(seed=0)
    return env


def test_1_the_reward_of_an_end_replaces_the_steps(base):
    total = [base.step(np.array([1.0, 0.0], np.float32)) for _ in range(27)]
    assert [step[1] for step in total if step[2]] == [200.0]
    assert total[-1][4]["final_status"] == "success"


def test_2_the_first_step_is_not_shaped(base):
    assert base.step(np.array([1.0, -0.5], np.float32))[1] == pytest.approx(-0.30 - 0.015, abs=1e-7)


def test_3_power_is_charged_for_the_raw_action(base):
    before = base.step(np.array([0.5, -0.5], np.float32))[4]["distance"]
    _, reward, _, _, info = base.step(np.array([0.5, -0.5], np.float32))
    assert reward == pytest.approx(50 * (before - info["distance"]) - 0.15 - 0.015, abs=1e-6)


def test_4_the_observed_action_is_one_step_old(reach):
    first, second = np.full(5, 0.1, np.float32), np.full(5, 0.2, np.float32)
    assert reach.step(first)[0][21:].tolist() == [0.0] * 6
    np.testing.assert_allclose(reach.step(second)[0][21:], [*first, 0.0])
    np.testing.assert_allclose(reach.step(first)[0][21:], [*second, 0.0])


def test_5_wrist_1_goes_from_minus_348_to_031(reach):
    for aim, share in ((-1.0, -3.48), (1.0, 0.31)):
        reach.reset(seed=0)
        action = (joints(reach) / ur_model("ur5").joint_limits[1])[:5].astype(np.float32)
        action[3] = aim
        before = joints(reach)[3]
        reach.step(action)
        assert joints(reach)[3] - before == pytest.approx(np.sign(share - before) * 0.1 * np.pi * 0.1, abs=1e-6)
    reach.reset(seed=0)
    action[3] = 2 * (-1.5 + 3.48) / (0.31 + 3.48) - 1
    reach.step(action)
    assert joints(reach)[3] == pytest.approx(-1.5, abs=1e-6)


def test_6_spherical_is_distance_polar_azimuth(reach):
    wire = reach.get_rs_state()
    r, polar, azimuth = reach.task.observe(reach.last_state)[0, :3]
    flange = np.array([wire[f"ee_to_ref_translation_{axis}"] for axis in "xyz"])
    x, y, z, w = (wire[f"ee_to_ref_rotation_{axis}"] for axis in "xyzw")
    axes = np.array(  # columns are the flange's axes in the base
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    seen = axes.T @ (reach.task.target[0] - flange)
    told = r * np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    np.testing.assert_allclose(told, seen, atol=1e-6)


def test_7_the_base_is_the_first_joint():
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
def test_8_the_time_limit_terminates_and_has_a_status(name, steps, status, options):
    env = gym.make(name, parity=True, disable_env_checker=True, rs_state_to_info=False)
    env.reset(seed=0, options=options)
    inner = env.unwrapped
    action = np.zeros(env.action_space.shape, np.float32)
    if name.startswith("E"):
        action = (joints(inner) / ur_model("ur5").joint_limits[1])[:5].astype(np.float32)
    if name.startswith("EndEff"):
        action[3] = 2 * (-1.5 + 3.48) / (0.31 + 3.48) - 1
    for step in range(1, steps + 1):
        _, _, terminated, truncated, info = env.step(action)
        assert (terminated, truncated) == (step == steps, False)
    assert info["final_status"] == status


@pytest.mark.parametrize(
    ("name", "steps", "status"),
    [
        ("EmptyEnvironmentURSim-v0", 300, "max_steps_exceeded"),
        ("EndEffectorPositioningURSim-v0", 300, "max_steps_exceeded"),
        ("BasicAvoidanceURSim-v0", 1000, "success"),
        ("NoObstacleNavigationMir100Sim-v0", 500, "max_steps_exceeded"),
    ],
)
def test_8_by_default_it_truncates_and_says_so(name, steps, status):
    options = {"ee_target_pose": [0.0, -0.4, 0.6, 0, 0, 0]} if name.startswith("EndEff") else {}
    options |= {"fixed_object_position": [0.5, 0.6, 0.9]} if name.startswith("Basic") else {}
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


def test_9_actions_of_avoidances_are_offsets_in_radians():
    env = make("BasicAvoidanceURSim-v0")
    env.reset(seed=0)
    before = joints(env).copy()
    env.step(np.array([0.1, 0.0, -0.2, 0.0, 0.0], np.float32))
    np.testing.assert_allclose(joints(env) - before, [0.01, 0, -0.02, 0, 0, 0], atol=1e-7)


def test_10_sixteen_rays_by_their_index():
    assert BEAMS.tolist() == [0, 67, 135, 202, 270, 337, 404, 472, 539, 607, 674, 741, 809, 876, 944, 1011]
    env = make("ObstacleAvoidanceMir100Sim-v0")
    observation, _ = env.reset(seed=0)
    scans = np.array(env.get_rs_state()[8:1020])
    np.testing.assert_array_equal(observation[4:], scans[BEAMS].astype(np.float32))


@pytest.mark.parametrize(
    ("name", "scale", "rate", "options"),
    [
        ("EmptyEnvironmentURSim-v0", 0.2, 20, {}),
        ("EndEffectorPositioningURSim-v0", 0.1, 10, {"restrict_wrist_1": False}),
    ],
)
def test_11_a_way_takes_half_a_second_at_least(name, scale, rate, options):
    env = make(name, **options)
    for offset in (0.05, 0.5):
        env.reset(seed=0)
        before = joints(env).copy()
        action = (before / ur_model("ur5").joint_limits[1])[:5].astype(np.float32)
        action[0] = offset / (2 * np.pi)
        env.step(action)
        takes = max(offset / (scale * np.pi), 0.5)
        assert joints(env)[0] - before[0] == pytest.approx(offset / takes / rate, abs=1e-6)


def test_12_a_live_base_never_fails():
    env = make("ObstacleAvoidanceMir100Sim-v0")
    env.reset(seed=0)
    state = env.last_state
    state.signals["f_scan"] = np.full_like(state.signals["f_scan"], 0.1)
    action = np.zeros((1, 2), np.float32)
    assert env.task.score(state, action).terminated.tolist() == [True]
    state.truth.clear()
    assert env.task.score(state, action).terminated.tolist() == [False]


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
def test_13_keys_of_infos(name, keys):
    env = make(name)
    env.reset(seed=0)
    assert keys <= env.step(np.zeros(env.action_space.shape, np.float32))[4].keys()
