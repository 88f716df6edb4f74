"""Grippers that are actions or services, and robots that have to be enabled before they take commands."""

import re
import threading
import time

import numpy as np
import pytest
import roslibpy

from bam_envs.core.errors import NotReady, ProtocolError, RemoteError
from bam_envs.core.location import LiveRobot
from bam_envs.core.robot import Initial
from bam_envs.live.building import live_robot
from bam_envs.live.diagnosis import Diagnosis
from bam_envs.live.robot_checks import robot_checks
from bam_envs.live.rosbridge_robot import RosbridgeRobot
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import JOINTS
from bam_envs.ros.codec import RobotInfo
from bam_envs.rosbridge.bus import ABORTED, SUCCEEDED
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.safety.gate import _clear

ARM, GRIPPER = "/arm/joint_trajectory", "/gripper/gripper_cmd"
ROW, START = np.zeros(1, np.int64), Initial({}, np.zeros(1, np.int64))
PROFILE = """
extends = "ur5e"
name = "mine"
readiness = []
identity = []

[[commands.goals]]
{way} = "/gripper/gripper_cmd"
type = "{type}"
labels = ["gripper_width"]
fields = ["{field}"]

[[commands.goals]]
topic = "/arm/joint_trajectory"
type = "trajectory_msgs/JointTrajectory"
labels = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
"""
ACTION = {"way": "action", "type": "control_msgs/GripperCommand", "field": "command.position"}
SERVICE = {"way": "service", "type": "mine_msgs/SetWidth", "field": "width"}
ENABLE = """
[[enable]]
service = "/arm/motion_enable"
type = "xarm_msgs/SetInt16ById"
request = {{ id = 8, data = 1 }}
field = "ret"
ready = 0
does = "enables the motors"

[[enable]]
service = "/arm/set_mode"
type = "xarm_msgs/SetInt16"
request = {{ data = 1 }}
field = "ret"
ready = 0
does = "lets the arm follow commands"
"""


@pytest.fixture
def profile(tmp_path):
    """Write a profile; its path."""

    def write(text="", **fields):
        path = tmp_path / "mine.toml"
        path.write_text((PROFILE + text).format(**(fields or ACTION)), encoding="utf-8")
        return path

    return write


@pytest.fixture
def connect():
    """Connect to a robot; a function that steps it without guards, to a width or by default to where it is."""
    robots = []

    def start(url, path, **options):
        robot = RosbridgeRobot(url, load_profile(path), **options)
        robots.append(robot)
        robot.connect()
        robot.enable()
        robot.reset(ROW, START)

        def step(width):
            command = robot.measure().command
            command[0, 6] = width
            robot.await_due()
            return robot.step(_clear(robot, command))

        step.robot = robot
        return step

    yield start
    for robot in robots:
        robot.close()


def positions(scripted):
    return [goal.values["command"]["position"] for goal in scripted.goals]


def ended(step, text):
    """The goal of the width 0 fails, and one of the next steps says so."""
    steps = (step(0.0) for _ in range(50))
    with pytest.raises(RemoteError) as raised:
        list(steps)
    assert str(raised.value) == text


def test_a_goal_is_sent_when_the_width_changes_beside_the_commands(server, robot_on, connect, profile):
    scripted = robot_on(server, profile())
    scripted.on_goal = lambda goal: None  # none ends by itself
    step = connect(server.url, profile())
    for width in (0.085, 0.085, 0.0845, 0.0, 0.0005, 0.05):
        step(width)
    step.robot.close()
    scripted.wait_for(lambda: len(scripted.canceled) == 3 and len(scripted.on(ARM)) == 7)  # the last one holds
    assert positions(scripted) == [0.085, 0.0, 0.05]
    assert scripted.canceled == scripted.goals  # by the next one, and by the end
    commands = [(topic, caller) for topic, caller, _ in scripted.commands if topic != "/bam/halt"]
    assert len({caller for topic, caller in commands if topic == GRIPPER}) == 1
    assert {caller for topic, caller in commands if topic == GRIPPER}.isdisjoint(
        caller for topic, caller in commands if topic == ARM
    )


def test_a_halt_cancels_what_runs_and_the_next_command_sends_it_again(server, robot_on, connect, profile):
    scripted = robot_on(server, profile())
    scripted.on_goal = lambda goal: None
    step = connect(server.url, profile())
    step(0.0)
    step.robot.halt()
    scripted.wait_for(lambda: scripted.canceled)
    scripted.on_goal = lambda goal: goal.end(SUCCEEDED, {})
    step(0.0)
    step(0.0)
    scripted.wait_for(lambda: len(scripted.goals) == 2)
    step.robot.halt()  # it is done
    step.robot.close()
    assert positions(scripted) == [0.0, 0.0]
    assert scripted.canceled == scripted.goals[:1]


def test_a_goal_that_fails_ends_the_motion_in_one_line_and_one_that_holds_something_does_not(
    server, robot_on, connect, profile
):
    scripted = robot_on(server, profile())
    scripted.on_goal = lambda goal: goal.end(ABORTED, {"stalled": True})
    step = connect(server.url, profile())
    for width in (0.0, 0.0, 0.05):
        step(width)
    scripted.on_goal = lambda goal: goal.end(ABORTED, {})
    action = f"{server.url}: the action {GRIPPER}"
    ended(step, f"{action} ended: its goal was aborted (gripper_width 0). Look at the gripper and its driver.")

    def reject(goal):
        raise RemoteError("The gripper is not calibrated.")

    scripted.on_goal = reject
    why = "refused its goal: The gripper is not calibrated"
    ended(step, f"{action} {why} (gripper_width 0). Look at the gripper and its driver.")


def test_goals_go_over_the_topics_of_actionlib_in_ros_1(lax, robot_on, connect, profile):
    server, goals, canceled = lax("ros1"), [], []

    def act(action):
        server.subscribe(f"{action.name}/goal", "", lambda message, caller: goals.append(message))
        server.subscribe(f"{action.name}/cancel", "", lambda message, caller: canceled.append(message["id"]))

    def end(identity, status):
        found = {"goal_id": {"id": identity}, "status": status}
        server.publish(f"{GRIPPER}/result", {"status": found, "result": {"stalled": False, "reached_goal": False}})

    server.act = act
    scripted = robot_on(server, profile())
    scripted.stamp = lambda: dict(zip(("secs", "nsecs"), divmod(time.time_ns(), 10**9), strict=True))
    step = connect(server.url, profile())
    step(0.0)
    step(0.05)
    server.wait_for(lambda frames: len(goals) == 2 and canceled)
    assert [goal["goal"] for goal in goals] == [{"command": {"position": 0.0}}, {"command": {"position": 0.05}}]
    first, second = (goal["goal_id"]["id"] for goal in goals)
    assert canceled == [first]
    declared = {one["topic"]: one["type"] for _, one in server.frames if one["op"] == "advertise"}
    assert declared[f"{GRIPPER}/goal"] == "control_msgs/GripperCommandActionGoal"
    assert declared[f"{GRIPPER}/cancel"] == "actionlib_msgs/GoalID"
    end("somebody else's", 4)
    end(first, 2)
    step(0.05)
    end(second, 4)
    text = f"{server.url}: the action {GRIPPER} ended: its goal was aborted (gripper_width 0.05). Look at the gripper"
    with pytest.raises(RemoteError, match=f"^{re.escape(text)}"):
        [step(0.05) for _ in range(50)]


def test_a_gripper_may_close_by_another_action(server, robot_on, connect, profile):
    closing = '{ action = "/gripper/grasp", type = "franka_msgs/Grasp", constants = { force = 9.0 } }'
    path = profile(way="action", type="franka_msgs/Move", field="width")
    path.write_text(path.read_text().replace('"width"]', f'"width"]\nclosing = {closing}'), encoding="utf-8")
    scripted = robot_on(server, path)
    scripted.on_goal = lambda goal: None
    step = connect(server.url, path)
    for width in (0.085, 0.0, 0.0, 0.05):
        step(width)
    step.robot.close()
    scripted.wait_for(lambda: len(scripted.canceled) == 3)
    assert [topic for topic, _, _ in scripted.commands if topic.startswith("/gripper")] == [
        *(GRIPPER, "/gripper/grasp", GRIPPER)
    ]
    assert [goal.values["width"] for goal in scripted.goals] == [0.085, 0.0, 0.05]
    assert scripted.goals[1].values["force"] == 9.0
    assert scripted.canceled == scripted.goals


@pytest.mark.parametrize("what", ["action", "service"])
def test_a_gripper_that_nobody_offers_is_refused(server, robot_on, profile, what):
    scripted = robot_on(server)
    path = profile(**(ACTION if what == "action" else SERVICE))
    robot = RosbridgeRobot(Endpoint(server.url, timeout=1.0), load_profile(path))
    with pytest.raises(ProtocolError) as raised:
        robot.connect()
    kind = ACTION["type"] if what == "action" else SERVICE["type"]
    assert str(raised.value) == (
        f"Nobody offers the {what} {GRIPPER} ({kind}), which takes gripper_width: start the gripper's driver, or "
        f"change `{what}` in the profile of mine."
    )
    assert scripted.commands == []


@pytest.mark.parametrize("user_ros", [False, True])
def test_a_robot_that_describes_itself_gets_goals_before_their_commands(server, robot_on, connect, profile, user_ros):
    scripted = robot_on(server, profile(), info=RobotInfo("mine", lockstep=True, period=0.05))
    ros = roslibpy.Ros(server.url, transport="asyncio") if user_ros else None
    if ros is not None:
        ros.run(10.0)
    scripted.on_goal = lambda goal: goal.end(SUCCEEDED, {})
    step = connect(server.url, profile(), ros=ros)
    for width in (0.0, 0.0, 0.05):
        step(width)
    assert [topic for topic, _, _ in scripted.commands] == [GRIPPER, ARM, ARM, GRIPPER, ARM]
    assert len({caller for _, caller, _ in scripted.commands}) == 1
    scripted.on_goal = lambda goal: goal.end(ABORTED, {})
    text = f"{server.url}: the action {GRIPPER} ended: its goal was aborted (gripper_width 0). "
    ended(step, f"{text}Look at the gripper and its driver.")
    step.robot.close()
    if ros is not None:
        ros.close()


def test_a_service_is_called_once_it_has_answered_with_the_newest_width(server, robot_on, connect, profile):
    entered, leave = threading.Event(), threading.Event()
    path = profile(**SERVICE)
    scripted = robot_on(server, path)
    scripted.respond = lambda request: (entered.set(), leave.wait(10.0), {"success": True})[2]
    step = connect(server.url, path)
    for width in (0.0, 0.02, 0.04, 0.06):  # the first is not answered yet
        step(width)
        assert entered.wait(10.0)
    leave.set()
    scripted.wait_for(lambda: len(scripted.on(GRIPPER)) == 2)
    assert [request["width"] for request in scripted.on(GRIPPER)] == [0.0, 0.06]
    scripted.respond = lambda request: {"success": False, "message": "no power"}
    why = f"{server.url}: the service {GRIPPER} failed: no power (gripper_width 0). Look at the gripper and its driver."
    ended(step, why)


def test_a_gripper_of_goals_moves_at_its_own_speed(server, robot_on, profile):
    scripted = robot_on(server, profile())
    with_goals = live_robot(server.url, profile=profile(), command="goals")
    assert with_goals.spec.command.max_rate[6] == np.inf
    assert load_profile("ur5e").spec().command.max_rate[6] < np.inf
    with_goals.connect()
    joints = scripted.signals["joint_position"][None].copy()
    command = with_goals.reset(ROW, Initial({"joint_position": joints}, ROW)).command
    command[0, 6] = 0.0
    with_goals.step(command)
    scripted.wait_for(lambda: positions(scripted)[-1:] == [0.0])
    with_goals.close()
    assert with_goals.report()["gripper speed"]["altered"] == 0


def test_nothing_moves_before_it_is_enabled_in_order(server, robot_on, profile):
    calls = []

    def answer(request, caller):
        calls.append(dict(request))
        return {"ret": results[len(calls) - 1], "message": "fault 23"}

    server.serve("/arm/motion_enable", "xarm_msgs/SetInt16ById", answer)
    scripted, path = robot_on(server, profile()), profile(ENABLE)
    robot = RosbridgeRobot(server.url, load_profile(path))
    robot.connect()
    with pytest.raises(NotReady) as raised:
        robot.reset(ROW, START)
    assert str(raised.value) == (
        f"{server.url}: not enabled: /arm/motion_enable, which enables the motors, has not been called. Once its "
        "operator agrees, call robot.enable(), which calls it; the programs ask the operator."
    )
    failed = "{}: {}, which {}, {}. Look at the robot's driver, {}. Nothing has moved."
    results = [9, 0, 0, 0]
    with pytest.raises(NotReady) as raised:
        robot.enable()
    why = ("enables the motors", "ret is 9, not 0: fault 23", "and try again")
    assert str(raised.value) == failed.format(server.url, "/arm/motion_enable", *why)
    with pytest.raises(NotReady) as raised:
        robot.enable()
    why = ("failed: Service /arm/set_mode does not exist", "or change it in the profile of mine")
    assert str(raised.value) == failed.format(server.url, "/arm/set_mode", "lets the arm follow commands", *why)
    server.serve("/arm/set_mode", "xarm_msgs/SetInt16", answer)
    assert [one.service for one in robot.enabling] == ["/arm/motion_enable", "/arm/set_mode"]
    robot.enable()
    robot.enable()  # once a connection
    assert calls == [{"id": 8, "data": 1}, {"id": 8, "data": 1}, {"id": 8, "data": 1}, {"data": 1}]
    robot.reset(ROW, START)
    assert (robot.enabling, scripted.commands) == ((), [])
    robot.close()
    assert len(robot.enabling) == 2


def test_a_diagnosis_lists_the_services_and_calls_none(server, robot_on, profile):
    scripted, path = robot_on(server, profile()), profile(ENABLE)
    calls = []
    server.serve("/arm/motion_enable", "xarm_msgs/SetInt16ById", lambda *call: calls.append(call))
    diagnosis = Diagnosis(LiveRobot(server.url, profile=path), seconds=0.3)
    found = {step.name: step.found for step in diagnosis.steps()}
    spec = diagnosis.robot.spec
    lines = {line.what: (line.expected, line.found, line.verdict) for line in robot_checks(spec, diagnosis.inspected)}
    diagnosis.close()
    assert found["command path"] == (
        "somebody takes the commands; the connection that halts is open; ready; nothing was sent; a program that moves "
        "it calls first, once its operator agrees: /arm/motion_enable (enables the motors), /arm/set_mode (lets the "
        "arm follow commands)"
    )
    assert lines[f"command {GRIPPER}"] == ("control_msgs/GripperCommand", "control_msgs/GripperCommand", "ok")
    assert (calls, scripted.commands) == ([], [])


JAW = """
extends = "ur5e"
name = "jaw"
readiness = []
identity = []

[[commands.all]]
topic = "/arm/joint_trajectory"
type = "trajectory_msgs/JointTrajectory"
labels = [{labels}, "gripper_width"]
"""


def test_a_jaw_in_the_message_of_its_arm_holds_what_it_holds_at_a_halt(server, robot_on, connect, profile, tmp_path):
    path = tmp_path / "jaw.toml"
    path.write_text(JAW.format(labels=str([*JOINTS])[1:-1]), encoding="utf-8")
    scripted = robot_on(server, path)
    step = connect(server.url, path)
    step(0.04)
    scripted.frozen = True  # an object is between the pads
    scripted.signals["gripper_width"][:] = 0.04
    step(0.02)
    count = len(scripted.commands)
    step.robot.halt()
    scripted.wait_for(lambda: any(topic == ARM for topic, _, _ in scripted.commands[count:]))
    held = next(message for topic, _, message in scripted.commands[count:] if topic == ARM)
    assert held["points"][0]["positions"][6] == 0.02


TWIST = """
extends = "mir100"
name = "base"
readiness = []
identity = []

[[commands.velocity]]
topic = "/cmd_vel"
type = "geometry_msgs/{}"
labels = ["linear_velocity", "angular_velocity"]
fields = ["{}linear.x", "{}angular.z"]
hold = "zero"
"""


@pytest.mark.parametrize(("there", "here"), [("TwistStamped", "Twist"), ("Twist", "TwistStamped")])
def test_a_drive_gets_the_twist_that_its_topic_has(server, robot_on, connect, tmp_path, there, here):
    """The profile has the other one, which a drive would ignore."""
    paths = {}
    for kind in (there, here):
        stamped = "twist." if kind.endswith("Stamped") else ""
        paths[kind] = tmp_path / f"{kind}.toml"
        paths[kind].write_text(TWIST.format(kind, stamped, stamped), encoding="utf-8")
    scripted = robot_on(server, paths[there])
    robot = RosbridgeRobot(server.url, load_profile(paths[here]))
    try:
        robot.connect()
        robot.reset(ROW, START)
        robot.await_due()
        robot.step(_clear(robot, np.array([[0.25, -0.5]])))
        scripted.wait_for(lambda: any(topic == "/cmd_vel" for topic, _, _ in scripted.commands))
        message = next(message for topic, _, message in scripted.commands if topic == "/cmd_vel")
        twist = message["twist"] if there == "TwistStamped" else message
        assert (twist["linear"]["x"], twist["angular"]["z"], "header" in message) == (0.25, -0.5, there != "Twist")
    finally:
        robot.close()
