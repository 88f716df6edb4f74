"""Profiles are checked on load: file and key are named, and the closest right one."""

from dataclasses import replace

import numpy as np
import pytest

from bam_envs.arms.description import robot_model
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import RobotState
from bam_envs.robots.base_description import base_model
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.profile import load_profile, profile_for, shipped_profiles
from bam_envs.robots.ur import ur_model, ur_spec
from bam_envs.robots.ur5e import JOINTS, arm_spec
from bam_envs.ros.codec import decode_command, decode_source, encode_sink, encode_state
from bam_envs.ros.messages import write_stamp
from tests.bam_envs.making import CART

OWN = """
name = "lift"
kind = "arm"
period = 0.02

[command]
labels = ["height"]
units = "m"
low = 0.0
high = 2
max_rate = 0.5

[[signals]]
name = "lift_height"
labels = ["height"]
units = ["m"]
low = 0
high = 2.0

[[state]]
signal = "lift_height"
topic = "/lift/joint_states"
type = "sensor_msgs/msg/JointState"
field = "position"
names = ["lift_joint"]
scale = 0.001

[[commands.position]]
topic = "/lift/command"
type = "std_msgs/Float64"
labels = ["height"]
fields = ["data"]
scale = 0.001
"""


@pytest.fixture
def write(tmp_path):
    """Write a profile; its path."""

    def write_file(text, name="mine.toml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write_file


def refusal(path):
    with pytest.raises(InvalidValue) as caught:
        load_profile(path)
    return str(caught.value).replace(str(path), "FILE")


def test_the_ur5e_whose_controller_interpolates():
    arms = ["franka_ros2", "ros2_kortex", "ros2_so_arm100", "xarm_ros2"]
    assert shipped_profiles() == sorted([*arms, "husky", "mir100", "ur5e", "ur5e_position", "ur5e_trajectory"])
    profile, held = load_profile("ur5e_trajectory"), load_profile("ur5e")
    assert profile.spec() == replace(held.spec(), name="ur5e_trajectory")
    assert (profile.state, profile.readiness, profile.limits) == (held.state, held.readiness, held.limits)
    assert [(sink.topic, sink.controller) for sink in profile.commands["trajectory"]] == [
        ("/gripper/commands", ""),
        ("/scaled_joint_trajectory_controller/joint_trajectory", "scaled_joint_trajectory_controller"),
    ]
    assert profile_for(FakeRobot().spec).name == "ur5e"


def test_the_ur5e_is_the_simulated_arm():
    profile, arm = load_profile("ur5e"), arm_spec("ur5e", with_object=True)
    assert profile.spec() == arm
    assert (profile.kind, profile.period, profile.max_age, profile.command_timeout) == ("arm", 0.05, 0.1, 0.1)
    assert [signal.name for signal in profile.signals[5:]] == ["tool_position", "tool_quaternion"]
    assert profile.source("joint_velocity").names == JOINTS
    position, trajectory = profile.sinks("position"), profile.sinks("trajectory")
    assert profile.sinks() == trajectory
    assert load_profile("ur5e_position").sinks() == position
    assert [sink.is_timed for sink in (position[1], trajectory[1])] == [False, True]
    assert [sink.is_named for sink in (position[0], position[1], trajectory[1])] == [True, False, True]
    assert [sink.topic for sink in position] == ["/gripper/commands", "/forward_position_controller/commands"]
    assert trajectory[1].topic == "/scaled_joint_trajectory_controller/joint_trajectory"
    assert [sink.hold for sink in position] == ["last", "measured"]


def test_the_mir100():
    profile = load_profile("mir100")
    assert profile.spec() == base_model("mir100").spec()
    assert (profile.kind, profile.period, profile.max_age, profile.command_timeout) == ("base", 0.1, 0.5, 0.5)
    sizes = {signal.name: len(signal.labels) for signal in profile.signals}
    assert sizes == {"base_pose": 3, "base_velocity": 2, "f_scan": 501, "b_scan": 511}
    assert {source.topic for source in profile.state} == {"/odom", "/robot_pose", "/f_scan", "/b_scan"}
    assert profile.sinks()[0].hold == "zero"
    assert [(mode, sinks[0].type) for mode, sinks in profile.commands.items()] == [
        ("velocity", "geometry_msgs/Twist"),
        ("stamped", "geometry_msgs/TwistStamped"),
    ]


def test_what_a_task_needs_is_measured():
    wanted = FakeRobot(with_object=False).spec
    assert load_profile("ur5e").spec(wanted).signals == wanted.signals
    with pytest.raises(InvalidValue) as caught:
        load_profile("mir100").spec(wanted)
    assert str(caught.value) == (
        "joint_position is needed, and mir100 measures only base_pose, base_velocity, f_scan, b_scan. "
        "Give its profile a [[state]] table for it."
    )


def test_a_task_may_take_a_part_of_the_commands():
    profile, wanted = load_profile("ur5e"), ur_spec(ur_model("ur10"), 0.1, with_object=False)
    spec, narrow = profile.spec(wanted), profile.narrowed(JOINTS)
    assert spec.command == narrow.command == profile.command.part(JOINTS)
    assert spec.command.labels == JOINTS
    assert spec.command.max_rate == (np.pi,) * 6
    assert spec.period == 0.1
    (_, trajectory), (_, arm) = profile.commands.values()
    assert dict(narrow.commands) == {"trajectory": (trajectory,), "position": (arm,)}
    assert narrow.sinks() == (trajectory,)
    assert list(narrow.sinks_by_address) == [arm.topic, trajectory.topic]
    assert replace(narrow, command=profile.command, commands=profile.commands) == profile
    assert profile.narrowed(profile.command.labels) is profile
    assert profile_for(wanted) == narrow
    turned = profile.narrowed(JOINTS[::-1])  # commands may come in another order
    assert turned.command.labels == JOINTS[::-1]
    assert turned.command.high == narrow.command.high[::-1]
    assert turned.sinks()[0].labels == JOINTS


def test_commands_that_it_does_not_take():
    profile = load_profile("mir100")
    for labels, told in (((*JOINTS[:2],), "shoulder_pan_joint, shoulder_lift_joint"), ((), "nothing")):
        with pytest.raises(InvalidValue) as caught:
            profile.narrowed(labels)
        assert str(caught.value) == (
            f"Commands are {told}, and mir100 takes linear_velocity, angular_velocity. Choose another profile."
        )
    base = replace(base_model("mir100").spec(), name="base")
    nothing = replace(base, command=profile.command.part(()))
    other = replace(base, command=replace(profile.command, labels=("linear_velocity", "lift")))
    for spec in (nothing, other):
        with pytest.raises(InvalidValue) as caught:
            profile_for(spec)
        assert str(caught.value) == (
            "No shipped profile takes the commands of base. Give its file: profile='my_robot.toml'."
        )


def test_no_message_is_cut_in_two():
    base = base_model("mir100").spec()
    spec = replace(base, command=base.command.part(("linear_velocity",)))
    with pytest.raises(InvalidValue) as caught:
        profile_for(spec)
    assert str(caught.value) == (
        "/cmd_vel takes linear_velocity, angular_velocity in one message, and angular_velocity is not commanded. "
        "Give the profile of mir100 a command mode with a topic for linear_velocity alone."
    )
    # A mode that would be cut is left out unless it is wanted.
    profile = load_profile("ur5e")
    gripper, arm = profile.sinks()
    whole = replace(arm, topic="/all", labels=profile.command.labels)
    two = replace(profile, commands={"whole": (whole,), "parts": (gripper, arm)})
    assert dict(two.narrowed(JOINTS, "parts").commands) == {"parts": (arm,)}
    wanted = ur_spec(ur_model("ur5"), 0.1, with_object=False)
    assert two.spec(wanted, "parts").command.labels == JOINTS
    for mode in (None, "whole"):
        with pytest.raises(InvalidValue, match=r"^/all takes "):
            two.spec(wanted, mode)


def test_unknown_names():
    with pytest.raises(UnknownName) as caught:
        load_profile("ur5")
    assert str(caught.value) == "Unknown robot profile 'ur5'. Did you mean 'ur5e'?"
    with pytest.raises(UnknownName) as caught:
        load_profile("ur5e").sinks("trajectories")
    assert str(caught.value) == "Unknown command mode of ur5e 'trajectories'. Did you mean 'trajectory'?"


def test_a_profile_of_ones_own(write):
    profile = load_profile(write(OWN))
    assert profile.spec().describe() == {
        "state": [{"name": "height", "unit": "m", "low": 0.0, "high": 2.0}],
        "command": [{"name": "height", "unit": "m", "low": 0.0, "high": 2.0}],
    }
    assert (profile.period, profile.max_age, profile.command.max_rate) == (0.02, 0.1, (0.5,))
    assert profile.source("lift_height").type == "sensor_msgs/JointState"
    assert profile.sinks()[0].names == ("height",)


def test_yaml(write):
    text = """
extends: ur5e
name: my arm
kind: arm
max_age: 0.2
limits: {joint_speed: 0.5}
rename: {/joint_states: /ur/joint_states}
ignore: [finger_joint, elbow_joint]
"""
    for name in ("mine.yaml", "mine.yml"):
        profile = load_profile(write(text, name))
        assert (profile.name, profile.max_age, profile.limits) == ("my arm", 0.2, {"joint_speed": 0.5})
        assert profile.source("joint_position").topic == "/ur/joint_states"
        assert profile.source("joint_position").ignore == ("finger_joint",)
        assert profile.source("gripper_width").ignore == ("finger_joint", "elbow_joint")
        assert profile.source("object_position").topic == "/object_pose"
        assert profile.source("object_position").ignore == ()
        np.testing.assert_array_equal(profile.command.low, load_profile("ur5e").command.low)


BAD = r"""
kind = "arm" -> kind = "leg" -> kind: expected 'arm' or 'base', found 'leg'
name = "lift"\n -> -> the key 'name' is missing
period = 0.02 -> perod = 0.02 -> unknown key 'perod'. Did you mean 'period'?
period = 0.02 -> period = nan -> period: expected a number above 0, found nan
period = 0.02 -> period = 0.02\ndead_man = 1e9 -> command_timeout: expected a number above 0 and at most 1, found
period = 0.02 -> -> give robot (a name of bam-robots list), or [command] with max_rate, and period.
period = 0.02 -> robot = "ur5" -> Unknown robot 'ur5'. Did you mean 'ur5e'?
max_rate = 0.5 -> -> command needs max_rate, and takes no name.
high = 2\n -> high = 0\n -> command: low must be below high.
units = "m" -> units = ["m", "m"] -> command: units must have 1 or 1 values, not 2.
labels = ["height"]\nunits -> labels = []\nunits -> command: labels must name at least one number.
signal = "lift_height" -> signal = "lift_hight" -> state[0]: Unknown signal 'lift_hight'. Did you mean 'lift_height'?
/lift/joint_states -> lift -> state[0]: topic: expected an absolute name such as /joint_states, found 'lift'
sensor_msgs/msg/JointState -> JointState -> state[0]: type: expected a message type such as sensor_msgs/JointState,
field = "position"\n -> -> state[0]: give either field (where the list is) or fields (where each number is).
names = ["lift_joint"] -> partial = true -> state[0]: partial and ignore need names.
["lift_joint"] -> ["a", "b"] -> state[0]: names must name the 1 numbers of field, not 2.
scale = 0.001\n\n[[c -> scale = 0\n\n[[c -> state[0]: scale must not be 0.
scale = 0.001\n\n[[c -> scale = [1, 2]\n\n[[c -> state[0]: scale must have 1 or 1 values, not 2.
scale = 0.001\n\n[[c -> skip = 3\n\n[[c -> state[0]: skip: expected a list of 2 whole numbers of at least 0, found 3
scale = 0.001\n\n[[c -> within = [2, 1]\n\n[[c -> state[0]: within must be two numbers, the least first, not [2.0, 1.0].
scale = 0.001\n\n[[c -> max_age = 9\n\n[[c -> state[0]: max_age: expected a number above 0 and at most 1, found 9.0
fields = ["data"] -> -> commands.position[0]: std_msgs/Float64 needs fields; only sensor_msgs/JointState, std_msgs/
labels = ["height"]\nfields -> labels = ["hight"]\nfields -> commands.position: labels must be height, not hight.
fields = ["data"] -> hold = "first" -> commands.position[0]: hold: expected 'measured', 'last' or 'zero', found 'first'
sensor_msgs/msg/JointState" -> a/B"\nframe = "map" -> state[0]: frame needs a type with a header, such as a/BStamped.
[command] -> [limits]\njoint_sped = 1\n[command] -> limits: Unknown limit 'joint_sped'. Did you mean 'joint_speed'?
[command] -> [limits]\ntool_speed = 25\n[command] -> limits: The limit tool_speed of a live robot must be 0.005 to 1 m/s
[command] -> [rename]\n"/lift/sta" = "/s"\n[command] -> rename: Unknown topic '/lift/sta'. Did you mean '/lift/joint_s
[command] -> [rename]\n"/lift/command" = "c"\n[command] -> rename./lift/command: expected an absolute name such as
[command] -> [[cameras]]\nname = "c"\ntopic = "/c"\ntype = "a/B"\n[command] -> cameras[0]: type: expected 'sensor_msgs/C
[command] -> [[readiness]]\ntopic = "/c"\ntype = "a/B"\nfield = "f"\n[command] -> readiness[0]: give either ready (the
topic = "/lift/command" -> -> commands.position[0]: give one of topic, action, service.
topic = "/lift/command" -> topic = "/a"\nservice = "/b" -> commands.position[0]: give one of topic, action, service.
topic = "/lift/command" -> action = "/a" -> commands.position: the last table must have a topic, because it completes
topic = "/lift/command" -> topic = "/a"\nclosing = { action = "/b", type = "c/D" } -> commands.position[0]: closing
topic = "/lift/command" -> action = "/a"\nhold = "zero" -> commands.position[0]: hold of an action or a service is last
fields = ["data"] -> constants = { a = [1] } -> commands.position[0]: constants.a: expected a finite number or true or f
[command] -> [[enable]]\nservice = "/on"\ntype = "a/B"\n[command] -> enable[0]: the key 'does' is missing
[command] -> [[enable]]\nservice = "on"\ntype = "a/B"\ndoes = "c"\n[command] -> enable[0]: service: expected an absolute
"""
"""What is replaced in `OWN`, by what, and how the error begins, behind the name of the file."""


@pytest.mark.parametrize("case", BAD.strip().splitlines())
def test_bad_profiles(write, case):
    old, new, message = (part.strip(" ").replace("\\n", "\n") for part in case.split("->"))
    assert old in OWN
    assert refusal(write(OWN.replace(old, new, 1))).startswith(f"FILE: {message}")


def test_what_comes_twice_or_not_at_all(write):
    signals, state, commands = (OWN.index(f"[[{name}") for name in ("signals", "state", "commands"))
    assert refusal(write(OWN + OWN[commands:].replace("/lift/command", "/lift/other"))) == (
        "FILE: commands.position: the label 'height' comes twice."
    )
    assert refusal(write(OWN + OWN[state:commands])) == "FILE: state[1]: lift_height has a source already."
    assert refusal(write(OWN + OWN[signals:state])) == "FILE: the signal 'lift_height' comes twice."
    assert refusal(write(OWN[:commands])) == (
        "FILE: at least one command mode is needed, such as [[commands.position]]."
    )
    assert refusal(write(OWN[:state] + OWN[commands:])) == "FILE: at least one [[state]] table is needed."


def test_files(write, tmp_path):
    missing = tmp_path / "other.toml"
    (tmp_path / "folder.toml").mkdir()
    assert refusal(missing) == (
        "There is no robot profile FILE. Give the path of a file, or one of: franka_ros2, husky, mir100, "
        "ros2_kortex, ros2_so_arm100, ur5e, ur5e_position, ur5e_trajectory, xarm_ros2."
    )
    assert refusal(write("name =")).startswith("FILE is not TOML: ")
    for text in ("a: [", "a: 2020-13-45", "a: !!int b", "[" * 1000):
        assert refusal(write(text, "b.yaml")).startswith("FILE is not YAML: ")
    told = "FILE is not YAML: mapping values are not allowed here (at line 2, column 3). Correct it there."
    assert refusal(write("a: b\nc d: e: f".replace("c d", " c"), "b.yaml")) == told
    assert refusal(write("- 1", "b.yaml")) == "FILE: expected a table of named values, found [1]"
    assert (
        refusal(write("state: 3\nname: a\nkind: arm\nrobot: ur5e", "b.yaml"))
        == "FILE: state: expected a list of tables of named values, found 3"
    )
    with pytest.raises(UnknownName, match=r"Did you mean 'ur5e'\?"):
        load_profile(write('extends = "ur5"'))
    assert refusal(write("extends = 3")) == "FILE: extends: expected non-empty text, found 3"
    assert refusal(write('extends = "b.toml"')) == (
        "FILE: extends must be a shipped profile (franka_ros2, husky, mir100, ros2_kortex, ros2_so_arm100, ur5e, "
        "ur5e_position, ur5e_trajectory, xarm_ros2), not 'b.toml'."
    )
    assert refusal(tmp_path / "folder.toml") == (
        "The robot profile FILE cannot be read: [Errno 21] Is a directory: 'FILE'."
    )


def test_what_is_sent_on_a_topic():
    profile = load_profile("ur5e")
    (gripper, arm), (_, trajectory) = profile.commands.values()
    assert profile.sinks_by_address == {sink.topic: sink for sink in (gripper, arm, trajectory)}
    assert profile.sinks_by_address[gripper.topic] is gripper


GRIPPER = """
extends = "ur5e"
readiness = []

[[commands.action]]
action = "/gripper/gripper_cmd"
type = "control_msgs/action/GripperCommand"
labels = ["gripper_width"]
fields = ["command.position"]
scale = -0.1
offset = 0.085
constants = { "command.max_effort" = 40.0 }

[[commands.action]]
topic = "/arm/joint_trajectory"
type = "trajectory_msgs/JointTrajectory"
labels = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]

[[enable]]
service = "/arm/motion_enable"
type = "xarm_msgs/srv/SetInt16ById"
request = { id = 8, data = 1 }
field = "ret"
ready = 0
does = "enables the motors"
"""


def test_a_gripper_may_be_an_action_and_a_robot_may_have_to_be_enabled(write):
    profile = load_profile(write(GRIPPER + '[rename]\n"/gripper/gripper_cmd" = "/g"\n"/arm/motion_enable" = "/on"\n'))
    gripper, _ = profile.sinks("action")
    assert (gripper.topic, gripper.action, gripper.address) == ("", "/g", "/g")
    assert (gripper.type, gripper.hold, gripper.tag) == ("control_msgs/GripperCommand", "last", False)
    assert profile.sinks_by_address["/g"] is gripper
    command = np.append(np.zeros(6), 0.045)
    address, _, goal = encode_sink(gripper, profile.spec(), command, None)
    assert (address, goal) == ("/g", {"command": {"max_effort": 40.0, "position": pytest.approx(0.4)}})
    decoded = decode_command(profile, profile.spec(), "/g", goal)
    assert (decoded.places, decoded.values) == ([6], pytest.approx([0.045]))
    (enable,) = profile.enable
    assert (enable.service, enable.type, enable.request) == ("/on", "xarm_msgs/SetInt16ById", {"id": 8, "data": 1})
    assert enable.trouble({"ret": 0, "message": ""}) is None
    assert enable.trouble({"ret": 9, "message": "not ready"}) == "ret is 9, not 0: not ready"
    assert enable.trouble({}) == "ret is missing, not 0"


def test_a_frame_of_another_name(write):
    profile = load_profile(write('extends = "ur5e"\n[frames]\n"/object_pose" = "world"\n'))
    assert [profile.source(f"object_{name}").frame for name in ("position", "quaternion")] == ["world", "world"]
    assert profile.source("tool_position").frame == "base"
    other = write('extends = "ur5e"\n[frames]\n"/joint_states" = "world"\n')
    assert refusal(other) == (
        "FILE: frames: Unknown topic with a frame '/joint_states'. "
        "Choose from: /object_pose, /tcp_pose_broadcaster/pose."
    )
    unchecked = load_profile(write('extends = "ur5e"\n[frames]\n"/object_pose" = ""\n'))
    assert unchecked.source("object_position").frame == ""


@pytest.mark.parametrize(
    ("name", "mode", "period", "lag"),
    [
        ("ur5e", None, 0.05, 0.125),
        ("ur5e", "position", 0.05, 0.1),
        ("ur5e_trajectory", None, 0.05, 0.125),
        ("ur5e_trajectory", None, 0.1, 0.15),
        ("mir100", None, 0.1, 0.3),
    ],
)
def test_what_takes_longer_is_farther_behind(name, mode, period, lag):
    profile = load_profile(name)
    assert profile.spec(replace(profile.spec(), period=period), mode).lag == pytest.approx(lag)


def test_a_renamed_command_is_another_controllers(write):
    topic = "/scaled_joint_trajectory_controller/joint_trajectory"
    profile = load_profile(write(f'extends = "ur5e"\nreadiness = []\n[rename]\n"{topic}" = "/left/commands"\n'))
    assert [(sink.topic, sink.controller) for sink in profile.sinks()] == [
        ("/gripper/commands", ""),
        ("/left/commands", ""),
    ]
    assert profile.sinks("position")[1].controller == "forward_position_controller"
    assert profile.readiness == ()
    assert [sink.controller for sink in load_profile("ur5e").sinks()] == ["", "scaled_joint_trajectory_controller"]


def test_the_former_name_of_the_command_timeout(write):
    assert load_profile(write('extends = "ur5e"\ndead_man = 0.2\n')).command_timeout == 0.2
    assert load_profile(write('extends = "ur5e"\ncommand_timeout = 0.3\n')).command_timeout == 0.3
    assert refusal(write('extends = "ur5e"\ncommand_timeout = 0.3\ndead_man = 0.2\n')) == (
        "FILE: command_timeout comes twice: dead_man is its former name. Give one of them."
    )


def test_a_profile_of_a_described_arm_has_its_signals(write):
    text = """
name = "cell"
kind = "arm"
robot = "so101"
[[state]]
signal = "joint_position"
topic = "/joint_states"
type = "sensor_msgs/JointState"
field = "position"
names = ["1", "2", "3", "4", "5"]
[[commands.position]]
topic = "/commands"
type = "std_msgs/Float64MultiArray"
labels = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper_width"]
"""
    profile, arm = load_profile(write(text)), robot_model("so101").spec(with_object=True)
    assert (profile.command, profile.signals) == (arm.command, arm.signals[:1])


@pytest.mark.parametrize(("model", "namespace"), [("turtlebot4", ""), ("husky", "/sensors/lidar2d_0")])
def test_bases_are_driven_by_stamped_twists(model, namespace):
    spec, profile = base_model(model).spec(), profile_for(base_model(model).spec())
    assert load_profile(model) == profile
    assert (profile.name, profile.kind, profile.spec(), profile.body) == (model, "base", spec, spec.body)
    odometry = "/platform/odom" if namespace else "/odom"
    assert [source.topic for source in profile.state] == [odometry, odometry, f"{namespace}/scan"]
    (sink,) = profile.sinks("velocity")
    assert (sink.topic, sink.type) == ("/cmd_vel", "geometry_msgs/TwistStamped")
    assert sink.fields == ("twist.linear.x", "twist.angular.z")
    constants, laser = profile.state[2].constants, base_model(model).lasers[0]
    assert (constants["angle_min"], constants["range_max"]) == (laser.angles[0], laser.range[1])
    step = (laser.angles[1] - laser.angles[0]) / (laser.beams - 1)
    assert constants["angle_increment"] == pytest.approx(step, abs=1e-12)


def test_a_users_own_base(write):
    """Its usual topics, and those of a profile with another name and namespace."""
    profile = profile_for(base_model(CART).spec())
    assert [source.fields for source in profile.state if source.signal == "base_velocity"] == [
        ("twist.twist.linear.x", "twist.twist.linear.y", "twist.twist.angular.z")
    ]
    own = load_profile(write('extends = "husky"\nname = "ours"\n[rename]\n"/cmd_vel" = "/ours/cmd_vel"'))
    assert (own.command, own.body) == (base_model("husky").spec().command, base_model("husky").body)
    assert own.sinks("velocity")[0].topic == "/ours/cmd_vel"
    assert refusal(write('extends = "husky"\nkind = "arm"')) == (
        "FILE: kind is arm, and its commands are those of the other kind, arm or base."
    )


def test_a_described_arm_has_the_usual_topics_where_no_profile_is_shipped():
    arm = replace(robot_model("fr3"), name="fr3b")
    profile = profile_for(arm.spec(with_object=True))
    assert [source.topic for source in profile.state] == [
        *["/joint_states"] * 2,
        "/gripper/joint_states",
        *["/object_pose"] * 2,
    ]
    gripper, trajectory = profile.commands["trajectory"]
    assert (gripper.topic, trajectory.topic) == ("/gripper/commands", "/joint_trajectory_controller/joint_trajectory")
    assert (trajectory.type, trajectory.names) == ("trajectory_msgs/JointTrajectory", arm.joint_names)
    assert [camera.name for camera in profile.cameras] == ["front", "wrist", "front_depth", "wrist_depth"]


JTC = "joint_trajectory_controller"


@pytest.mark.parametrize(
    ("name", "profile", "states", "modes"),
    [
        (
            "fr3",
            "franka_ros2",
            {"/joint_states", "/object_pose"},
            {
                "trajectory": ["/franka_gripper/move", "/fr3_arm_controller/joint_trajectory"],
                "crisp": ["/franka_gripper/move", "/target_joint"],
            },
        ),
        (
            "xarm7",
            "xarm_ros2",
            {"/xarm/joint_states", "/object_pose"},
            {"trajectory": ["/xarm_gripper/gripper_action", "/xarm7_traj_controller/joint_trajectory"]},
        ),
        (
            "gen3",
            "ros2_kortex",
            {"/joint_states", "/object_pose"},
            {
                "trajectory": [
                    "/robotiq_gripper_controller/gripper_cmd",
                    "/joint_trajectory_controller/joint_trajectory",
                ]
            },
        ),
        (
            "so101",
            "ros2_so_arm100",
            {"/joint_states", "/object_pose"},
            {
                "trajectory": [f"/{JTC}/joint_trajectory"],
                "position": ["/forward_position_controller/commands"],
            },
        ),
    ],
)
def test_shipped_arms_have_the_names_of_their_drivers(name, profile, states, modes):
    arm = robot_model(name)
    shipped = profile_for(arm.spec(with_object=True))
    assert (shipped.name, shipped.robot, shipped) == (profile, name, load_profile(profile))
    assert {source.topic for source in shipped.state} == states
    assert {mode: [sink.address for sink in sinks] for mode, sinks in shipped.commands.items()} == modes
    spec = arm.spec(with_object=True)
    assert (shipped.command, shipped.signals) == (spec.command, spec.signals)
    numbers = {one.name: np.linspace(one.low, one.high, 3)[1:2] + 0.01 for one in spec.signals}
    state = RobotState(numbers, np.zeros(1), np.zeros((1, len(spec.command.labels))))
    messages = [
        one for _, kind, one in encode_state(shipped, state, 0, write_stamp(1.0)) if kind.endswith("JointState")
    ]
    for source in shipped.state[:3]:  # each finds its numbers in the messages of its driver
        (message,) = (one for one in messages if source.names[0] in one["name"])
        read = decode_source(source, message, len(source.names))
        np.testing.assert_allclose(read, numbers[source.signal][0], atol=1e-12)
    assert all(message["name"] == sorted(message["name"]) for message in messages)


def test_a_profile_beside_the_descriptions_comes_first(write, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robots" / "profiles").mkdir(parents=True)
    (tmp_path / "robots" / "profiles" / "gen3.toml").write_text('extends = "ros2_kortex"\nname = "cell 4"\n')
    spec = robot_model("gen3").spec(with_object=True)
    assert profile_for(spec) == replace(load_profile("ros2_kortex"), name="cell 4")
    (tmp_path / "robots" / "profiles" / "gen3.toml").write_text('extends = "kortex"\n')
    with pytest.raises(UnknownName, match="Unknown robot profile 'kortex'"):
        profile_for(spec)
