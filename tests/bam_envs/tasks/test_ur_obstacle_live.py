"""The arms with a moving obstacle, and Isaac's reach, as live robots: their simulated twins, served."""

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment

ENVIRONMENTS = ("bam/ur-avoidance-v0", "bam/ur-track-v0", "bam/isaac-reach-v0")


@pytest.fixture
def served():
    """Serve an environment; a live twin of it, connected when it is reset."""
    opened = []

    def start(env_id, *, fast=True, **options):
        env = gym.make(env_id, disable_env_checker=True)
        opened.append(ServedEnvironment(env, ServeOptions(port=0, fast=fast), lambda line: None))
        server = opened[-1].__enter__()
        opened.append(gym.make(env_id, robot=server.bus.url, disable_env_checker=True, **options))
        return opened[-1]

    yield start
    for one in reversed(opened):
        one.close()


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_live(served, env_id):
    env = served(env_id, fast=False)
    observation, _ = env.reset(seed=0)
    space, still = env.observation_space, np.zeros(env.action_space.shape, np.float32)
    seen = [observation]
    for _ in range(15):
        observation, reward, terminated, truncated, info = env.step(still)
        assert not terminated
        assert not truncated
        assert np.isfinite(reward)
        assert "final_status" not in info
        seen.append(observation)
    assert all(space.contains(one) for one in seen)
    if "isaac" not in env_id:  # the obstacle goes on by itself, wherever its tracker sees it
        assert len({tuple(one[:3]) for one in seen}) > 5


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_a_live_arm_goes_where_the_simulated_one_goes(served, make, env_id):
    """With set points from where it is measured, in lockstep."""
    live, simulated = served(env_id, rs_state_to_info=True), make(env_id, rs_state_to_info=True)
    joints = []
    for env in (live, simulated):
        env.reset(seed=0)
        small = 0.01 if "isaac" in env_id else 0.05  # the tool stays slower than the guards let it be
        action = np.full(env.action_space.shape, small, np.float32)
        states = [env.step(action)[4]["rs_state"] for _ in range(10)]
        joints.append([[value for key, value in one.items() if key.endswith("joint_position")] for one in states])
        assert all(one["in_collision"] == 0.0 for one in states)
    np.testing.assert_allclose(joints[0], joints[1], atol=0.002)  # the start is reached to within a guard's tolerance
    assert np.abs(np.ptp(joints[1], axis=0)).max() > 0.01
