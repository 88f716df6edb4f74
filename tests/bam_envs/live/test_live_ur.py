"""UR arms behind the embedded rosbridge server: the same environments, with the shipped profile."""

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur import UR_MODELS
from bam_envs.safety.arm_guards import ToolSpeed

ACTION = np.array([0.3, -0.4, 0.4, 0.1, -0.2], np.float32)


@pytest.fixture
def served():
    """Serve an environment; its URL."""
    running = []

    def serve(env_id, ur_model="ur5e", **options):
        env = gym.make(env_id, disable_env_checker=True, ur_model=ur_model)
        running.append(ServedEnvironment(env, ServeOptions(port=0, **options)))
        return running[-1].__enter__().bus.url

    yield serve
    for one in running:
        one.close()


def episode(env, steps):
    """The last result and the measured joints after `steps`."""
    env.reset(seed=1)
    for _ in range(steps):
        result = env.step(ACTION)
    return result, env.unwrapped.state.signals["joint_position"][0]


def trouble(env):
    """The guards that changed or stopped something, and how often."""
    report = env.unwrapped.robot.report()
    return {name: row["altered"] + row["stopped"] for name, row in report.items() if row["altered"] or row["stopped"]}


@pytest.mark.parametrize("model", ["ur5e", "ur3"])
def test_reach_in_lockstep_is_the_simulation(served, make, model):
    url = served("bam/ur-reach-v0", model, fast=True)
    live = make("bam/ur-reach-v0", robot=url, ur_model=model)
    here = make("bam/ur-reach-v0", ur_model=model)
    live.reset(seed=1)
    here.reset(seed=1)
    for _ in range(20):
        one, other = live.step(ACTION), here.step(ACTION)
        np.testing.assert_allclose(one[0], other[0], atol=1e-6)
        assert one[1] == pytest.approx(other[1], abs=1e-9)
        assert one[2:4] == other[2:4] == (False, False)
    assert trouble(live) == {}


def test_empty_in_lockstep_is_the_simulation_but_for_its_first_steps(served, make):
    """The guards let joints speed up by 10 rad/s^2."""
    live = make("bam/ur-empty-v0", robot=served("bam/ur-empty-v0", fast=True), ur_model="ur5e")
    _, joints = episode(live, 20)
    _, expected = episode(make("bam/ur-empty-v0", ur_model="ur5e"), 20)
    assert np.abs(joints - expected).max() < 0.12
    assert trouble(live).keys() <= {"joint acceleration", "tool speed"}


def test_at_ten_hertz_a_command_means_something_for_two_periods(served, make):
    """Else the arm would rest between two commands: the profile's command timeout is one period of this task."""
    live = make("bam/ur-reach-v0", robot=served("bam/ur-reach-v0"), ur_model="ur5e")
    live.reset(seed=1)
    assert live.unwrapped.robot.info.text == "ur5e, served in real time; it rests 0.2 s after the last command"


def test_a_command_means_something_for_two_periods_at_least():
    arm, base = load_profile("ur5e"), load_profile("mir100")
    assert [arm.command_life(period) for period in (0.02, 0.05, 0.1)] == [0.1, 0.1, 0.2]
    assert [base.command_life(period) for period in (0.1, 0.5)] == [0.5, 1.0]


def test_the_guards_know_the_kinematics_of_the_model(make):
    live = make("bam/ur-reach-v0", robot="ws://127.0.0.1:9", ur_model="ur10e")
    guard = next(guard for guard in live.unwrapped.robot._guards if isinstance(guard, ToolSpeed))
    joints = np.array([[0.1, -1.0, 1.0, 0.3, 0.2, 0.0]])
    position, axes = UR_MODELS["ur10e"].geometry.flange_pose(joints)
    np.testing.assert_allclose([guard._tool(joints[0])], position + 0.15 * axes[:, :, 2], atol=1e-12)
