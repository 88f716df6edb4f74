"""``bam-robots profile``: reads the profile of an arm from its live graph."""

import contextlib
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import pytest

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.robot_models import SHIPPED
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.robots.profile import load_profile
from bam_envs.rosbridge.bus import Action
from bam_envs.rosbridge.server import BridgeServer
from bam_train.cli.arms.bam_robots import main
from tests.bam_envs.live.conftest import LaxServer

GRIP, TRAJECTORY = "control_msgs/GripperCommand", "trajectory_msgs/JointTrajectory"


@pytest.fixture
def served(tmp_path, monkeypatch):
    """Serve an arm; the address. Files are written into a folder of this test."""
    monkeypatch.chdir(tmp_path)
    running = []

    def start(name, env_id="bam/pick-v0"):
        env = gym.make(env_id, robot_model=name, disable_env_checker=True)
        running.append(ServedEnvironment(env, ServeOptions(port=0)))
        return running[-1].__enter__().bus.url

    yield start
    for one in running:
        one.close()


@pytest.mark.parametrize(
    ("name", "shipped"),
    [
        ("ur5e", "ur5e"),
        ("fr3", "franka_ros2"),
        ("xarm7", "xarm_ros2"),
        ("gen3", "ros2_kortex"),
        ("so101", "ros2_so_arm100"),
    ],
)
def test_the_graph_of_a_served_arm_gives_its_shipped_profile(run, served, tmp_path, name, shipped):
    status, out, err = run(main, "profile", name, "--from", served(name))
    assert (status, err) == (0, "")
    assert out.splitlines()[0] == f"wrote robots/profiles/{name}.toml:"
    expected = load_profile(shipped)
    read = load_profile(tmp_path / "robots" / "profiles" / f"{name}.toml")
    assert read.commands == expected.commands
    assert read.state == expected.state
    assert replace(read, name=expected.name) == expected


@pytest.mark.parametrize("name", ["mir100", "husky", "turtlebot4"])
def test_the_graph_of_a_served_base_gives_its_profile(run, served, tmp_path, name):
    expected = load_profile(name)
    status, out, err = run(main, "profile", name, "--from", served(name, "bam/avoidance-v0"))
    assert (status, err) == (0, "")
    assert replace(load_profile(tmp_path / "robots" / "profiles" / f"{name}.toml"), robot=expected.robot) == expected
    assumed = ["  its drive is taken to stop 0.5 s after the last command (watchdog)"] * (name == "turtlebot4")
    assert [line for line in out.splitlines() if "watchdog" in line] == assumed


def lab(name, of, *replaced):
    """Describe `of` with other numbers as `name`."""
    text = (SHIPPED / f"{of}.toml").read_text(encoding="utf-8").replace(f'name = "{of}"', f'name = "{name}"', 1)
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    Path("robots").mkdir(exist_ok=True)
    Path("robots", f"{name}.toml").write_text(text, encoding="utf-8")


def test_a_robot_of_another_name_is_refused(run, served, tmp_path):
    url = served("gen3")
    lab("lab", "gen3")
    refused = run(main, "profile", "lab", "--from", url)
    assert refused == (
        1,
        "",
        f"bam-robots profile: {url}: the robot there calls itself gen3, and lab was named. Give bam-robots profile "
        f"gen3 --from {url}, or --force if it is lab.\n",
    )
    assert not (tmp_path / "robots" / "profiles").exists()
    assert run(main, "profile", "lab", "--from", url, "--force")[0] == 0


def test_an_arm_of_another_urdf_is_refused(run, served, tmp_path):
    usual = (KNUCKLE, "gripper_width")
    lab("lab", "gen3", ("-0.21038", "-0.24038"), usual)
    url = served("lab")
    lab("lab", "gen3", usual)
    status, out, err = run(main, "profile", "lab", "--from", url)
    assert (status, out) == (1, "")
    assert err == (
        f"bam-robots profile: {url}: kinematics in /robot_description: another arm or calibration: joint_1 and "
        "joint_4, joint_1 and joint_5, joint_1 and joint_6 are not as in its description, lab. Name the arm that is "
        "there, or give --force.\n"
    )


JTC, FORWARD = (
    "joint_trajectory_controller/JointTrajectoryController",
    "forward_command_controller/ForwardCommandController",
)
JOINTS = [f"joint_{number}" for number in range(1, 8)]
KNUCKLE = "robotiq_85_left_knuckle_joint"


def controller(name, kind=JTC, state="active", joints=JOINTS, what="position"):
    return {
        "name": name,
        "type": kind,
        "state": state,
        "required_command_interfaces": [f"{joint}/{what}" for joint in joints],
    }


@pytest.fixture
def graph(tmp_path, monkeypatch):
    """Offer a graph for a Gen3; the address. Its joint states are latched."""
    monkeypatch.chdir(tmp_path)
    servers = []

    def start(controllers, *, joints=(*JOINTS, KNUCKLE), actions=(("/gripper/gripper_cmd", GRIP),), topics=()):
        servers.append(server := BridgeServer(port=0).start())
        if joints:
            server.advertise("/joint_states", "sensor_msgs/JointState", latch=True)
            values = [0.0] * len(joints)
            server.publish("/joint_states", {"name": list(joints), "position": values, "velocity": values})
        for row in controllers or ():
            trajectory = "TrajectoryController" in row["type"]
            name, kind = ("joint_trajectory", TRAJECTORY) if trajectory else ("commands", "std_msgs/Float64MultiArray")
            server.subscribe(f"/{row['name']}/{name}", kind, lambda message, caller: None)
        if controllers is not None:
            kind = "controller_manager_msgs/ListControllers"
            server.serve("/controller_manager/list_controllers", kind, lambda *_: {"controller": list(controllers)})
        for name, kind in topics:
            server.subscribe(name, kind, lambda message, caller: None)
        for name, kind in actions:
            server.act(Action(name, kind, lambda goal: None, lambda goal: None))
        return server.url

    yield start
    for one in servers:
        one.close()


def read(run, url, name="gen3"):
    status, out, err = run(main, "profile", name, "--from", url)
    assert (status, err) == (0, "")
    profile = load_profile(f"robots/profiles/{name}.toml")
    assert load_profile(name) == profile
    return profile, out


def test_an_arm_with_a_prefix_takes_the_active_controller(run, graph):
    """An inactive controller of the same kind is left out, and one of velocities."""
    joints = [f"left_{name}" for name in JOINTS]
    rows = [
        controller("slow_controller", state="inactive", joints=joints),
        controller("left_controller", joints=joints),
        controller("velocities", FORWARD, "inactive", joints, "velocity"),
        controller("positions", FORWARD, "inactive", joints[::-1]),
    ]
    profile, out = read(run, graph(rows, joints=("wheel", *joints, f"left_{KNUCKLE}")))
    assert profile.source("joint_position").names == tuple(joints)
    assert "wheel" in profile.source("joint_velocity").ignore
    assert list(profile.commands) == ["trajectory", "position"]
    gripper, arm = profile.sinks()
    assert (arm.topic, arm.labels, arm.names) == ("/left_controller/joint_trajectory", tuple(JOINTS), tuple(joints))
    assert (gripper.action, gripper.fields) == ("/gripper/gripper_cmd", ("command.position",))
    assert (gripper.scale, gripper.offset) == ((-0.10625,), (0.085,))
    assert profile.sinks("position")[1].names == tuple(joints[::-1])
    assert out.splitlines()[-4:-1] == [
        "notes, written at its head:",
        "  slow_controller takes the same joints, and is not active: left_controller is used",
        "  positions is not active now",
    ]


def test_what_nothing_tells_is_a_comment_with_a_default(run, graph, tmp_path):
    text = (SHIPPED / "gen3.toml").read_text(encoding="utf-8")
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "lab.toml").write_text(text.replace('"gen3"', '"lab"').replace(KNUCKLE, "jaw"))
    url = graph(None, joints=(*JOINTS, "jaw"), topics=[("/arm_controller/joint_trajectory", TRAJECTORY)])
    profile, out = read(run, url, "lab")
    assert [sink.address for sink in profile.sinks()] == ["/gripper/gripper_cmd", "/arm_controller/joint_trajectory"]
    assert (profile.robot, profile.controllers, profile.source("gripper_width").scale) == ("lab", "", (1.0,))
    written = (tmp_path / "robots" / "profiles" / "lab.toml").read_text()
    assert "\n# scale = 1.0   # width in m = position of the joint x scale + offset\n# offset = 0.0\n" in written
    assert '# controllers = "/controller_manager/list_controllers"   # nothing there lists them\n' in written
    assert out.splitlines()[-3:] == [
        "  jaw is taken for the gripper's width in m; else give its source scale and offset",
        "  nothing lists the controllers: which joints each takes is assumed",
        "  nobody publishes /object_pose (geometry_msgs/PoseStamped), which picking needs",
    ]


def test_a_gripper_whose_action_has_the_message_of_a_joint(run, graph):
    parallel = "control_msgs/ParallelGripperCommand"
    url = graph([controller("left_controller")], actions=[("/gripper/gripper_cmd", parallel)])
    gripper, _ = read(run, url)[0].sinks()
    assert (gripper.type, gripper.fields) == (parallel, ("command.position[0]",))
    assert (gripper.constants, gripper.scale) == ({"command.name[0]": KNUCKLE}, (-0.10625,))


def test_an_action_of_ros_1_is_found_by_the_topic_of_its_goals(run, graph):
    goals = [("/gripper/gripper_cmd/goal", f"{GRIP}ActionGoal")]
    gripper, _ = read(run, graph([controller("left_controller")], actions=(), topics=goals))[0].sinks()
    assert (gripper.action, gripper.type, gripper.scale) == ("/gripper/gripper_cmd", GRIP, (-0.10625,))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"controllers": [controller("a"), controller("b", FORWARD)]},
            "a, b are active and take the same joints. Stop all but one: "
            "ros2 control switch_controllers --deactivate b",
        ),
        (
            {"controllers": [controller("a", state="inactive"), controller("b", FORWARD, "inactive")]},
            "none of the controllers of gen3 is active (a, b): ros2 control switch_controllers --activate a",
        ),
        (
            {"controllers": [controller("a", joints=JOINTS[:6])]},
            f"no controller there takes all joints of gen3 ({', '.join(JOINTS)}) by joint trajectories or positions. "
            "Load one, such as joint_trajectory_controller.",
        ),
        (
            {"controllers": [controller("a")], "actions": [("/x", "a/B")]},
            "nobody offers the gripper of gen3: no action of control_msgs/GripperCommand, "
            "control_msgs/ParallelGripperCommand, franka_msgs/Move, and no topic of a gripper; there is /x. Start the "
            "gripper's driver.",
        ),
        (
            {"controllers": [controller("a")], "joints": (*JOINTS[:6], KNUCKLE)},
            f"/joint_states has no joint_7 of gen3; it has {', '.join(JOINTS[:6])}, {KNUCKLE}. Is another arm there? "
            "Else correct the names in its description.",
        ),
        (
            {"controllers": [controller("a")], "joints": JOINTS},
            f"no joint states have {KNUCKLE}, the gripper of gen3; they have {', '.join(JOINTS)}. Start the gripper's "
            "driver, or correct gripper.joint in the description.",
        ),
        (
            {"controllers": [controller("a")], "joints": ()},
            "no joint states came in 3 s. Is the driver of gen3 running?",
        ),
    ],
)
def test_a_graph_that_does_not_fit_is_one_line(run, graph, tmp_path, options, message):
    url = graph(**options)
    status, out, err = run(main, "profile", "gen3", "--from", url)
    assert (status, out, err) == (1, "", f"bam-robots profile: {url}: {message}\n")
    assert not (tmp_path / "robots").exists()


def test_the_address_is_called_as_the_help_says(run):
    assert (
        "--from URL|FILE    Address of the robot behind rosbridge, or a contract" in run(main, "profile", "--help")[1]
    )
    status, _, err = run(main, "profile", "gen3", "--form", "ws://127.0.0.1:9")
    remedy = "Run bam-robots profile --help\n"
    assert (status, err) == (2, f"bam-robots profile: unknown option --form, did you mean --from? {remedy}")


def test_no_server_no_rosapi_and_a_file_that_is_there(run, graph, tmp_path):
    with contextlib.closing(LaxServer().start()) as lax:
        status, _, err = run(main, "profile", "gen3", "--from", lax.url)
        assert status == 1
        assert err == (
            f"bam-robots profile: {lax.url}: rosapi, which tells what there is, does not run there. Start it beside "
            "the bridge: ros2 run rosapi rosapi_node.\n"
        )
        url = lax.url
    status, _, err = run(main, "profile", "gen3", "--from", url)
    assert (status, err.count("\n"), "nothing listens there" in err) == (1, 1, True)
    (tmp_path / "robots" / "profiles").mkdir(parents=True)
    (tmp_path / "robots" / "profiles" / "gen3.toml").write_text("")
    status, _, err = run(main, "profile", "gen3", "--from", url)
    assert (status, "robots/profiles/gen3.toml exists; give another name with --out, or --force" in err) == (1, True)


CONTRACT = """robot_type: so_lab
robot_interface: ros2
fps: 30
x-qos: &state {reliability: best_effort, history: keep_last, depth: 50}
observations:
  observation.images.wrist:
    channel: {topic: /wrist/image_raw/compressed, type: sensor_msgs/msg/CompressedImage}
    align: {strategy: hold, timeline: header}
    apply: [resize: [512, 512]]
  observation.state:
    - channel: {topic: /follower/joint_states, type: sensor_msgs/msg/JointState, qos: *state, dtype: float32}
      select: [position.jaw, position.roll, position.wrist_flex, position.elbow, position.lift, position.pan]
      apply: [rad2deg]
    - channel: {topic: /imu, type: sensor_msgs/msg/Imu}
      select: [orientation.x, orientation.y]
actions:
  action:
    channel: {topic: /leader/joint_states, type: sensor_msgs/msg/JointState}
    select: [position.jaw, position.roll, position.wrist_flex, position.elbow, position.lift, position.pan]
tasks: {task: {channel: {topic: /task_prompt, type: std_msgs/msg/String}}}
adjunct:
  - channel: {topic: /scan, type: sensor_msgs/msg/LaserScan}
"""
RENAMED = {"shoulder_pan": "pan", "shoulder_lift": "lift", "elbow_flex": "elbow", "wrist_roll": "roll"}


@pytest.fixture
def contract(tmp_path, monkeypatch):
    """Writes a contract with changes, beside the description of the arm that it is about."""
    monkeypatch.chdir(tmp_path)
    lab(
        "solab",
        "so101",
        ('joint = "gripper"', 'joint = "jaw"'),
        *((f'"{old}"', f'"{new}"') for old, new in RENAMED.items()),
    )

    def write(old="", new=""):
        (tmp_path / "contract.yaml").write_text(CONTRACT.replace(old, new, 1))
        return tmp_path / "contract.yaml"

    return write


def test_a_contract_of_rosetta_says_topics_joints_and_their_order(run, contract, tmp_path):
    status, out, err = run(main, "profile", "solab", "--from", contract())
    assert (status, err) == (0, "")
    assert out.splitlines()[1:3] == ["  states: /follower/joint_states, /object_pose", "  joints: /leader/joint_states"]
    read = load_profile(tmp_path / "robots" / "profiles" / "solab.toml")
    [sink] = read.sinks()
    assert (sink.topic, sink.type) == ("/leader/joint_states", "sensor_msgs/JointState")
    assert sink.labels == ("gripper_width", "roll", "wrist_flex", "elbow", "lift", "pan")
    assert sink.names == ("jaw", *sink.labels[1:])
    assert read.source("joint_position").names == ("pan", "lift", "elbow", "wrist_flex", "roll")
    assert (read.source("gripper_width").topic, read.source("gripper_width").names) == (
        "/follower/joint_states",
        ("jaw",),
    )
    assert [(one.name, one.topic) for one in read.cameras] == [("wrist", "/wrist/image_raw/compressed")]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("so_lab", "stone"),
            "the robot there calls itself stone, and solab was named. Give bam-robots profile stone --from {path}, or "
            "--force if it is solab.",
        ),
        (
            ("position.elbow,", "position.knee,"),
            "/follower/joint_states has no elbow of solab; it has jaw, knee, lift, pan, roll, wrist_flex. Is another "
            "arm there? Else correct the names in its description.",
        ),
        (
            ("actions:", "acts:"),
            "not a contract of rosetta: no 'actions'. Give a YAML file with robot_type, and with observations and "
            "actions, which have channels with a topic and a type.",
        ),
        (("actions:", "actions: []\nacts:"), "not a contract of rosetta. Give a YAML file with robot_type"),
        (
            ("fps: 30", "fps: ["),
            "is not YAML: expected ',' or ']', but got '<scalar>' (at line 5, column 1). Correct it there.\n",
        ),
        (("fps: 30", "fpss: 30"), "unknown key 'fpss'. Did you mean 'fps'?\n"),
        (
            ("actions:\n  action:\n", "actions:\n  action:\n    selects: []\n"),
            "actions.action: unknown key 'selects'. Did you mean 'select'?\n",
        ),
        (
            ("topic: /imu,", "topic: /imu, units: deg,"),
            "observations.observation.state: unknown key 'units'. Choose from: decoder, dtype, encoder, qos, safety, "
            "topic, type.\n",
        ),
        (
            ("actions:\n  action:\n", "actions:\n  action:\n    apply: [rad2deg, clamp: {min: -1, max: 1}]\n"),
            "actions.action: apply has 'clamp', and a profile sends commands as they are. Leave it out, and give the "
            "limits to the robot's description.\n",
        ),
        (
            ("/leader/joint_states, type", "/leader/joint_states, encoder: 'own:encode', type"),
            "actions.action: its encoder writes messages that a profile cannot. Name a topic that needs none.\n",
        ),
        (
            ("/follower/joint_states, type", "/follower/joint_states, decoder: 'own:decode', type"),
            "observations.observation.state: its decoder gives other numbers than the topic has. Leave it out.\n",
        ),
        (
            (
                "type: sensor_msgs/msg/JointState}\n    select: [position.jaw",
                "type: sensor_msgs/msg/JointState}\n    select: [velocity.jaw",
            ),
            "the action on /leader/joint_states selects velocity.jaw, and the joints of an arm are commanded by "
            "position. Name a topic of positions there, such as that of a trajectory.\n",
        ),
    ],
)
def test_a_contract_that_does_not_fit_is_one_line(run, contract, tmp_path, change, message):
    path = contract(*change)
    status, out, err = run(main, "profile", "solab", "--from", path)
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert err.startswith(f"bam-robots profile: {path}: {message.format(path=path)}")
    assert not (tmp_path / "robots" / "profiles").exists()


@pytest.mark.parametrize(("name", "shipped"), [("so101", "ros2_so_arm100"), ("mir100", "mir100")])
def test_a_written_contract_gives_the_same_states_and_commands(run, tmp_path, monkeypatch, name, shipped):
    monkeypatch.chdir(tmp_path)
    assert run(main, "profile", name, "--rosetta", "contract.yaml") == (
        0,
        "wrote contract.yaml: a contract of rosetta\n",
        "",
    )
    status, _, err = run(main, "profile", name, "--rosetta", "contract.yaml")
    assert (status, "contract.yaml exists; give another name with --rosetta, or --force" in err) == (1, True)
    assert run(main, "profile", name, "--from", "contract.yaml")[0] == 0
    status, _, err = run(main, "profile", name, "--rosetta", "contract.yaml/a.yaml")
    assert (status, err.count("\n"), "contract.yaml/a.yaml: cannot be written: " in err) == (1, 1, True)
    read, expected = load_profile(tmp_path / "robots" / "profiles" / f"{name}.toml"), load_profile(shipped)
    assert read.sinks() == tuple(replace(one, controller="") for one in expected.sinks())
    for signal in ("joint_position", "gripper_width") if name == "so101" else ("base_velocity",):
        assert read.source(signal) == expected.source(signal)
