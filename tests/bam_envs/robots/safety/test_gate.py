"""No public way leads a command around the gate to a live robot."""

import ast
import inspect
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import bam_envs
import bam_train
from bam_envs.errors import BamEnvsError, InvalidValue
from bam_envs.registry import ENVIRONMENTS
from bam_envs.robots.live.building import live_robot
from bam_envs.robots.live.rosbridge import RosbridgeRobot
from bam_envs.robots.profiles.profile import load_profile
from bam_envs.robots.safety.safe import ClearedCommand, SafeRobot

NOBODY = "ws://127.0.0.1:9"
SOURCES = [path for package in (bam_envs, bam_train) for path in sorted(Path(package.__file__).parent.rglob("*.py"))]


def callers(name):
    """Files of both packages that call `name`, whatever it is reached through."""
    found = []
    for path in SOURCES:
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        names = [getattr(call.func, "id", None) or getattr(call.func, "attr", None) for call in calls]
        found += [path.name] * (name in names)
    return found


def test_a_live_robot_is_built_behind_the_gate_and_nowhere_else():
    assert isinstance(live_robot(NOBODY), SafeRobot)
    assert isinstance(live_robot(NOBODY, profile="mir100"), SafeRobot)
    assert callers("RosbridgeRobot") == ["building.py"]
    assert callers("ClearedCommand") == ["safe.py"]


@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_an_environment_on_a_live_robot_has_the_gate(env_id):
    env = gym.make(env_id, robot=NOBODY, disable_env_checker=True)
    assert isinstance(env.unwrapped.robot, SafeRobot)
    env.close()


def test_the_gate_shows_nobody_what_is_behind_it():
    robot = live_robot(NOBODY)
    public = [name for name in dir(robot) if not name.startswith("_")]
    assert not [name for name in public if isinstance(getattr(robot, name), RosbridgeRobot)]
    assert not [name for name in public if hasattr(getattr(robot, name), "publish")]


def test_a_live_robot_has_one_way_in_and_it_takes_cleared_commands():
    robot = RosbridgeRobot(NOBODY, load_profile("ur5e"))
    takers = [
        name
        for name, member in inspect.getmembers(robot, callable)
        if not name.startswith("_") and "command" in inspect.signature(member).parameters
    ]
    assert takers == ["step"]
    for command in (np.zeros((1, 7)), object.__new__(ClearedCommand)):
        with pytest.raises((BamEnvsError, AttributeError)):
            robot.step(command)


def test_the_gate_of_a_live_robot_keeps_its_guards():
    with pytest.raises(InvalidValue, match=r"^A live robot keeps all of its guards; "):
        SafeRobot(RosbridgeRobot(NOBODY, load_profile("ur5e")), [])


def test_the_limits_of_a_profile_are_those_of_its_gate():
    report = live_robot(NOBODY, profile="mir100").report()
    assert report["base speed"]["limit"] == 0.5
    assert report["turn speed"]["limit"] == 0.7
    assert report["state age"]["limit"] == 0.5
    report = live_robot(NOBODY).report()
    assert report["tool speed"]["limit"] == 0.25
    assert report["joint speed"]["limit"] == 1.0
    assert report["state age"]["limit"] == 0.1
