"""A UR arm and nothing to do."""

import numpy as np
import pytest

STILL = np.array([0.0, -2.5, 1.5, 0.0, -1.4]) / [2 * np.pi, 2 * np.pi, np.pi, 2 * np.pi, 2 * np.pi]
INTO_THE_TABLE = np.array([0.0, 0.1, 0.0, 0.0, 0.0], np.float32)


def test_the_observation_in_parity(make):
    env = make("bam/ur-empty-v0", parity=True)
    observation, _ = env.reset(seed=0)
    np.testing.assert_allclose(observation[:5], STILL, rtol=1e-6)
    np.testing.assert_array_equal(observation[5:], np.zeros(7))
    assert env.observation_space.high.tolist() == [np.float32(1.1)] * 6 + [np.inf] * 6
    observation, *_ = env.step(np.array([1, 0, 0, 0, 0], np.float32))
    step = 0.2 * np.pi * 0.05
    assert observation[0] == pytest.approx(step / (2 * np.pi))
    assert observation[6] == pytest.approx(0.2 * np.pi)


def test_speeds_are_scaled_otherwise(make):
    env = make("bam/ur-empty-v0")
    env.reset(seed=0)
    observation, *_ = env.step(np.array([1, 0, 0, 0, 0], np.float32))
    assert observation[6] == pytest.approx(1.0)


def test_a_collision_ends_it(make):
    env = make("bam/ur-empty-v0", rs_state_to_info=True)
    env.reset(options={"joint_positions": [0.0, -0.5, 0.0, 0.0, 0.0, 0.0]})
    while True:
        _, reward, terminated, truncated, info = env.step(INTO_THE_TABLE)
        if terminated or truncated:
            break
        assert info["rs_state"]["in_collision"] == 0.0
        assert "final_status" not in info
    assert (reward, terminated) == (0.0, True)
    assert info["final_status"] == "collision"
    assert info["rs_state"]["in_collision"] == 1.0
    assert len(info["rs_state"]) == 20


def test_fixed_joints_stay(make):
    env = make("bam/ur-empty-v0", fix_base=True, fix_wrist_3=False, fix_elbow=True)
    assert env.action_space.shape == (4,)
    start = [0.3, -2.0, 1.4, 0.1, -1.4, 0.2]
    env.reset(options={"joint_positions": start})
    for _ in range(20):
        env.step(np.array([-0.3, 0.1, 0.1, 0.1], np.float32))
    joints = env.unwrapped.state.signals["joint_position"][0]
    np.testing.assert_allclose(joints[[0, 2]], [0.3, 1.4], atol=1e-12)
    assert np.abs(joints - start)[[1, 3, 4, 5]].min() > 0.03
