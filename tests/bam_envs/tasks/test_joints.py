"""bam/joints: positions of joints are followed as fast as the arm may move, and no lower than its work area."""

import re

import gymnasium as gym
import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers
from bam_envs.core.errors import InvalidValue


@pytest.fixture(params=[{}, {"rate": 30.0}, {"rate": 8}], ids=str)
def env(request):
    env = gym.make("bam/joints-v0", robot_model="so101", **request.param)
    yield env.unwrapped
    env.close()


def test_positions_are_reached_within_the_steps_that_are_followed(env):
    seen, _ = env.reset(seed=0)
    goal = seen + np.array([0.4, 0.1, -0.1, 0.1, 0.2, -0.03], np.float32)
    sent = [env.state.command[0].copy()]
    for _ in range(90):
        seen, reward, terminated, *_ = env.step(goal)
        sent.append(env.state.command[0].copy())
        assert (reward, terminated) == (0.0, False)
    assert env.state.stamp == pytest.approx(90 * env.period)
    np.testing.assert_allclose(seen, goal, atol=1e-3)
    most = env.robot.spec.command.max_rate
    assert (np.abs(np.diff(sent, axis=0)) <= np.multiply(most, env.period)).all()
    assert (np.abs(np.diff(sent, axis=0)) <= env.task.action_step * (1 + 1e-9)).all()


def test_the_tool_stays_above_the_lower_end_of_the_work_area(env):
    env.reset(seed=0)
    down = env.action_space.high.copy()  # every joint as far as it goes
    for _ in range(200):
        env.step(down)
    tool = env.task.arm.tool_position(env.state.command[:, :-1])
    assert tool[0, 2] >= env.task.space.box[0, 2] - 1e-6


def test_whether_an_episode_succeeded_is_not_known(make_rows):
    rows = make_rows("bam/joints-v0", 2, robot_model="so101", max_episode_steps=2)
    infos = [rows.reset(seed=0)[1]]
    infos += [rows.step(np.zeros((2, 6), np.float32))[-1] for _ in range(3)]
    infos.append(infos[2]["final_info"])
    assert [info["_is_success"].tolist() for info in infos] == [[False, False]] * 5


@pytest.mark.parametrize(("rate", "found"), [(4, "4"), (1000.0, "1000.0"), ("30", "'30'")])
def test_a_rate_that_no_arm_takes_is_refused(rate, found):
    with pytest.raises(InvalidValue, match=re.escape(f"found {found}") + "$|must be a number, not '30'"):
        gym.make("bam/joints-v0", rate=rate)
