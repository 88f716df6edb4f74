"""A live robot over a connected `roslibpy.Ros` of the user."""

import contextlib
import threading
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import roslibpy

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer
from bam_envs.core.location import LiveRobot
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.ros.codec import HALT_TOPIC

COMMANDS = "/scaled_joint_trajectory_controller/joint_trajectory"
STILL = np.zeros(5, np.float32)


@pytest.fixture
def served():
    with ServedEnvironment(gym.make("bam/pick-v0"), ServeOptions(port=0)) as served:
        yield served


@pytest.fixture
def ros(served):
    ros = roslibpy.Ros(served.bus.url, transport="asyncio")
    ros.run(10.0)
    yield ros
    ros.close()


def closed(ros, close):
    """Close a `Ros`, and wait until it is."""
    event = threading.Event()
    ros.on("close", lambda connection: event.set())
    close()
    assert event.wait(10.0)


def test_it_is_driven_halted_and_lost_as_over_an_address(served, ros):
    drivers, halts, halted = set(), set(), threading.Event()
    served.bus.subscribe(HALT_TOPIC, "std_msgs/Empty", lambda _, caller: (halts.add(caller.name), halted.set()))
    served.bus.subscribe(COMMANDS, "trajectory_msgs/JointTrajectory", lambda _, caller: drivers.add(caller.name))
    robot = LiveRobot(ros, guards={"joint_speed": 0.3})
    with contextlib.closing(gym.make("bam/pick-v0", robot=robot)) as env:
        assert env.reset(seed=1)[0].shape == (18,)
        env.step(STILL)
        assert env.spec.kwargs["robot"] == replace(
            robot, url=served.bus.url
        )  # a copy of the specification cannot have the connection
        env.unwrapped.robot.halt()
        assert halted.wait(10.0)
        closed(ros, ros.close)
        with pytest.raises(
            LinkLost, match=r": the link is down\. Nothing was sent, and nothing is kept; stop it by hand"
        ):
            env.step(STILL)
    assert (len(drivers), len(halts), drivers & halts) == (1, 1, set())  # a halt waits for no listener of the user's


def test_a_ros_that_is_not_connected_and_options_of_an_address_are_refused(served, ros):
    with pytest.raises(InvalidValue) as raised:
        gym.make("bam/pick-v0", robot=ros, token_file="token")
    text = "ca_file= and token_file= are for an address; a roslibpy.Ros has made its connection."
    assert str(raised.value) == text
    closed(ros, ros.close)
    with contextlib.closing(gym.make("bam/pick-v0", robot=ros)) as env:
        assert env.spec.kwargs["robot"] == served.bus.url
        with pytest.raises(NoServer) as raised:
            env.reset()
    assert str(raised.value) == f"{served.bus.url}: the roslibpy.Ros is not connected: call its run() before."
