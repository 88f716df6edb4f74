"""The contract between a checkpoint and a robot: mutated robots are refused by the right line, correct ones are not."""

import copy
import functools
import json
import math
import random
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bam_envs.arms.description import robot_model
from bam_envs.core.errors import ProtocolError
from bam_envs.core.kinematics import UR5E_GRIPPER, UR_JOINTS, quaternions
from bam_envs.core.robot import RobotState
from bam_envs.live.arm_checks import described_checks, read_urdf
from bam_envs.live.examination import TOOL_POSE, Inspection
from bam_envs.live.state import Letter
from bam_envs.robots.base_description import base_model
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur import UR_MODELS
from bam_envs.robots.ur5e import arm_spec
from bam_envs.ros.codec import RobotInfo, encode_state
from bam_envs.ros.messages import write_stamp
from bam_envs.safety.guard import Limits
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.contract import Contract, fit_checks, live_checks
from bam_train.environments import make_env
from bam_train.errors import ContractRefused

PICK = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"
JOINTS = np.array([-0.27, -1.54, 1.89, -1.93, -1.47, -1.84])
WALL, BEGIN = 1.7e9, 1000.0
profile_of = functools.cache(load_profile)


class Watched:
    """A robot that publishes for half a second, on a clock of its own; a test changes something first."""

    def __init__(self, profile, spec, seed=0):
        self.profile = profile_of(profile)
        self.spec = self.profile.spec(spec)
        self.rng, self.noise = np.random.default_rng(seed), 0.0
        self.rate, self.seconds, self.delay, self.clock, self.frozen = 100.0, 0.5, 0.001, 0.0, False
        self.ahead, self.late, self.stall, self.listening = 0.0, np.zeros(10, np.bool_), 0.0, 0.0
        self.mangle = None
        self.types, self.info, self.urdf, self.task = {}, None, None, SimpleNamespace()
        self.changes = {}

    def contract(self):
        robot = SimpleNamespace(spec=self.spec, limits=Limits())
        env = SimpleNamespace(unwrapped=SimpleNamespace(robot=robot, task=self.task))
        inspection = self.inspection()
        return Contract(tuple(live_checks(env, inspection)), inspection)

    def inspection(self):
        names = {signal.name for signal in self.spec.signals} | {*TOOL_POSE}
        sources = tuple(source for source in self.profile.state if source.signal in names)
        sinks = self.profile.sinks()
        types = {one.topic: one.type for one in (*sources, *sinks)} | {"/robot_description": ""} | self.types
        letters = {source.topic: [] for source in sources if types[source.topic] == source.type}
        for i in range(math.ceil(self.seconds * self.rate)):
            at = i / self.rate
            signals = {name: np.atleast_2d(one).astype(float) for name, one in self.signals(at).items()}
            signals |= {name: change(signals[name]) for name, change in self.changes.items()}
            state = RobotState(signals, np.zeros(1), np.zeros((1, len(self.spec.command.labels))))
            wall = at + (self.stall if 2 * at > self.seconds else 0.0)
            stamp = write_stamp(WALL + self.clock + self.ahead + (0.0 if self.frozen else wall))
            for topic, _, message in encode_state(self.profile, state, 0, stamp):
                if self.mangle is not None:
                    message = self.mangle(topic, copy.deepcopy(message))
                if topic in letters and message is not None:
                    late = self.delay + self.noise * abs(self.rng.normal(0.0, 0.002))
                    arrived = BEGIN + max(wall + late, self.listening)
                    letters[topic].append(Letter(message, arrived, len(letters[topic]) + 1))
        if self.urdf is not None:
            letters["/robot_description"] = [Letter({"data": self.urdf}, BEGIN, 1)]
        letters = {topic: tuple(found) for topic, found in letters.items()}
        facts = self.seconds, WALL - BEGIN, -self.clock
        ticks = {"ticks": np.arange(len(self.late)) * 0.05, "late": self.late}
        return Inspection(self.profile, self.info, sources, sinks, types, letters, *facts, **ticks)

    def noisy(self, values, scale):
        values = np.asarray(values, float)
        return values + self.noise * scale * self.rng.standard_normal(values.shape)


class Arm(Watched):
    """A UR5e with a gripper; the true joints stand still, or all turn at `speed` [rad/s]."""

    def __init__(self, seed=0, joints=JOINTS, geometry=UR5E_GRIPPER):
        super().__init__("ur5e", arm_spec("ur5e", with_object=True), seed)
        self.joints, self.geometry, self.speed, self.tool, self.measures_tool = joints, geometry, 0.0, None, True

    def signals(self, t):
        q = self.joints + self.speed * t
        flange, axes = self.geometry.flange_pose(q[None])
        tool = self.geometry.tool if self.tool is None else self.tool
        pose = {
            "tool_position": self.noisy(flange[0] + tool * axes[0][:, 2], 5e-4),
            "tool_quaternion": self.noisy(np.roll(quaternions(axes)[0], 1), 1e-3),
        }
        return {
            "joint_position": self.noisy(q, 1e-4),
            "joint_velocity": self.noisy(np.full(6, self.speed), 2e-3),
            "gripper_width": self.noisy([0.085], 2e-4),
            "object_position": self.noisy([0.5, 0.1, 0.02], 1e-3),
            "object_quaternion": self.noisy([1.0, 0.0, 0.0, 0.0], 1e-3),
            **(pose if self.measures_tool else {}),
        }


class Base(Watched):
    """A MiR100 that drives and turns slowly."""

    def __init__(self, seed=0):
        super().__init__("mir100", base_model("mir100").spec(), seed)
        self.speed, self.turn = 0.3, 0.4

    def signals(self, t):
        angle = 1.0 + self.turn * t
        x, y = np.array([math.sin(angle) - math.sin(1.0), math.cos(1.0) - math.cos(angle)]) * self.speed / self.turn
        return {
            "base_pose": self.noisy([x, y, angle], 1e-3),
            "base_velocity": self.noisy([self.speed, self.turn], 5e-3),
            "f_scan": np.full(501, 3.0),
            "b_scan": np.full(511, 4.0),
        }


def urdf_of(geometry, travel=2 * math.pi, elbow=math.pi):
    """The joints as ROS-Industrial's ur_description has them."""
    pi = math.pi
    moving = zip(
        UR_JOINTS,
        ["base_link_inertia", "shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link"],
        ["shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link"],
        [(0, 0, geometry.d1), (0, 0, 0), (geometry.a2, 0, 0), (geometry.a3, 0, geometry.d4), (0, -geometry.d5, 0),
         (0, geometry.d6, 0)],
        [(0, 0, 0), (pi / 2, 0, 0), (0, 0, 0), (0, 0, 0), (pi / 2, 0, 0), (pi / 2, pi, pi)],
        [travel, travel, elbow, travel, travel, travel],
        strict=True,
    )  # fmt: skip
    fixed = [
        ("base", "base_link", "base_link_inertia", (0, 0, pi)),
        ("flange", "wrist_3_link", "flange", (0, -pi / 2, -pi / 2)),
        ("tool", "flange", "tool0", (pi / 2, 0, pi / 2)),
    ]

    def text(values):
        return " ".join(map(str, values))

    joints = [
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{text(xyz)}" rpy="{text(rpy)}"/><axis xyz="0 0 1"/><limit lower="{-end}" upper="{end}"/></joint>'
        for name, parent, child, xyz, rpy, end in moving
    ] + [
        f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 0" rpy="{text(rpy)}"/></joint>'
        for name, parent, child, rpy in fixed
    ]
    return f'<?xml version="1.0" ?><!-- made --><robot name="ur">{"".join(joints)}</robot>'


def refused(contract):
    return {one.what: one.found for one in contract.refused}


# ---- correct robots


def test_the_table_of_a_correct_arm():
    arm = Arm()
    arm.urdf = urdf_of(UR5E_GRIPPER)
    contract = arm.contract()
    lines = contract.lines()
    assert refused(contract) == {}
    assert [one.what for one in contract.checks] == [
        *("topic /joint_states", "rate of /joint_states", "age of /joint_states"),
        *("topic /gripper/joint_states", "rate of /gripper/joint_states", "age of /gripper/joint_states"),
        *("topic /object_pose", "rate of /object_pose", "age of /object_pose"),
        *("joint_position", "joint_velocity", "gripper_width", "object_position", "object_quaternion"),
        *("length of object_quaternion", "joint_velocity against joint_position"),
        *("command /gripper/commands", "command /scaled_joint_trajectory_controller/joint_trajectory"),
        *(f"limits of {name}" for name in UR_JOINTS),
        *("kinematics in /robot_description", "mount in /robot_description"),
        *("tool pose", "tool length", "sense of the joints"),
    ]
    assert lines[0].split() == ["what", "expected", "found", "verdict"]
    assert lines[2].split() == ["rate", "of", "/joint_states", "at", "least", "16", "Hz", "100", "Hz", "ok"]
    assert lines[-1].split()[-1] == "ok"
    assert contract.to_json()[-3] == {
        "what": "tool pose",
        "expected": "as computed, within 0.015 m and 3 degrees",
        "found": "0.000 m, 0.0 degrees",
        "verdict": "ok",
    }
    contract.require("pick.zip and the robot")


@pytest.mark.parametrize("seed", range(70))
def test_correct_arms_with_noise_are_accepted(seed):
    rng = np.random.default_rng(seed)
    low, high = np.radians([[-180, -150, 20, -200, -160, -170], [180, -30, 150, -20, -20, 170]])
    few = rng.normal(0.0, 1e-3, 6)  # as a factory's calibration
    lengths = dict(zip(("d1", "a2", "a3", "d4", "d5", "d6"), few, strict=True))
    calibrated = replace(UR5E_GRIPPER, **{name: getattr(UR5E_GRIPPER, name) + off for name, off in lengths.items()})
    arm = Arm(seed, rng.uniform(low, high), calibrated)
    arm.noise, arm.rate, arm.delay = 1.0, rng.choice([20.0, 50.0, 125.0]), rng.uniform(0.0, 0.03)
    arm.seconds = 0.3
    arm.clock, arm.speed = rng.choice([0.0, 3600.0, -1e6]), rng.choice([0.0, 0.0, 0.2])
    arm.tool, arm.measures_tool = rng.choice([0.0, 0.15]), bool(rng.random() < 0.7)
    arm.urdf = urdf_of(calibrated) if rng.random() < 0.5 else None
    assert refused(arm.contract()) == {}


@pytest.mark.parametrize("seed", range(30))
def test_correct_bases_with_noise_are_accepted(seed):
    rng = np.random.default_rng(seed)
    base = Base(seed)
    base.noise, base.rate, base.seconds = 1.0, rng.uniform(10.0, 30.0), 1.5
    base.speed, base.turn = rng.uniform(-0.5, 0.5), rng.choice([-0.7, 1e-9, 0.5])
    assert refused(base.contract()) == {}


# ---- mutated robots


def altered(**changes):
    """Signals as a wrong driver publishes them."""

    def mutate(robot):
        robot.changes = changes

    return mutate


def swapped(i, j):
    def swap(values):
        values = values.copy()
        values[:, [i, j]] = values[:, [j, i]]
        return values

    return swap


def mirrored(i):
    return lambda values: np.where(np.arange(values.shape[1]) == i, -values, values)


def having(**attributes):
    return lambda robot: vars(robot).update(attributes)


def sending(topic, change):
    """Another content of the messages of a topic: `change` alters or replaces one."""

    def mutate(robot):
        robot.mangle = lambda name, message: change(message) if name == topic else message

    return mutate


def put(path, value):
    def change(message):
        *above, last = path.split(".")
        at = message
        for name in above:
            at = at[name]
        at[last] = value(at[last]) if callable(value) else value
        return message

    return change


def typed(topic, kind):
    return having(types={topic: kind})


def small_joints(robot):
    """Joints near zero, of which degrees are inside the range in rad."""
    robot.joints = np.array([0.05, -0.06, 0.04, -0.05, -0.07, 0.1])
    altered(joint_position=np.degrees)(robot)


def elbow_beyond(robot):
    """Swapped joints that fit the data sheet, but for an elbow that no UR has."""
    robot.joints = np.array([-0.27, -1.54, 1.76, -3.42, -1.47, -1.84])
    altered(joint_position=swapped(2, 3))(robot)


def of_kind(name):
    return lambda robot: vars(robot).update(geometry=replace(UR_MODELS[name].geometry, tool=0.15))


JOINT_TOPIC, SCAN = "/joint_states", "/f_scan"
ARMS = [
    (altered(joint_position=swapped(1, 2)), "tool pose", "shoulder_lift_joint and elbow_joint are swapped"),
    (altered(joint_position=swapped(3, 4)), "tool pose", "wrist_1_joint and wrist_2_joint are swapped"),
    (altered(joint_position=mirrored(0)), "tool pose", "shoulder_pan_joint has the opposite sign"),
    (altered(joint_position=mirrored(2)), "tool pose", "elbow_joint has the opposite sign"),
    (altered(joint_position=mirrored(5)), "tool pose", "wrist_3_joint has the opposite sign"),
    (altered(joint_position=np.degrees), "joint_position", "shoulder_pan_joint at -15.47 (degrees?)"),
    (elbow_beyond, "joint_position", "elbow_joint at -3.42"),
    (small_joints, "tool pose", "the joints are in degrees"),
    (altered(tool_position=lambda x: 1000 * x), "tool pose", "the tool's position is in millimetres"),
    (
        altered(tool_position=lambda x: x * (-1, -1, 1)),
        "tool pose",
        "the tool's pose is turned by 180 degrees about z: base instead of base_link",
    ),
    (of_kind("ur10e"), "tool pose", "the kinematics of a ur10e"),
    (of_kind("ur5"), "tool pose", "the kinematics of a ur5"),
    (of_kind("ur3e"), "tool pose", "the kinematics of a ur3e"),
    (
        having(tool=0.25),
        "tool length",
        "0.250 m: if its gripper is that of the policy, set the tool centre point (TCP) to 0.15 m; for another "
        "gripper, train a policy with its length",
    ),
    (altered(gripper_width=lambda x: 1000 * x), "gripper_width", "gripper_width at 85 (millimetres?)"),
    (altered(gripper_width=lambda x: 0 * x + 0.14), "gripper_width", "gripper_width at 0.14"),
    (altered(object_position=lambda x: 1000 * x), "object_position", "object_x at 500 (millimetres?)"),
    (altered(object_quaternion=lambda x: 0.5 * x), "length of object_quaternion", "0.500"),
    (
        altered(joint_velocity=lambda x: x + 1.0),
        "joint_velocity against joint_position",
        "1 measured, 0 from joint_position",
    ),
    (having(rate=5.0), f"rate of {JOINT_TOPIC}", "5 Hz"),
    (having(frozen=True), f"rate of {JOINT_TOPIC}", "1 new in 0.5 s"),
    (having(delay=0.4), f"age of {JOINT_TOPIC}", "0.400 s"),
    (typed("/object_pose", ""), "topic /object_pose", "nobody publishes it"),
    (sending(JOINT_TOPIC, lambda message: None), f"topic {JOINT_TOPIC}", "no message in 0.5 s"),
    (typed("/gripper/joint_states", "std_msgs/Float64"), "topic /gripper/joint_states", "std_msgs/Float64"),
    (
        sending(JOINT_TOPIC, put("name", lambda names: [*names[:5], "tool_joint"])),
        f"topic {JOINT_TOPIC}",
        f"wrist_3_joint missing; found: {', '.join([*sorted(UR_JOINTS)[:5], 'tool_joint'])}",
    ),
    (
        sending(JOINT_TOPIC, put("position", lambda values: [None, *values[1:]])),
        f"topic {JOINT_TOPIC}",
        "position of elbow_joint must be a finite number, not None",
    ),
    (
        typed("/scaled_joint_trajectory_controller/joint_trajectory", ""),
        "command /scaled_joint_trajectory_controller/joint_trajectory",
        None,
    ),
    (typed("/gripper/commands", "std_msgs/Float64"), "command /gripper/commands", "std_msgs/Float64"),
    (having(urdf=urdf_of(UR5E_GRIPPER, travel=3.14)), "limits of shoulder_pan_joint", "-3.14 to 3.14"),
    (having(urdf=urdf_of(UR5E_GRIPPER, 360.0, 180.0)), "limits of shoulder_pan_joint", "-360 to 360 (degrees?)"),
    (having(urdf=urdf_of(UR_MODELS["ur10"].geometry)), "kinematics in /robot_description", "those of a ur10"),
    (
        having(info=RobotInfo("ur5e", simulated=True, lockstep=True, period=0.1)),
        "robot's period",
        "0.1 s",
    ),
]
BASES = [
    (sending(SCAN, put("ranges", lambda rays: rays[:-1])), f"topic {SCAN}", "ranges must have 541 numbers, not 540"),
    (sending(SCAN, put("angle_increment", lambda x: -x)), f"angle_increment of {SCAN}", "-0.008727"),
    (sending(SCAN, put("angle_min", math.degrees)), f"angle_min of {SCAN}", "-135 (degrees?)"),
    (sending(SCAN, put("range_max", 29000.0)), f"range_max of {SCAN}", "2.9e+04 (millimetres?)"),
    (altered(base_velocity=mirrored(0)), "base_velocity against base_pose", "-0.3 measured, 0.3 from base_pose"),
    (altered(base_velocity=mirrored(1)), "base_velocity against base_pose", "-0.4 measured, 0.4 from base_pose"),
    (altered(base_velocity=lambda x: 1000 * x), "base_velocity", "linear_velocity at 300"),
    (typed("/cmd_vel", "geometry_msgs/Wrench"), "command /cmd_vel", "geometry_msgs/Wrench"),
]


MUTATIONS = [(Arm, *one) for one in ARMS] + [(Base, *one) for one in BASES]


@pytest.mark.parametrize(("kind", "mutate", "what", "found"), MUTATIONS)
def test_a_mutated_robot_is_refused_by_the_right_line(kind, mutate, what, found):
    robot = kind()
    mutate(robot)
    contract = robot.contract()
    first = next(iter(refused(contract).items()))
    assert first == (what, found or "nobody listens")
    same = what.partition(" of ")[0]  # the same mistake on every topic, or at every joint
    assert {one.partition(" of ")[0] for one in refused(contract)} == {same}
    with pytest.raises(ContractRefused, match=r"^pick\.zip and the robot do not fit: ") as caught:
        contract.require("pick.zip and the robot")
    assert (caught.value.what, caught.value.exit_status) == (what, 3)
    assert caught.value.passes is what.startswith(("rate of ", "age of "))  # these alone a busy computer changes
    remedy = "correct the robot or its profile" if robot.info is None else "correct the robot"
    if "; this computer is busy: " in first[1]:
        remedy = "end other programs on this computer, and run it again"
    assert str(caught.value).endswith(f"; {remedy}; nothing has moved")


WRONG, SLOW, SERVE = altered(joint_velocity=lambda x: x + 9.0), having(rate=8.0), "bam-serve --env bam/pick"
OTHER = "the robot there is fr3, and the policy is for ur5e: give the address of ur5e, or a policy for fr3"


@pytest.mark.parametrize(
    ("mutate", "info", "remedy"),
    [
        (WRONG, RobotInfo("fr3"), OTHER),
        (WRONG, RobotInfo("ur5e"), "correct the robot"),
        (WRONG, RobotInfo("ur5e", simulated=True), f"start the robot with {SERVE}"),
        (WRONG, RobotInfo("ur5e", agent=True), "give a policy for the environment of the live agent there"),
        (SLOW, RobotInfo("ur5e", agent=True), "correct the robot"),
        (
            SLOW,
            RobotInfo("ur5e", simulated=True),
            "the computer that simulates the robot is slow or busy: end other programs there, and run it again",
        ),
    ],
)
def test_a_robot_that_describes_itself_needs_no_other_profile(mutate, info, remedy):
    arm = Arm()
    mutate(arm)
    arm.info = info
    with pytest.raises(ContractRefused) as caught:
        replace(arm.contract(), stand_in=SERVE).require("pick.zip and the robot")
    assert str(caught.value).endswith(f"; {remedy}; nothing has moved")


def test_there_are_thirty_mutated_robots_and_more():
    assert len(MUTATIONS) >= 30


def test_what_a_robot_does_not_report_is_not_told():
    arm = Arm()
    arm.measures_tool = False
    contract = arm.contract()
    assert refused(contract) == {}
    assert {one.what: one.found for one in contract.checks if one.verdict == "unknown"} == {
        "joint_velocity against joint_position": "not shown at rest",
        "joint limits": "nobody publishes /robot_description",
        "tool pose": "the robot does not report the pose of its tool",
        "sense of the joints": "not shown without the tool's pose",
    }


def test_a_simulated_gripper_that_chatters_on_an_object_is_no_wrong_speed():
    arm = Arm()
    altered(joint_velocity=lambda x: x + 0.66)(arm)
    arm.info = RobotInfo("ur5e", simulated=True)
    assert "joint_velocity against joint_position" not in refused(arm.contract())


@pytest.mark.parametrize(
    ("scale", "simulated", "verdict", "found"),
    [
        (3.4, True, "unknown", "3.4 times as fast as joint_position changes: the simulation's computer is busy"),
        (3.4, False, "refused", "2.72 measured, 0.8 from joint_position"),
        (0.5, True, "refused", "0.4 measured, 0.8 from joint_position"),
        (-3.4, True, "refused", "-2.72 measured, 0.8 from joint_position"),
    ],
)
def test_the_time_of_a_simulation_on_a_busy_computer_passes_slowly(scale, simulated, verdict, found):
    arm = Arm()
    arm.speed = 0.8
    altered(joint_velocity=lambda x: scale * x)(arm)
    arm.info = RobotInfo("ur5e", simulated=simulated)
    speed = next(one for one in arm.contract().checks if one.what == "joint_velocity against joint_position")
    assert (speed.verdict, speed.found) == (verdict, found)


@pytest.mark.parametrize("late", [{"stall": 0.3}, {"listening": 0.3}])  # of a simulation, of this computer
def test_a_pause_of_a_busy_computer_is_no_wrong_speed(late):
    arm = Arm()
    arm.speed = 0.8
    having(**late)(arm)
    speed = next(one for one in arm.contract().checks if one.what == "joint_velocity against joint_position")
    assert (speed.verdict, speed.found) == ("ok", "0.8 measured, 0.8 from joint_position")
    altered(joint_velocity=lambda x: 0.7 * x)(arm)
    assert refused(arm.contract())[speed.what] == "0.56 measured, 0.8 from joint_position"


@pytest.mark.parametrize(
    ("mutate", "found"),
    [
        (having(ahead=5.0), "5.0 s ahead of the clock of the bridge: set the clock of the robot"),
        (
            sending(JOINT_TOPIC, put("header.stamp", {"sec": 0, "nanosec": 0})),
            "0: ages are judged by arrival alone, and a driver that repeats old states is not noticed",
        ),
    ],
)
def test_stamps_that_tell_nothing_are_named(mutate, found):
    arm = Arm()
    mutate(arm)
    lines = {one.what: one for one in arm.contract().checks}
    assert (lines["stamps of /joint_states"].found, lines["stamps of /joint_states"].verdict) == (found, "unknown")
    assert "stamps of /joint_states" not in {one.what for one in Arm().contract().checks}


def test_a_busy_computer_is_named_beside_what_it_changes():
    arm = Arm()
    arm.delay, arm.late = 0.4, np.arange(10) < 2
    text = "0.400 s; this computer is busy: 2 of 10 ticks came late"
    assert refused(arm.contract())["age of /joint_states"] == text


def test_a_joint_at_zero_does_not_show_its_sense():
    arm = Arm(joints=JOINTS * (1, 1, 1, 1, 1, 0))
    last = arm.contract().checks[-1]
    assert (last.verdict, last.found) == (
        "unknown",
        "not shown at 0 or 180 degrees: wrist_3_joint; move it a little and try again",
    )


def test_the_tool_pose_in_a_frame_that_the_profile_does_not_name_is_not_compared():
    arm = Arm()
    sending("/tcp_pose_broadcaster/pose", put("header.frame_id", "left_base"))(arm)
    contract = arm.contract()
    found = {one.what: one for one in contract.checks}["tool pose"]
    assert found.verdict == "unknown"
    assert found.found.startswith("/tcp_pose_broadcaster/pose: header.frame_id must be 'base', not 'left_base'")


JUNK = [None, True, -1, 1e308, 10**400, math.nan, "", "x" * 1000, [], {}, [[1]], {"a": 1}, {"sec": -1, "nanosec": 2e9}]


def places(value, at=()):
    """Every place in a message, as the keys and indices that lead there."""
    yield at
    inside = value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ()
    for key, one in inside:
        yield from places(one, (*at, key))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(60))
def test_no_message_stops_the_comparison(seed):
    rng = random.Random(seed)
    robot = rng.choice([Arm, Base])(seed)
    robot.rate, robot.urdf = 50.0, rng.choice([None, "<robot/>", 7])

    def spoil(topic, message):
        at = rng.choice(list(places(message)))
        if not at or rng.random() < 0.7:
            return message
        inner = message
        for key in at[:-1]:
            inner = inner[key]
        inner[at[-1]] = rng.choice(JUNK)
        return message

    robot.mangle = spoil
    contract = robot.contract()
    assert contract.refused
    json.dumps(contract.to_json(), allow_nan=False)


# ---- the checkpoint's side


@pytest.fixture(scope="module")
def pick():
    env = make_env("bam/pick-v0")
    yield Checkpoint.open(PICK), env
    env.close()


def test_a_checkpoint_fits_its_environment(pick):
    rows = [(one.what, one.expected, one.found, one.verdict) for one in fit_checks(*pick)]
    assert rows == [
        ("environment", "bam/pick-v0", "bam/pick-v0", "ok"),
        ("observation space", "Box [18]", "Box [18]", "ok"),
        ("action space", "Box [5]", "Box [5]", "ok"),
        ("signals", "50 names and units", "50 names and units", "ok"),
        ("period [s]", "0.05", "0.05", "ok"),
    ]


def relabelled(signals):
    signals = copy.deepcopy(signals)
    signals["command"][1], signals["command"][2] = signals["command"][2], signals["command"][1]
    return signals


def in_degrees(signals):
    signals = copy.deepcopy(signals)
    signals["state"][0]["unit"] = "deg"
    return signals


@pytest.mark.parametrize(
    ("name", "change", "row"),
    [
        ("period", lambda _: 0.1, ("period [s]", "0.1", "0.05")),
        ("signals", relabelled, ("signals.command[1].name", '"elbow_joint"', '"shoulder_lift_joint"')),
        ("signals", in_degrees, ("signals.state[0].unit", '"deg"', '"rad"')),
        ("action_space", lambda space: {**space, "shape": [6]}, ("action space.shape[0]", "6", "5")),
        ("observation_space", lambda space: {**space, "shape": [3, 4]}, ("observation space.shape", "[3, 4]", "[18]")),
    ],
)
def test_another_checkpoint_is_refused_by_the_right_line(pick, name, change, row):
    checkpoint, env = pick
    manifest = replace(checkpoint.manifest, **{name: change(getattr(checkpoint.manifest, name))})
    other = SimpleNamespace(manifest=manifest)
    wrong = [(one.what, one.expected, one.found) for one in fit_checks(other, env) if one.verdict == "refused"]
    assert wrong == [row]


# ---- the robot's description


def test_the_kinematics_of_a_urdf():
    urdf = read_urdf(urdf_of(UR5E_GRIPPER))
    position, rotation = urdf.pose("base_link", "tool0", dict(zip(UR_JOINTS, JOINTS, strict=True)))
    flange, axes = UR5E_GRIPPER.flange_pose(JOINTS[None])
    np.testing.assert_allclose(position, flange[0], atol=1e-12)
    np.testing.assert_allclose(rotation, axes[0], atol=1e-12)
    assert urdf.pose("base_link", "camera", {}) is None
    assert urdf.pose("base_link", "tool0", {}) is None


@pytest.mark.parametrize(
    "text",
    [
        None,
        "no xml",
        "<robot><joint name='a'/></robot>",
        "<robot><joint name='a'><parent link='a'/><child link='b'/><origin xyz='1 2'/></joint></robot>",
        '<!DOCTYPE robot [<!ENTITY a "b">]><robot>&a;</robot>',
        "x" * 9_000_000,
    ],
)
def test_what_is_no_urdf(text):
    with pytest.raises(ProtocolError, match=r"^the robot's description is no URDF"):
        read_urdf(text)


def test_a_urdf_whose_links_form_a_circle_has_no_pose():
    joint = "<joint name='{0}' type='fixed'><parent link='{1}'/><child link='{2}'/></joint>"
    circle = "".join(joint.format(*one) for one in ("xab", "yba"))
    assert read_urdf(f"<robot>{circle}</robot>").pose("base_link", "a", {}) is None


# ---- described arms


def described_urdf(arm, lengths=1.0):
    """A described arm as a URDF, its lengths changed by a factor."""
    rows = []
    for number, row in enumerate(arm.joints):
        axis, xyz = " ".join(map(repr, row.axis)), " ".join(repr(lengths * one) for one in row.xyz)
        rows.append(
            f'<joint name="{row.name}" type="revolute"><parent link="l{number}"/><child link="l{number + 1}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy(row.matrix())}"/><axis xyz="{axis}"/>'
            f'<limit lower="{row.low!r}" upper="{row.high!r}"/></joint>'
        )
    rows.append(fixed(f"l{len(arm.joints)}", "hand_tcp", " ".join(map(repr, arm.tool.xyz)), rpy(arm.tool.matrix())))
    return f'<robot name="arm">{"".join(rows)}</robot>'


def rpy(matrix):
    """Roll, pitch and yaw of a pose."""
    pitch = -math.asin(max(-1.0, min(1.0, matrix[2, 0])))
    roll, yaw = math.atan2(matrix[2, 1], matrix[2, 2]), math.atan2(matrix[1, 0], matrix[0, 0])
    if abs(matrix[2, 0]) > 1 - 1e-9:  # roll and yaw turn about the same axis
        roll, yaw = math.atan2(-matrix[2, 0] * matrix[0, 1], -matrix[2, 0] * matrix[0, 2]), 0.0
    return f"{roll!r} {pitch!r} {yaw!r}"


def fixed(parent, child, xyz="0 0 0", rpy="0 0 0"):
    """A fixed joint of a URDF."""
    return (
        f'<joint name="to_{child}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/></joint>'
    )


def on_top_of(urdf, *joints):
    """The `urdf` with further joints."""
    return urdf.replace("</robot>", "".join(joints) + "</robot>")


def described(name, urdf, frame=""):
    arm = robot_model(name)
    letters = {"/robot_description": [Letter({"data": urdf}, BEGIN, 1)]}
    sources = [("object_position", ()), ("joint_position", arm.joint_names)]
    profile = SimpleNamespace(state=[SimpleNamespace(signal=one, frame=frame, names=names) for one, names in sources])
    inspection = SimpleNamespace(letters=letters, profile=profile)
    return list(described_checks(arm.spec(with_object=False), arm.chain, 0.02, inspection))


def found_in(name, urdf, frame=""):
    """What is found of the model, the mount and the tool, and the verdict."""
    lines = described(name, urdf, frame)
    return {line.what.split()[0]: (line.found, line.verdict) for line in lines if line.what.endswith("description")}


@pytest.mark.parametrize("name", ["fr3", "so101", "gen3", "xarm7"])
def test_the_urdf_of_a_described_arm_is_compared_axis_by_axis(name):
    arm = robot_model(name)
    *limits, same, mount, tool = described(name, described_urdf(arm))
    assert [one.what for one in limits] == [f"limits of {joint}" for joint in arm.joint_names]
    assert (same.what, same.found, same.fits) == ("kinematics in /robot_description", "as described", True)
    assert (mount.what, mount.found, mount.fits) == ("mount in /robot_description", "as described", True)
    assert (tool.expected, tool.found) == ("within 20 mm of the description's", "hand_tcp is 0 mm from it")
    *_, longer = described(name, described_urdf(arm, 1.1))
    assert not longer.fits
    assert longer.found.startswith("another arm or calibration: ")
    names = arm.joint_names
    mirrored = described_urdf(arm).replace('<axis xyz="0.0 0.0 1.0"/>', '<axis xyz="0.0 0.0 -1.0"/>', 1)
    assert f"{names[0]} and " in described(name, mirrored)[-1].found


def test_another_mount_is_refused():
    urdf = described_urdf(robot_model("fr3"))
    assert found_in("fr3", on_top_of(urdf, fixed("world", "l0", "1 2 0.8", "0 0 1")))["mount"] == ("as described", "ok")
    assert found_in("fr3", on_top_of(urdf, fixed("world", "l0", "0 0 1", "3.1416 0 0")))["mount"] == (
        "l0 is tilted by 180 degrees in world",
        "refused",
    )
    above = on_top_of(urdf, fixed("base_link", "l0", "0.05 0 0.8"))
    assert found_in("fr3", above)["mount"] == (
        "another mount: the axis of fr3_joint1 is 50 mm and 0 degrees off in base_link",
        "refused",
    )
    turned = on_top_of(urdf, fixed("table", "l0", "0 0 0", "0 0 1.5708"))
    assert found_in("fr3", turned)["mount"] == ("as described", "ok")
    assert found_in("fr3", turned, "table")["mount"] == (
        "another mount: the axis of fr3_joint2 is 0 mm and 90 degrees off in table",
        "refused",
    )
    rail = fixed("world", "l0").replace('type="fixed"', 'type="prismatic"')
    assert found_in("fr3", on_top_of(urdf, rail))["mount"] == ("l0 is on something that moves", "unknown")
    assert found_in("so101", urdf)["kinematics"] == (
        "another arm: shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll not in it",
        "refused",
    )


def test_another_tool_is_refused():
    arm = robot_model("xarm7")
    urdf = described_urdf(arm)
    flange = urdf.replace("hand_tcp", "flange")
    assert found_in("xarm7", flange)["tool"] == ("no link is called tool or *tcp*", "unknown")
    longer = urdf.replace(repr(arm.tool.xyz[2]), "0.25")
    assert found_in("xarm7", longer)["tool"] == ("another tool: hand_tcp is 78 mm from it", "refused")
    both = on_top_of(longer, fixed("l7", "grip"), fixed("grip", "tool", "0 0 0.18"))
    assert found_in("xarm7", both)["tool"] == ("tool is 8 mm from it", "ok")


@pytest.mark.parametrize("name", ["fr3", "so101", "gen3", "xarm7", "ur5e"])
def test_a_gripper_that_is_turned_is_refused(name):
    """By 90 degrees about its axis, which its fingers show, and over to a side, which its frame shows."""
    urdf = described_urdf(robot_model(name))

    def fingers(turn):
        place = f'<origin rpy="0 0 {turn}"/>'
        slide = f'<joint name="f" type="prismatic"><parent link="hand_tcp"/><child link="f"/>{place}</joint>'
        knuckle = f'<joint name="f" type="revolute"><parent link="hand_tcp"/><child link="f"/>{place}</joint>'
        knuckle = knuckle.replace("</joint>", '<axis xyz="0 1 0"/></joint>')
        return [found_in(name, on_top_of(urdf, one))["fingers"] for one in (slide, knuckle)]

    assert fingers(0.0) == fingers(math.pi) == [("0 degrees off", "ok")] * 2
    assert fingers(0.2) == [("11 degrees off", "ok")] * 2
    remedy = "the gripper is turned on the flange; turn it, or tool.quat of the description"
    assert fingers(math.pi / 2) == [(f"90 degrees off: {remedy}", "refused")] * 2
    own = rpy(robot_model(name).tool.matrix())
    aside = rpy(robot_model(name).tool.matrix() @ np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]))
    assert found_in(name, urdf)["tool"] == ("hand_tcp is 0 mm from it", "ok")
    assert found_in(name, aside.join(urdf.rsplit(own, 1)))["tool"] == (
        "another tool: hand_tcp is 0 mm from it, and points 90 degrees elsewhere",
        "refused",
    )
