"""The console of a real agent, in a real browser, and what the robot's side gets of it."""

import time

import numpy as np
import pytest

from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.ros.codec import HALT_TOPIC
from bam_train.environments import make_env
from tests.bam_train.agent.browsers import LEAVINGS, browser, page, until
from tests.bam_train.agent.test_live_agent import PICK, Program

__all__ = ["browser", "page"]  # fixtures from elsewhere
COMMANDS = "/scaled_joint_trajectory_controller/joint_trajectory"
REST = 0.5
"""Time without a new command after which the robot rests [s]."""


class Robot:
    """A simulated robot behind rosbridge, which notes when commands and halts come."""

    def __init__(self):
        self.served = ServedEnvironment(make_env("bam/pick-v0", {}), ServeOptions(port=0))
        self.commands, self.halts = [], []  # (time [s, monotonic], joints [rad]); times

    def __enter__(self):
        self.served.__enter__()
        bus = self.served.bus
        bus.subscribe(COMMANDS, "trajectory_msgs/JointTrajectory", self._note)
        bus.subscribe(HALT_TOPIC, "std_msgs/Empty", lambda message, caller: self.halts.append(time.monotonic()))
        return self

    def __exit__(self, *error):
        self.served.close()

    def _note(self, message, caller):
        self.commands.append((time.monotonic(), list(message["points"][0]["positions"])))

    @property
    def moves(self):
        """Whether it was sent somewhere else lately."""
        recent = [joints for at, joints in list(self.commands) if time.monotonic() - at < REST]
        return len(recent) > 1 and bool(np.ptp(recent, axis=0).max() > 1e-6)

    def rests(self):
        """Where the tool is once it is sent nowhere else and has arrived, which takes longer on a busy computer."""
        places = [self.tool]

        def is_still():
            time.sleep(REST)
            places.append(self.tool)
            return not self.moves and np.abs(places[-1] - places[-2]).max() < 1e-4

        until(is_still, "rest")
        return places[-1]

    @property
    def tool(self):
        return GEOMETRY.tool_position(self.served.robot_service._robot.state.signals["joint_position"])[0]


@pytest.fixture(scope="module")
def robot():
    with Robot() as robot:
        yield robot


@pytest.fixture(scope="module")
def agent(robot, tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    program = Program(folder, "--policy", str(PICK), "--robot", robot.served.bus.url, "--no-record", "--paused")
    yield program
    program.end()


@pytest.fixture
def shown(page, agent):
    """The page, of an agent that is paused, and that nobody drives."""
    until(lambda: agent.agent.ask("pause")["owner"] is None and agent.agent.ask("status")["owner"] is None, "the robot")
    page.open(agent.url.replace("ws", "http", 1)).shows("state", "paused")
    page.shows("tool", "Tool at x, y, z")
    return page


@pytest.fixture
def driven(shown):
    """The page that has taken over, and holds no key yet."""
    shown.click("take")
    shown.shows("owner", "You drive")
    return shown


def test_what_it_shows(shown, agent):
    agent.run()
    shown.shows("state", "▶ running")
    assert shown.text("name") == "ur5e"
    assert shown.text("robot").startswith(
        "simulated · ur5e, served in real time; it rests 0.1 s after the last command · ws://"
    )
    for text in ("champion", "full", "bam/pick-v0", "ms of 50.0 ms"):
        shown.shows("run", text)
    for text in ("joint speed", "tool speed", "workspace box", "state age", "m/s, limit 0.25"):
        shown.shows("guards", text)
    shown.shows("versions", "▶ acts")
    shown.shows("audit", "-> running: resumed by anna@laptop (anna@laptop at 127.0.0.1:")
    shown.shows("plots", "joint position [rad]")
    assert shown.complaints() == []


def test_stop_reaches_the_robot_and_the_policy_goes_on_only_when_it_is_told(shown, agent, robot):
    for press in (lambda: shown.click("stop"), lambda: shown.tap(" ")):
        agent.run()
        shown.shows("state", "running")
        robot.halts.clear()
        press()
        until(lambda: robot.halts, "the halt")
        shown.shows("state", "❚❚ paused")
        shown.shows("why", "the stop button")
    until(lambda: not robot.moves, "rest")
    shown.click("resume")
    until(lambda: robot.moves, "a motion")


def test_jogging_moves_the_tool_along_the_key_and_no_farther(driven, robot):
    start = robot.tool
    driven.move("r", lambda: robot.tool[2] > start[2] + 0.03)
    driven.let("r")
    end = robot.rests()
    assert np.abs((end - start)[:2]).max() < 0.02
    time.sleep(REST)
    np.testing.assert_allclose(robot.tool, end, atol=2e-3)
    assert driven.complaints() == []


@pytest.mark.parametrize("leave", LEAVINGS[:3])
def test_a_page_that_is_left_in_mid_jog_leaves_the_robot_at_rest(driven, agent, robot, leave):
    driven.move("r", lambda: robot.moves)
    robot.halts.clear()
    leave(driven)
    here = robot.rests()
    time.sleep(REST)
    assert not robot.moves
    np.testing.assert_allclose(robot.tool, here, atol=2e-3)
    # On a busy computer, a guard may stop the robot first.
    assert agent.agent.ask("status")["state"] in ("taken over", "paused", "stopped by a guard")


def test_a_frozen_page_leaves_the_robot_at_rest_and_the_policy_does_not_go_on(driven, agent, robot):
    driven.move("r", lambda: robot.moves)
    with driven.frozen():
        until(lambda: not robot.moves, "rest")
        until(lambda: robot.halts, "the halt")
        assert agent.agent.ask("status")["state"] in ("taken over", "paused")
    here = robot.rests()
    time.sleep(REST)
    assert not robot.moves
    np.testing.assert_allclose(robot.tool, here, atol=2e-3)


def test_a_page_that_closes_gives_the_robot_back_paused(driven, agent):
    driven.open("about:blank")
    assert agent.state("paused")["owner"] is None


def test_handed_back_the_policy_goes_on_or_not(driven, agent, robot):
    driven.click("back-run")
    driven.shows("state", "▶ running")
    until(lambda: robot.moves, "a motion")
    driven.click("take")
    driven.shows("owner", "You drive")
    driven.click("back-pause")
    driven.shows("state", "❚❚ paused")
    until(lambda: not robot.moves, "rest")
