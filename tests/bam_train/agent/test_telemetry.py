"""What people who look at a robot are told about it."""

import dataclasses
import json
import math

import numpy as np
import pytest

from bam_envs.arms.description import robot_model
from bam_envs.core.kinematics import UR10E
from bam_envs.core.robot import RobotState
from bam_envs.robots.base_description import base_model
from bam_envs.robots.ur import ur_model, ur_spec
from bam_envs.robots.ur5e import GEOMETRY, arm_spec
from bam_envs.safety.guard import Limits
from bam_envs.testing import ARM_HOME
from bam_train.agent.front.telemetry import Telemetry

ARM, BASE = arm_spec("ur5e", with_object=False), base_model("mir100").spec()
SHARES = {"value", "limit", "unit", "share"}


def arm_state(joints=ARM_HOME, speeds=(0.0,) * 6):
    signals = {"joint_position": joints, "joint_velocity": speeds, "gripper_width": [0.04]}
    return RobotState({k: np.array([v], dtype=float) for k, v in signals.items()}, np.zeros(1), np.zeros((1, 7)))


def base_state(distance=5.0, speeds=(0.25, 0.0)):
    signals = {"base_pose": [1.0, 2.0, 0.5], "base_velocity": speeds}
    arrays = {name: np.array([values], dtype=float) for name, values in signals.items()}
    arrays |= {one.name: np.full((1, len(one.labels)), distance) for one in BASE.signals[2:]}
    return RobotState(arrays, np.zeros(1), np.zeros((1, 2)))


def test_the_message_of_an_arm():
    message = Telemetry(ARM, Limits()).message(arm_state(), 12.5, command=np.array([[*ARM_HOME, 0.08]]), age=0.02)
    assert list(message) == ["event", "t", "state", "units", "command", "tool", "near"]
    assert (message["event"], message["t"]) == ("telemetry", 12.5)
    assert message["state"]["joint_position"]["elbow_joint"] == ARM_HOME[2]
    assert message["state"]["joint_velocity"]["elbow_joint"] == 0.0
    assert message["units"]["joint_velocity"]["elbow_joint"] == "rad/s"
    assert message["state"]["gripper_width"] == {"gripper_width": 0.04}
    assert message["command"]["gripper_width"] == 0.08
    np.testing.assert_allclose(message["tool"], GEOMETRY.tool_position(np.array([ARM_HOME]))[0], atol=1e-5)
    assert message["near"]["state age"] == {"value": 0.02, "limit": 0.1, "unit": "s", "share": 0.2}
    state = arm_state()
    state.signals |= {"object_position": np.array([[0.5, 0.1, 0.02]])}
    state.signals |= {"object_quaternion": np.array([[math.cos(0.2), 0.0, 0.0, math.sin(0.2)]])}
    message = Telemetry(arm_spec("ur5e", with_object=True), Limits()).message(state, 0.0)
    assert message["object"] == [0.5, 0.1, 0.02, 0.0, 0.0, 0.19867, 0.98007]


def test_the_scene_of_an_arm_is_its_description():
    arm, workspace = robot_model("fr3"), np.array([[0.3, -0.25, 0.016], [0.7, 0.25, 0.35]])
    limits = Limits(box_x_max=0.6, table_height=-0.1)
    scene = Telemetry(arm.spec(with_object=True), limits, geometry=arm.arm, workspace=workspace).scene
    chain = arm.chain
    assert scene["joints"] == [["joint_position", f"fr3_joint{joint}"] for joint in range(1, 8)]
    assert scene["placements"] == chain.placements.reshape(7, 16).tolist()
    assert (scene["mount"], scene["axes"]) == (np.eye(4).ravel().tolist(), chain.axes.tolist())
    assert scene["tool"] == chain.tool_placement.ravel().tolist()
    links = [one for one in arm.capsules if one.link < 8]  # the gripper is drawn as in simulation
    assert scene["capsules"] == [[one.link, *one.start, *one.end, one.radius] for one in links]
    assert (scene["gripper"]["width"], scene["cube"]) == (0.08, 0.04)
    palm, finger, pad = scene["gripper"]["boxes"]
    size = 0.08 / 0.085  # of a Robotiq 2F-85
    np.testing.assert_allclose(palm, [0, 0, -0.105 * size, 0.0475, 0.032 * size, 0.045 * size])
    np.testing.assert_allclose(finger, [0.008, 0, -0.038 * size, 0.006, 0.011 * size, 0.022 * size])
    np.testing.assert_allclose(pad, [0.004, 0, -0.002 * size, 0.004, 0.011 * size, 0.014 * size])
    assert (scene["box"], scene["table"]) == ([0.3, -0.25, 0.016, 0.6, 0.25, 0.35], -0.1)
    json.dumps(scene, allow_nan=False)
    bare = Telemetry(ur_spec(ur_model("ur5e"), 0.05, False), Limits()).scene
    assert (bare["gripper"], bare["box"]) == (None, [-2.0, -2.0, None, 2.0, 2.0, 2.0])
    assert Telemetry(BASE, Limits()).scene == {}


def test_the_speed_of_the_tool_is_that_of_its_joints():
    speeds, moment = np.array([0.1, -0.2, 0.3, 0.1, -0.1, 0.4]), 1e-6
    near = Telemetry(ARM, Limits()).message(arm_state(speeds=speeds), 0.0)["near"]
    ways = GEOMETRY.tool_position(np.array([ARM_HOME, ARM_HOME + moment * speeds]))
    assert near["tool speed"]["value"] == pytest.approx(np.linalg.norm(ways[1] - ways[0]) / moment, abs=1e-4)
    assert near["joint speed"] == {"value": 0.4, "limit": 1.0, "unit": "rad/s", "share": 0.4}


def test_the_room_of_an_arm_to_its_limits():
    limits = Limits(box_x_min=0.0, box_x_max=0.6, position_margin=0.1)
    telemetry = Telemetry(ARM, limits)
    tool = GEOMETRY.tool_position(np.array([ARM_HOME]))[0]
    near = telemetry.message(arm_state(), 0.0)["near"]
    assert near["workspace box"]["value"] == pytest.approx(min(0.6 - tool[0], tool[2]), abs=1e-4)
    assert {name: set(row) for name, row in near.items()} == dict.fromkeys(near, SHARES)
    bent = [*ARM_HOME[:2], math.pi - 0.15, *ARM_HOME[3:]]
    margin = telemetry.message(arm_state(bent), 0.0)["near"]["position margin"]
    assert margin == {"value": 0.15, "limit": 0.1, "unit": "rad", "share": 0.9}
    folded = telemetry.message(arm_state([0.0, -1.0, 2.9, -1.0, -1.5, 0.0]), 0.0)["near"]["collision"]
    assert folded["share"] == 1.0
    assert folded["value"] < folded["limit"]


def test_an_arm_of_another_size_and_one_without_kinematics():
    large = Telemetry(ARM, Limits(), geometry=UR10E).message(arm_state(), 0.0)
    np.testing.assert_allclose(large["tool"], UR10E.tool_position(np.array([ARM_HOME]))[0], atol=1e-5)
    labels = (*(f"axis_{n}" for n in range(6)), "gripper_width")
    position, velocity, width = ARM.signals
    signals = (*(dataclasses.replace(one, labels=labels[:6]) for one in (position, velocity)), width)
    other = dataclasses.replace(ARM, signals=signals, command=dataclasses.replace(ARM.command, labels=labels))
    unknown = Telemetry(other, Limits(tool_speed=math.inf))
    message = unknown.message(arm_state(), 0.0)
    assert (message["tool"], unknown.scene) == (None, {})
    assert set(message["near"]) == {"state age", "position margin", "joint speed"}


def test_the_message_of_a_base():
    message = Telemetry(BASE, Limits()).message(base_state(), 0.0, age=0.1)
    assert message["state"]["base_velocity"] == {"linear_velocity": 0.25, "angular_velocity": 0.0}
    assert set(message["state"]) == {"base_pose", "base_velocity"}
    assert message["tool"] is None
    assert message["base"] == [1.0, 2.0, 0.5]
    assert message["outline"] == [[0.4876, -0.29], [0.4876, 0.29], [-0.4124, 0.29], [-0.4124, -0.29]]
    assert 100 < len(message["scan"]) <= 180
    assert all(len(point) == 2 for point in message["scan"])
    assert message["near"]["base speed"] == {"value": 0.25, "limit": 0.5, "unit": "m/s", "share": 0.5}
    assert message["near"]["turn speed"]["share"] == 0.0
    assert message["near"]["laser zones"]["share"] == 0.0
    assert Telemetry(BASE, Limits()).message(base_state(0.4), 0.0)["near"]["laser zones"]["share"] > 0.9


def test_bases_without_scanners_a_round_one_is_drawn_round():
    spec = base_model("turtlebot4").spec(with_scans=False)
    state = base_state()
    state.signals = {name: state.signals[name] for name in ("base_pose", "base_velocity")}
    edge = np.array(Telemetry(spec, Limits()).message(state, 0.0)["outline"])
    assert edge.shape == (32, 2)
    np.testing.assert_allclose(np.hypot(*edge.T), 0.171, atol=1e-5)
    message = Telemetry(base_model("mir100").spec(with_scans=False), Limits()).message(state, 0.0)
    assert (message["scan"], "laser zones" in message["near"]) == ([], False)


def test_what_is_not_finite_is_not_sent():
    message = Telemetry(ARM, Limits()).message(arm_state(speeds=(math.nan,) * 6), 0.0, age=math.inf)
    assert message["state"]["joint_velocity"]["elbow_joint"] is None
    assert "state age" not in message["near"]
    assert "tool speed" not in message["near"]
    json.dumps(message, allow_nan=False)
