"""robo-gym's ids, made and stepped."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

import bam_envs
from bam_envs.aliases import ROBO_GYM
from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.robo_gym.rs_state import MIR_LENGTH, UR_KEYS

SIMULATED = [name for name, entry in ROBO_GYM.items() if not entry.is_live]
SIZES = {
    "NoObstacleNavigationMir100": (4, 2, 500, None),
    "ObstacleAvoidanceMir100": (20, 2, 500, None),
    "EmptyEnvironmentUR": (12, 5, 300, "only_robot"),
    "EndEffectorPositioningUR": (27, 5, 300, "1object"),
    "BasicAvoidanceUR": (18, 5, 1000, "1moving2points"),
    "AvoidanceRaad2022UR": (25, 5, 1000, "1moving2points"),
    "AvoidanceRaad2022TestUR": (25, 5, 1000, "1moving2points"),
    "EmptyEnvironment2UR": (12, 5, 300, "only_robot"),
    "EndEffectorPositioning2UR": (26, 5, 300, "1object"),
    "IsaacReachUR": (25, 6, 600, "1object"),
}
"""robo-gym's numbers of observation and action, its steps, and which keys a wire state of an arm has."""


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
def test_it_is_the_same_environment_with_robo_gyms_sizes(name):
    entry = ROBO_GYM[name]
    env, own, parity = make(name), make(entry.env_id, **entry.defaults), make(name, parity=True)
    np.testing.assert_array_equal(played(env), played(own))
    observation, action, steps, _ = SIZES[entry.stem]
    for one in (env, parity):
        assert (one.observation_space.shape, one.action_space.shape) == ((observation,), (action,))
    assert env.get_wrapper_attr("_max_episode_steps") == bam_envs.ENVIRONMENTS[entry.env_id].max_episode_steps == steps
    assert "TimeLimit" not in str(parity)


@pytest.mark.parametrize("name", SIMULATED)
def test_wire_states(name):
    env, keys = make(name), UR_KEYS.get(SIZES[ROBO_GYM[name].stem][3])
    assert env.unwrapped.get_rs_state() is None
    env.reset(seed=0)
    info = env.step(env.action_space.sample())[4]
    wire = env.unwrapped.get_rs_state()
    if keys is None:
        assert [type(wire), len(wire), {type(number) for number in wire}] == [list, MIR_LENGTH, {float}]
    else:
        assert set(wire) == set(keys)
        assert {type(value) for value in wire.values()} == {float}
    assert ("rs_state" in info) == ROBO_GYM[name].defaults.get("rs_state_to_info", False)
    assert info.get("rs_state", wire) == wire
    for same in (pickle.loads(pickle.dumps(info)), copy.deepcopy(info)):
        assert (same.keys(), same.get("rs_state")) == (info.keys(), info.get("rs_state"))


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
def test_vector_environments(name):
    env = gym.make_vec(name, num_envs=3)
    observations, _ = env.reset(seed=3)
    assert observations.shape == (3, *make(name).observation_space.shape)
    np.testing.assert_array_equal(observations[1], make(name).reset(seed=4)[0])
    assert "rs_state" not in env.step(env.action_space.sample())[4]
    env.close()


def test_options_of_vector_environments():
    env = gym.make_vec("EmptyEnvironmentURSim-v0", num_envs=2, rs_state_to_info=True, max_episode_steps=7)
    env.reset(seed=0)
    infos = env.step(env.action_space.sample())[4]
    assert [len(wire) for wire in infos["rs_state"]] == [20, 20]
    assert env.max_episode_steps == 7
    assert gym.make_vec("EmptyEnvironmentURSim-v0", num_envs=2).max_episode_steps == 300
    assert gym.make_vec("EmptyEnvironmentURSim-v0", num_envs=2, parity=True).max_episode_steps is None


def test_a_live_robot_is_no_vector_environment():
    with pytest.raises(InvalidValue) as caught:
        gym.make_vec("EmptyEnvironmentURRob-v0", num_envs=2, robot="ws://127.0.0.1:1")
    assert str(caught.value) == (
        "EmptyEnvironmentURRob-v0: a live robot is one environment, which nothing may reset unasked; "
        "use gymnasium.make."
    )


def test_a_robot_without_an_address_is_none():
    with pytest.raises(InvalidValue, match="A live robot's address is ws://host:port"):
        make("EndEffectorPositioningURRob-v0", robot="")
