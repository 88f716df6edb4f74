"""How fast the simulated robot really moves: never faster than a robot near people may."""

import numpy as np
import pytest

import bam_envs
from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.scripted import scripted_policy

TOOL_SPEED, JOINT_SPEED = 0.25, 1.0
"""Limits [m/s] and [rad/s]."""
SLACK = 1.005
"""Position control follows its set point to within this factor."""


@pytest.mark.parametrize("env_id", bam_envs.ENVIRONMENTS)
@pytest.mark.parametrize("randomize", [False, True])
@pytest.mark.parametrize("actions", ["random", "scripted"])
def test_measured_speeds(make_rows, env_id, randomize, actions):
    envs = make_rows(env_id, 32, randomize=randomize)
    observation, _ = envs.reset(seed=0)
    envs.action_space.seed(0)
    policy = scripted_policy(env_id)
    tool_speed = joint_speed = 0.0
    for _ in range(100):
        before = envs.unwrapped.state.signals["joint_position"].copy()
        action = envs.action_space.sample() if actions == "random" else policy.act_batch(observation)
        observation, _, terminated, truncated, _ = envs.step(action)
        state = envs.unwrapped.state.signals
        running = ~(terminated | truncated)  # the others are at the start of their next episode
        step = GEOMETRY.tool_position(state["joint_position"]) - GEOMETRY.tool_position(before)
        tool_speed = max(tool_speed, np.linalg.norm(step[running], axis=1).max(initial=0.0) / 0.05)
        joint_speed = max(joint_speed, np.abs(state["joint_velocity"][running]).max(initial=0.0))
    assert 0.1 < tool_speed <= TOOL_SPEED * SLACK
    assert 0.1 < joint_speed <= JOINT_SPEED * SLACK


@pytest.mark.parametrize("env_id", bam_envs.ENVIRONMENTS)
def test_commanded_speeds_whatever_the_actions(make_rows, env_id):
    """To the limit for half a second each way, into the table and into the cube."""
    envs = make_rows(env_id, 32)
    envs.reset(seed=0)
    rng = np.random.default_rng(0)
    for step in range(300):
        if step % 10 == 0:
            action = np.sign(rng.uniform(-1, 1, envs.action_space.shape)).astype(np.float32)
        before = envs.unwrapped.state.command[:, :6]
        _, _, terminated, truncated, _ = envs.step(action)
        running = ~(terminated | truncated)
        after = envs.unwrapped.state.command[:, :6]
        tool = np.linalg.norm(GEOMETRY.tool_position(after) - GEOMETRY.tool_position(before), axis=1)
        assert np.abs(after - before)[running].max(initial=0.0) <= 0.05 * (1 + 1e-9)
        assert tool[running].max(initial=0.0) <= 0.0125 * (1 + 1e-9)
