"""robo-gym's ids, made and stepped."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

import bam_envs
from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.robo_gym.rs_state import MIR_LENGTH, UR_KEYS, require_ur_keys
from bam_envs.robo_gym.table import ROBO_GYM

SIMULATED = [name for name, entry in ROBO_GYM.items() if not entry.is_live]
MODES = {
    "EmptyEnvironmentUR": "only_robot",
    "EmptyEnvironment2UR": "only_robot",
    "BasicAvoidanceUR": "1moving2points",
    "AvoidanceRaad2022UR": "1moving2points",
    "AvoidanceRaad2022TestUR": "1moving2points",
}


SIZES = {
    "NoObstacleNavigationMir100": (4, 2, 500),
    "ObstacleAvoidanceMir100": (20, 2, 500),
    "EmptyEnvironmentUR": (12, 5, 300),
    "EndEffectorPositioningUR": (27, 5, 300),
    "BasicAvoidanceUR": (18, 5, 1000),
    "AvoidanceRaad2022UR": (25, 5, 1000),
    "AvoidanceRaad2022TestUR": (25, 5, 1000),
    "EmptyEnvironment2UR": (12, 5, 300),
    "EndEffectorPositioning2UR": (26, 5, 300),
    "IsaacReachUR": (25, 6, 600),
}
"""robo-gym's numbers of observation and action, and its steps."""


def make(name, **options):
    return gym.make(name, disable_env_checker=True, **options)


def played(env, seed=3, steps=5):
    """Numbers of the first steps of an episode."""
    observation, _ = env.reset(seed=seed)
    found = [observation]
    rng = np.random.default_rng(0)
    for _ in range(steps):
        observation, reward, *_ = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        found += [observation, np.array([reward])]
    return np.concatenate(found)


@pytest.mark.parametrize("name", SIMULATED)
def test_it_is_the_same_environment(name):
    entry = ROBO_GYM[name]
    np.testing.assert_array_equal(played(make(name)), played(make(entry.env_id, **entry.defaults)))


@pytest.mark.parametrize("name", SIMULATED)
@pytest.mark.parametrize("parity", [False, True])
def test_sizes_are_robo_gyms(name, parity):
    env = make(name, parity=parity)
    observation, action, steps = SIZES[ROBO_GYM[name].stem]
    assert (env.observation_space.shape, env.action_space.shape) == ((observation,), (action,))
    assert bam_envs.ENVIRONMENTS[ROBO_GYM[name].env_id].max_episode_steps == steps


@pytest.mark.parametrize("name", SIMULATED)
def test_the_time_limit(name):
    entry = ROBO_GYM[name]
    env = make(name)
    assert env.get_wrapper_attr("_max_episode_steps") == bam_envs.ENVIRONMENTS[entry.env_id].max_episode_steps
    assert "TimeLimit" not in str(make(name, parity=True))


@pytest.mark.parametrize("name", SIMULATED)
def test_wire_states(name):
    env, stem = make(name), ROBO_GYM[name].stem
    assert env.unwrapped.get_rs_state() is None
    env.reset(seed=0)
    _, _, _, _, info = env.step(env.action_space.sample())
    wire = env.unwrapped.get_rs_state()
    if "Mir100" in stem:
        assert [type(wire), len(wire), type(wire[0])] == [list, MIR_LENGTH, float]
    else:
        mode = require_ur_keys(wire)
        assert mode == MODES.get(stem, "1object")
        assert set(wire) == set(UR_KEYS[mode])
        assert {type(value) for value in wire.values()} == {float}
    assert ("rs_state" in info) == ROBO_GYM[name].defaults.get("rs_state_to_info", False)
    assert info.get("rs_state", wire) == wire
    for same in (pickle.loads(pickle.dumps(info)), copy.deepcopy(info)):
        assert same.keys() == info.keys()
        assert same.get("rs_state") == info.get("rs_state")


def test_the_wire_state_after_the_end():
    env = make("EmptyEnvironmentURSim-v0", parity=True)
    env.reset(seed=0)
    terminated = False
    while not terminated:
        _, _, terminated, _, info = env.step(np.zeros(5, dtype=np.float32))
    assert env.unwrapped.get_rs_state() == info["rs_state"]


@pytest.mark.parametrize("name", ["NoObstacleNavigationMir100Sim-v0", "EmptyEnvironmentURSim-v0"])
def test_killing_and_restarting(name):
    env = make(name)
    before = played(env)
    env.unwrapped.kill_sim()
    with pytest.raises(ResetNeeded):
        env.unwrapped.step(env.action_space.sample())
    np.testing.assert_array_equal(played(env), before)
    env.unwrapped.restart_sim()
    with pytest.raises(ResetNeeded):
        env.unwrapped.step(env.action_space.sample())
    np.testing.assert_array_equal(played(env), before)
    env.close()


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("NoObstacleNavigationMir100Rob-v0", {"robot": "ws://127.0.0.1:1"}),
        ("EndEffectorPositioningURRob-v0", {"rs_address": "127.0.0.1:1"}),
        ("EndEffectorPositioningURSim-v0", {"robot": "ws://127.0.0.1:1"}),
    ],
)
def test_a_live_robot_has_no_simulation(name, options):
    """Nothing is connected before the first reset."""
    env = make(name, **options).unwrapped
    assert env.is_live
    for method in (env.kill_sim, env.restart_sim):
        with pytest.raises(InvalidValue) as caught:
            method()
        assert str(caught.value) == (
            "kill_sim(): the robot is live, and there is no simulation to end; close() drops the link."
        )


@pytest.mark.parametrize("name", SIMULATED)
def test_rows(name):
    env = gym.make_vec(name, num_envs=3)
    observations, _ = env.reset(seed=3)
    assert observations.shape == (3, *make(name).observation_space.shape)
    np.testing.assert_array_equal(observations[1], make(name).reset(seed=4)[0])
    assert "rs_state" not in env.step(env.action_space.sample())[4]
    env.close()


def test_rows_with_wire_states():
    env = gym.make_vec("EmptyEnvironmentURSim-v0", num_envs=2, rs_state_to_info=True)
    env.reset(seed=0)
    infos = env.step(env.action_space.sample())[4]
    assert [len(wire) for wire in infos["rs_state"]] == [20, 20]


def test_rows_have_a_limit_of_their_own():
    env = gym.make_vec("EmptyEnvironmentURSim-v0", num_envs=2, max_episode_steps=7)
    assert env.max_episode_steps == 7
    assert gym.make_vec("EmptyEnvironmentURSim-v0", num_envs=2).max_episode_steps == 300
    assert gym.make_vec("EmptyEnvironmentURSim-v0", num_envs=2, parity=True).max_episode_steps is None


def test_a_live_robot_is_no_rows():
    with pytest.raises(InvalidValue) as caught:
        gym.make_vec("EmptyEnvironmentURRob-v0", num_envs=2, robot="ws://127.0.0.1:1")
    assert str(caught.value) == (
        "EmptyEnvironmentURRob-v0: a live robot is one environment, which nothing may reset unasked; "
        "use gymnasium.make."
    )


def test_reset_options():
    base = make("NoObstacleNavigationMir100Sim-v0")
    base.reset(options={"start_pose": [1.0, 0.0, 0.5], "target_pose": [-1.0, 0.5, 0.0]})
    np.testing.assert_allclose(base.unwrapped.get_rs_state()[:6], [-1.0, 0.5, 0.0, 1.0, 0.0, 0.5])
    arm = make("EndEffectorPositioningURSim-v0")
    joints = [0.1, -2.0, 1.0, -1.0, -1.4, 0.2]
    arm.reset(options={"joint_positions": joints, "ee_target_pose": [0.3, 0.2, 0.4, 0, 0, 0]})
    wire = arm.unwrapped.get_rs_state()
    assert [wire[f"{name}_joint_position"] for name in ("base", "shoulder", "elbow", "wrist_1")] == joints[:4]
    assert [wire[f"object_0_to_ref_translation_{axis}"] for axis in "xyz"] == [0.3, 0.2, 0.4]


def test_a_robot_without_an_address_is_none():
    with pytest.raises(InvalidValue, match="A live robot's address is ws://host:port"):
        make("EndEffectorPositioningURRob-v0", robot="")
