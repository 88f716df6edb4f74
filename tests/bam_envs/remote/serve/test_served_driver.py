"""What drivers offer beside topics, asked for by roslibpy: gripper actions, enable services, controllers, the URDF."""

import threading
from importlib import resources

import gymnasium as gym
import numpy as np
import pytest
import roslibpy

from bam_envs.arms.description import robot_model
from bam_envs.core.robot_models import SHIPPED
from bam_envs.live.arm_checks import read_urdf
from bam_envs.robots.profile import profile_for
from bam_envs.tasks.scripted import scripted_policy

GRIP, MOVE = "control_msgs/action/GripperCommand", "franka_msgs/action/Move"
GEN3, FR3, XARM7 = "/robotiq_gripper_controller/gripper_cmd", "/franka_gripper/move", "/xarm_gripper/gripper_action"
PARALLEL, FIELD, NAME = "control_msgs/ParallelGr", "command.position[0]", "command.name[0]"
KNUCKLE = "robotiq_85_left_knuckle_joint"
LONG = 20.0


class Client:
    """A `roslibpy.Ros` at a served arm."""

    def __init__(self, serve_env, name):
        env = gym.make("bam/pick-v0", robot_model=name, disable_env_checker=True)
        self.served = serve_env(env=env)
        self.ros = roslibpy.Ros("127.0.0.1", self.served.bus.port, transport="asyncio")
        self.ros.run(LONG)

    def call(self, service, **request):
        return dict(roslibpy.Service(self.ros, service, "").call(roslibpy.ServiceRequest(request), timeout=LONG))

    def first(self, topic, kind, fits=lambda message: True):
        """The first message that fits."""
        came, found = threading.Event(), []

        def take(message):
            if fits(message):
                found.append(dict(message))
                came.set()

        roslibpy.Topic(self.ros, topic, kind).subscribe(take)
        assert came.wait(LONG)
        return found[0]

    def goal(self, action, kind, goal, *, cancel=False):
        """Status, result and feedback of a goal; with `cancel` it is cancelled at its first feedback."""
        client, done, news, ended = roslibpy.ActionClient(self.ros, action, kind), threading.Event(), [], []

        def hear(values):
            news.append(dict(values))
            if cancel and len(news) == 1:
                client.cancel_goal(identity[0])

        def end(result):
            ended.append(result)
            done.set()

        identity = [client.send_goal(roslibpy.Goal(goal), end, hear, end)]
        assert done.wait(LONG)
        return ended[0]["status"].name, ended[0]["values"], news


@pytest.fixture
def client(serve_env):
    clients = []

    def connect(name):
        clients.append(Client(serve_env, name))
        return clients[-1]

    yield connect
    for one in clients:
        one.ros.close()


def closed(knuckle):
    return {"command": {"position": knuckle, "max_effort": 100.0}}


def test_a_gripper_goes_to_the_goal_of_its_action_without_further_commands(client):
    gen3 = client("gen3")
    assert gen3.call("/rosapi/action_servers") == {"action_servers": [GEN3]}
    status, values, news = gen3.goal(GEN3, GRIP, closed(0.4))
    assert (status, values["reached_goal"], values["stalled"]) == ("SUCCEEDED", True, False)
    assert values["position"] == pytest.approx(0.4, abs=0.011)
    assert set(news[0]) == {"position", "effort", "stalled", "reached_goal"}
    states = gen3.first("/joint_states", "sensor_msgs/JointState")
    assert states["name"] == [*(f"joint_{number}" for number in range(1, 8)), "robotiq_85_left_knuckle_joint"]
    assert states["position"][7] == pytest.approx(0.4, abs=0.02)
    status, values, _ = gen3.goal(GEN3, GRIP, closed(0.0), cancel=True)
    assert (status, values["reached_goal"]) == ("CANCELED", False)
    refused = "/robotiq_gripper_controller/gripper_cmd: gripper_width must be 0 to 0.085 m, not -0.02125 m."
    assert gen3.goal(GEN3, GRIP, closed(1.0))[:2] == ("ABORTED", refused)


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """Describe a Gen3 whose gripper has an action with the message of a joint (ParallelGripperCommand)."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robots" / "profiles").mkdir(parents=True)
    text = (SHIPPED / "gen3.toml").read_text(encoding="utf-8")
    (tmp_path / "robots" / "lab.toml").write_text(text.replace('"gen3"', '"lab"', 1))
    text = (resources.files("bam_envs.robots") / "profiles" / "ros2_kortex.toml").read_text(encoding="utf-8")
    text = text.replace('"ros2_kortex"', '"lab"').replace('"gen3"', '"lab"').replace("control_msgs/Gr", PARALLEL)
    text = text.replace("command.position", FIELD).replace('"command.max_effort" = 100.0', f'"{NAME}" = "{KNUCKLE}"')
    (tmp_path / "robots" / "profiles" / "lab.toml").write_text(text)


def test_a_gripper_whose_action_has_the_message_of_a_joint(client, lab):
    """As since ROS 2 Jazzy."""
    arm = client("lab")
    status, values, news = arm.goal(
        GEN3, "control_msgs/action/ParallelGripperCommand", {"command": {"position": [0.4]}}
    )
    assert (status, values["reached_goal"], set(news[0])) == ("SUCCEEDED", True, {"state"})
    assert values["state"]["position"] == pytest.approx([0.4], abs=0.011)


def test_a_gripper_of_its_makers_own_action(client):
    fr3 = client("fr3")
    status, values, news = fr3.goal(FR3, MOVE, {"width": 0.06, "speed": 0.1})
    assert (status, values) == ("SUCCEEDED", {"success": True, "error": ""})
    assert 0.06 < news[0]["current_width"] <= 0.08
    grasp = {"width": 0.0, "speed": 0.1, "force": 40.0, "epsilon": {"inner": 0.08, "outer": 0.08}}
    assert fr3.goal("/franka_gripper/grasp", "franka_msgs/action/Grasp", grasp)[0] == "SUCCEEDED"


def test_an_arm_takes_no_command_before_it_is_enabled(client):
    xarm = client("xarm7")
    text = "xarm_ros2 takes no command before /xarm/set_mode, /xarm/set_state was called."
    assert xarm.call("/xarm/motion_enable", id=8, data=1) == {"ret": 0, "message": ""}
    assert xarm.goal(XARM7, GRIP, closed(0.5))[:2] == ("ABORTED", text)
    for service, data in (("/xarm/set_mode", 1), ("/xarm/set_state", 0)):
        assert xarm.call(service, data=data) == {"ret": 0, "message": ""}
    assert xarm.goal(XARM7, GRIP, closed(0.1))[0] == "SUCCEEDED"
    xarm.call("/xarm/motion_enable", id=8, data=0)
    assert xarm.goal(XARM7, GRIP, closed(0.2))[0] == "ABORTED"


@pytest.mark.parametrize("name", ["fr3", "so101"])
def test_controllers_and_urdf(client, name):
    arm, one = robot_model(name), client(name)
    listed = {row["name"]: row for row in one.call("/controller_manager/list_controllers")["controller"]}
    profile = profile_for(arm.spec(with_object=True))
    default, other = (mode[-1] for mode in profile.commands.values())
    assert listed["joint_state_broadcaster"]["state"] == "active"
    for sink, state in ((default, "active"), (other, "inactive")):
        assert listed[sink.controller]["state"] == state
        assert listed[sink.controller]["required_command_interfaces"] == [f"{joint}/position" for joint in sink.names]
    urdf = read_urdf(one.first("/robot_description", "std_msgs/String")["data"])
    assert [urdf[row.name][3:5] for row in arm.joints] == [(row.low, row.high) for row in arm.joints]
    q = np.linspace(-1.0, 1.0, arm.num_joints)
    position, rotation = urdf.pose("base_link", "tool", dict(zip(arm.joint_names, q, strict=True)))
    frame = arm.chain.link_frames(q[None])[0, -1]
    np.testing.assert_allclose(position, frame[:3, 3], atol=1e-12)
    np.testing.assert_allclose(rotation, frame[:3, :3], atol=1e-12)


@pytest.mark.parametrize("name", ["fr3", "xarm7", "gen3", "so101", "lab"])
def test_a_cube_is_picked_by_the_names_of_each_driver(serve_env, lab, name):
    """The gripper by its action, or by the message of the arm; a halt in between drops nothing."""
    env = gym.make("bam/pick-v0", robot_model=name, disable_env_checker=True)
    url, policy = serve_env(env=env, fast=True).bus.url, scripted_policy("bam/pick-v0", name)
    live = gym.make("bam/pick-v0", robot_model=name, robot=url, disable_env_checker=True)
    robot = live.unwrapped.robot
    try:
        robot.connect()
        robot.enable()
        observation, _ = live.reset(seed=0)
        ended, steps = False, 0
        while not ended:
            observation, _, success, truncated, _ = live.step(policy.act_batch(observation[None])[0])
            ended, steps = success or truncated, steps + 1
            if steps == 30:
                robot.halt()
        assert success
    finally:
        live.close()
