"""How fast the simulated robot really moves: never faster than a robot near people may."""

import numpy as np
import pytest

from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.tasks.scripted import SCRIPTED, scripted_policy
from tests.bam_envs.making import ROBOTS, each

TOOL_SPEED, JOINT_SPEED = 0.25, 1.0
"""Limits [m/s] and [rad/s]."""
SLACK = 1.005
"""Position control follows its set point to within this factor."""


BASES = ("bam/avoidance-v0", "bam/navigation-v0")
DRIVEN = (0.5, 0.7)
"""Speeds forward [m/s] and of turning [rad/s] that the tasks of a base ask for; where bases differ, 5 % more."""
SHARES = {
    "bam/ur-reach-v0": 0.1,
    "bam/ur-empty-v0": 0.2,
    "bam/ur-avoidance-v0": 0.2,
    "bam/ur-track-v0": 0.2,
    "bam/isaac-reach-v0": 0.2,
}
"""Of the fastest speed of an arm's joints, that robo-gym's trajectory controllers let them have."""


def limits(env_id, envs):
    """The signal with the robot's speeds, and how fast each may be."""
    if env_id in SHARES:
        return "joint_velocity", SHARES[env_id] * envs.unwrapped.task.model.max_velocity
    return ("base_velocity", np.array(DRIVEN)) if env_id in BASES else ("joint_velocity", JOINT_SPEED)


@pytest.mark.parametrize("env_id", each(one for one in ROBOTS if one not in SCRIPTED))
@pytest.mark.parametrize("randomize", [False, True])
def test_no_robot_is_faster_than_its_task_lets_it_be(make_rows, env_id, randomize):
    """The others, tool and joints, are measured below."""
    envs = make_rows(env_id, 16, randomize=randomize)
    envs.reset(seed=0)
    signal, fastest = limits(env_id, envs)
    slack, rng = 1.05 if env_id in BASES and randomize else SLACK, np.random.default_rng(0)
    seen = 0.0
    for step in range(60):
        if step % 10 == 0:
            action = rng.uniform(-2, 2, envs.action_space.shape).clip(-1, 1).astype(np.float32)
        envs.step(action)
        seen = max(seen, (np.abs(envs.unwrapped.state.signals[signal]) / fastest).max())
    assert (0.49 if env_id == "bam/joints-v0" else 0.5) < seen <= slack


@pytest.mark.parametrize("env_id", each(SCRIPTED))
@pytest.mark.parametrize("randomize", [False, True])
@pytest.mark.parametrize("actions", ["random", "scripted"])
def test_measured_speeds(make_rows, env_id, randomize, actions):
    envs = make_rows(env_id, 16, randomize=randomize)
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


SLOW = [0.048**2 * 5.2] * 4 + [0.02304] * 3
"""Greatest change of a step of a Gen3 [rad], whose large joints gain 5.2 rad/s^2."""


@pytest.mark.parametrize(
    ("env_id", "options", "change"),
    [*((one, {}, 0.02304) for one in SCRIPTED), ("bam/pick-v0", {"robot_model": "gen3"}, SLOW)],
)
def test_commands_keep_to_speed_and_acceleration_whatever_the_actions(make_rows, env_id, options, change):
    """To the limit for half a second each way, into the table and into the cube; then the guards change nothing."""
    envs = make_rows(env_id, 16, **options)
    envs.reset(seed=0)
    robot, rng = envs.unwrapped.robot, np.random.default_rng(0)
    tool_position, last = robot.tool_position, np.zeros((16, robot.description.num_joints))
    fastest = changed = 0.0
    for step in range(200):
        if step % 10 == 0:
            action = np.sign(rng.uniform(-1, 1, envs.action_space.shape)).astype(np.float32)
        state = envs.unwrapped.state
        before, width = state.command, state.signals["gripper_width"][:, 0]
        _, _, terminated, truncated, _ = envs.step(action)
        running = ~(terminated | truncated)  # the others are at the start of their next episode
        after = envs.unwrapped.state.command
        turn = np.where(running[:, None], (after - before)[:, :-1], 0.0)
        tool = np.linalg.norm(tool_position(before[:, :-1] + turn) - tool_position(before[:, :-1]), axis=1)
        fastest = max(fastest, np.abs(turn).max())
        changed = max(changed, (np.abs(turn - last)[running] / change).max(initial=0.0))
        last = turn
        assert tool.max() <= 0.0125
        ahead = np.maximum(
            after[:, -1] - np.maximum(before[:, -1], width), np.minimum(before[:, -1], width) - after[:, -1]
        )
        assert ahead[running].max(initial=0.0) <= 0.96 * 0.05 * robot.description.gripper.speed * (1 + 1e-9)
    assert (fastest, changed) == (pytest.approx(0.02304), pytest.approx(1.0))
