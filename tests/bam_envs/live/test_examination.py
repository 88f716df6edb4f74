"""Listening to a robot: what it publishes is collected, and nothing is sent to it."""

import contextlib
import socket
from dataclasses import replace

import numpy as np
import pytest

from bam_envs.core.errors import NoServer
from bam_envs.live.examination import DESCRIPTION, inspect_robot
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import arm_spec
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint

SPEC, PROFILE = arm_spec("ur5e", with_object=True), load_profile("ur5e")
STATES = ["/joint_states", "/gripper/joint_states", "/object_pose"]
COMMANDS = ["/gripper/commands", "/scaled_joint_trajectory_controller/joint_trajectory"]
TOOL = "/tcp_pose_broadcaster/pose"


def listened(url, profile=PROFILE, spec=SPEC, **options):
    with contextlib.closing(RosbridgeLink(Endpoint(url))) as link:
        link.connect()
        return inspect_robot(link, profile, spec, **{"listen": 0.1, "timeout": 5.0, **options})


def test_what_a_robot_publishes_is_collected(server, robot_on, simulation):
    scripted = robot_on(server, info=simulation)
    server.advertise(DESCRIPTION, "std_msgs/String", latch=True)
    server.publish(DESCRIPTION, {"data": "<robot/>"})
    inspection = listened(server.url)
    assert inspection.info == simulation
    assert [source.topic for source in inspection.sources if source.topic == TOOL] == [TOOL, TOOL]
    assert [sink.topic for sink in inspection.sinks] == COMMANDS
    kinds = {
        **{one.topic: one.type for one in (*inspection.sources, *inspection.sinks)},
        DESCRIPTION: "std_msgs/String",
    }
    assert inspection.types == {**kinds, TOOL: ""}  # the simulated robot does not measure its tool
    assert sorted(inspection.letters) == sorted([*STATES, DESCRIPTION])
    assert all(inspection.letters[topic][0].message["header"] for topic in STATES)
    numbers = [letter.number for letter in inspection.letters["/joint_states"]]
    assert numbers == [*range(1, len(numbers) + 1)]
    assert inspection.letters[DESCRIPTION][0].message == {"data": "<robot/>"}
    assert abs(inspection.server_offset) < 5.0
    assert scripted.commands == []
    assert scripted.halts == 0


def test_the_pose_of_the_tool_is_collected_where_it_is_measured(server, robot_on):
    robot_on(server, spec=replace(SPEC, signals=PROFILE.signals))
    assert listened(server.url).letters[TOOL][0].message["header"]["frame_id"] == "base"


def test_a_topic_that_nobody_publishes_is_waited_for_and_left_out(server, robot_on):
    robot_on(server, spec=arm_spec("ur5e", with_object=False))
    inspection = listened(server.url, timeout=0.5)
    assert inspection.types["/object_pose"] == ""
    assert "/object_pose" not in inspection.letters
    assert inspection.letters["/joint_states"]
    assert inspection.info is None


def test_a_silent_topic_has_no_letters(server, robot_on):
    scripted = robot_on(server)
    scripted.mangle = lambda topic, message: None if topic == "/object_pose" else message
    inspection = listened(server.url, timeout=0.5)
    assert inspection.letters["/object_pose"] == ()
    assert inspection.letters["/joint_states"]


def test_a_server_without_rosapi_tells_no_types(lax, robot_on):
    running = lax()
    robot_on(running)
    inspection = listened(running.url)
    assert inspection.types is None
    assert all(inspection.letters[topic] for topic in STATES)
    assert inspection.letters[TOOL] == ()
    kinds = {message["op"] for _, message in running.frames}
    assert kinds == {"call_service", "subscribe"}


@pytest.mark.parametrize(
    ("service", "response", "identity"),
    [
        ("get_serial_number", {"serial_number": 20195500123, "answer": "20195500123", "success": True}, "20195500123"),
        ("get_serial_number", {"serial_number": 0, "answer": "no connection", "success": False}, ""),
        ("raw_request", {"answer": "20195500123\n"}, "20195500123"),
        ("raw_request", {"answer": "could not understand: 'get serial number'"}, ""),
        ("get_robot_model", {"answer": "UR5"}, ""),
    ],
)
def test_an_arm_tells_its_serial_number(lax, robot_on, service, response, identity):
    running, asked = lax(), []
    robot_on(running)
    running.serve(f"/dashboard_client/{service}", "", lambda request, caller: asked.append(request) or response)
    assert listened(running.url).identity == identity
    assert asked == {"get_serial_number": [{}], "raw_request": [{"query": "get serial number"}]}.get(service, [])


def test_a_base_tells_its_name_and_a_simulated_robot_the_one_that_it_was_given(server, robot_on, simulation):
    scripted = robot_on(server, "mir100")
    server.advertise("/robot_status", "mir_msgs/RobotStatus", latch=True)
    server.publish("/robot_status", {"robot_name": "MiR_R1234", "state_id": 3})
    base = load_profile("mir100")
    assert listened(server.url, base, scripted.spec).identity == "MiR_R1234"
    robot_on(server, namespace="/cell", info=replace(simulation, identity="left arm"))
    assert listened(f"{server.url}/cell").identity == "left arm"


def test_the_longest_allowed_age_says_how_long_to_listen(server, robot_on):
    robot_on(server)
    assert listened(server.url, listen=None).seconds >= 0.5


def test_nobody_there(unused_port):
    with pytest.raises(NoServer, match=r"^ws://127\.0\.0\.1"):
        listened(f"ws://127.0.0.1:{unused_port}")


@pytest.fixture
def unused_port():
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


def test_joints_at_another_namespace(server, robot_on):
    robot_on(server, namespace="/cell")
    inspection = listened(f"{server.url}/cell")
    joints = inspection.letters["/joint_states"][-1].message["position"]
    assert np.isfinite(joints).all()
