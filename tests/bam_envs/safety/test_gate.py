"""No public way leads a command around the gate to a live robot."""

import ast
import copy
import inspect
import math
import pickle
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import bam_envs
import bam_train
from bam_envs.core.errors import BamEnvsError, InvalidValue
from bam_envs.core.robot import Initial
from bam_envs.live.building import live_robot
from bam_envs.live.rosbridge_robot import RosbridgeRobot
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.robots.profile import load_profile
from bam_envs.safety.gate import ClearedCommand, SafeRobot
from bam_envs.safety.guard import BOUNDS, Limits
from bam_envs.testing import ARM_HOME, DrivenRobot
from tests.bam_envs.making import ROBOTS

NOBODY = "ws://127.0.0.1:9"
SOURCES = [path for package in (bam_envs, bam_train) for path in sorted(Path(package.__file__).parent.rglob("*.py"))]


def callers(name):
    """Files of both packages that call `name`, whatever it is reached through."""
    found = []
    for path in SOURCES:
        text = path.read_text()
        calls = [node for node in ast.walk(ast.parse(text if name in text else "")) if isinstance(node, ast.Call)]
        names = [getattr(call.func, "id", None) or getattr(call.func, "attr", None) for call in calls]
        found += [path.name] * (name in names)
    return found


def test_a_live_robot_is_built_behind_the_gate_and_nowhere_else():
    assert isinstance(live_robot(NOBODY), SafeRobot)
    assert isinstance(live_robot(NOBODY, profile="mir100"), SafeRobot)
    assert callers("RosbridgeRobot") == ["building.py"]
    assert callers("_clear") == ["gate.py"]


@pytest.mark.parametrize("env_id", sorted(ROBOTS))
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
    for name in ("spec", "info"):
        with pytest.raises(AttributeError):
            setattr(robot, name, None)
    for command in (np.zeros((1, 7)), object.__new__(ClearedCommand)):
        with pytest.raises((BamEnvsError, AttributeError)):
            robot.step(command)


def test_a_live_robot_has_one_gate():
    robot = RosbridgeRobot(NOBODY, load_profile("ur5e"))
    gate = SafeRobot(robot)
    with pytest.raises(InvalidValue, match=r"^ur5e has a SafeRobot already; "):
        SafeRobot(robot)
    del gate
    SafeRobot(robot)


def test_the_gate_has_neither_copies_nor_other_kinds():
    """A copy made before a stop would not be stopped, and another kind could say that every state is fresh."""
    gate = live_robot(NOBODY)
    for copied in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(InvalidValue) as caught:
            copied(gate)
        assert str(caught.value) == (
            "The SafeRobot of ur5e cannot be copied: a robot has one gate. Build another SafeRobot for another robot."
        )
    with pytest.raises(InvalidValue, match=r"^A SafeRobot has no subclasses: "):
        type("Open", (SafeRobot,), {"age": lambda self: 0.0})


def test_the_limits_of_a_live_robot_are_of_no_other_kind_and_their_bounds_are_fixed():
    class Loose(Limits):
        def require_bounded(self):
            """Whatever is asked for."""

    with pytest.raises(InvalidValue, match=r"^The limits of a live robot must be Limits, not Loose\. "):
        live_robot(NOBODY, limits=Loose(tool_speed=math.inf))
    with pytest.raises(TypeError):
        BOUNDS["tool_speed"] = (0.0, 99.0, "m/s")


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("reach = 100.0", "ur5e may be 0 to 0.5 s behind its commands, not 75.05 s. "),
        ("reach_periods = 50", "ur5e may be 0 to 0.5 s behind its commands, not 1.925 s. "),
        (
            "period = 100.0",
            "The period of ur5e must be above 0 and at most 1 s, not 100 s: the robot moves for that "
            "long without a check. Command it more often.",
        ),
    ],
)
def test_a_profile_cannot_make_one_command_go_anywhere(tmp_path, text, error):
    """How far a command may be from the arm, and for how long it is not missed, would be without bounds."""
    shipped = (Path(bam_envs.__file__).parent / "robots" / "profiles" / "ur5e.toml").read_text()
    profile = tmp_path / "mine.toml"
    late = shipped.replace("reach_periods = 2.0", text)
    profile.write_text(late if "reach" in text else f'extends = "ur5e"\n{text}\n')
    with pytest.raises(InvalidValue) as caught:
        live_robot(NOBODY, profile=profile)
    assert str(caught.value).startswith(error)


def test_what_a_caller_writes_into_a_state_the_guards_do_not_believe():
    driven = DrivenRobot(SimulatedArm(1, with_object=False))
    gate = SafeRobot(driven, clock=driven.clock)
    gate.connect()
    initial = Initial({"joint_position": np.array([ARM_HOME])}, np.zeros(1, np.int64))
    driven.place(initial)
    state = gate.reset(np.zeros(1, np.int64), initial)
    for _ in range(3):
        state.signals["joint_position"][:] += 0.04
        state.signals["joint_velocity"][:] = 9.0
        state = gate.step(state.command)
    assert state.signals["joint_position"][0] == pytest.approx(np.array(ARM_HOME), abs=0.01)
    assert not [name for name, counts in gate.report().items() if counts["held"] or counts["stopped"]]
