"""Our link through a rosbridge server that is not ours, to a robot that is a ROS 2 node: also when the server dies."""

import contextlib
import threading
import time

import pytest

from bam_envs.core.errors import LinkLost, RemoteError
from bam_envs.rosbridge.client import RosbridgeLink

GRIPPER = "/gripper/commands"
ARRAY = "std_msgs/Float64MultiArray"
DOWN_LIMIT = 1.0
UP_LIMIT = 10.0
LAST = 0.0625
PROBE = 0.001


def width(n):
    """Distinct widths of a gripper [m]; the server reads some other decimals one bit off."""
    return (1 + n) / 16384


@contextlib.contextmanager
def link_to(server):
    link = RosbridgeLink(server.url)
    link.connect()
    link.advertise(GRIPPER, ARRAY)
    try:
        yield link
    finally:
        link.close()


def received(robot):
    return [entry["values"][0] for entry in robot.ask("report")["received"] if entry["topic"] == "gripper"]


def test_states_arrive_with_the_stamps_of_ros_2(rosbridge, robot_node, wait_until):
    newest = {}
    with link_to(rosbridge) as link:
        link.subscribe("/joint_states", "sensor_msgs/JointState", lambda message, _: newest.update(message))
        wait_until(lambda: bool(newest), True)
        assert link.ros == "ros2"
        assert set(newest["header"]["stamp"]) == {"sec", "nanosec"}
        assert newest["name"][0] == "elbow_joint"
        assert len(newest["position"]) == 6


def test_commands_arrive_in_their_order(rosbridge, robot_node, wait_until):
    with link_to(rosbridge) as link:
        wait_for_publisher(link, robot_node)
        sent = [width(n) for n in range(200)]
        for value in sent:
            link.publish(GRIPPER, {"data": [value]})
            time.sleep(0.002)  # ROS keeps the newest ten of a publisher that is quicker than its subscriber
        wait_until(lambda: [value for value in received(robot_node) if value != PROBE], sent)


def wait_for_publisher(link, robot):
    """Until ROS has matched our publisher with the robot, what is published is lost."""
    deadline = time.monotonic() + UP_LIMIT
    while not received(robot):
        assert time.monotonic() < deadline
        link.publish(GRIPPER, {"data": [PROBE]})
        time.sleep(0.01)
    robot.ask("forget")
    while received(robot):
        robot.ask("forget")


def test_services(rosbridge, robot_node):
    with link_to(rosbridge) as link:
        assert link.call("/robot/set", "std_srvs/SetBool", {"data": True}, 2.0) == {"success": True, "message": "set"}
        with pytest.raises(RemoteError, match="has no field x"):
            link.call("/robot/set", "std_srvs/SetBool", {"x": True}, 2.0)
        with pytest.raises((RemoteError, LinkLost)):
            link.call("/robot/slow", "std_srvs/Trigger", {}, 0.2)


def test_a_call_may_take_as_long_as_it_says(ros2, new_rosbridge, robot_node):
    """The server itself ends calls sooner, as bridges do; the time goes with each call."""
    server = new_rosbridge(ros2, "--service-timeout", "0.3")
    server.wait_for_robot()
    with link_to(server) as link:
        assert link.call("/robot/slow", "std_srvs/Trigger", {}, 10.0)["success"]


def test_what_we_offer_is_called_through_it(rosbridge, robot_node):
    with link_to(rosbridge) as provider, link_to(rosbridge) as client:
        provider.serve("/link/flip", "std_srvs/SetBool", lambda request, _: {"success": not request["data"]})
        deadline = time.monotonic() + UP_LIMIT
        while True:
            try:
                answer = client.call("/link/flip", "std_srvs/SetBool", {"data": False}, 1.0)
                break
            except (RemoteError, LinkLost):
                assert time.monotonic() < deadline
        assert answer["success"] is True


def test_an_error_of_the_server_is_told(rosbridge, robot_node, wait_until):
    with link_to(rosbridge) as link:
        link.subscribe("/joint_states", "std_msgs/String", lambda message, _: None)
        wait_until(lambda: any("another type" in status["msg"] for status in link.statuses), True)


def test_nothing_from_before_a_cut_is_sent_after_it(mortal_rosbridge, robot_node, wait_until):
    """Commands at 100 Hz; the server is killed, and started again at the same address."""
    with link_to(mortal_rosbridge) as link:
        wait_for_publisher(link, robot_node)
        states = []
        link.subscribe("/joint_states", "sensor_msgs/JointState", lambda message, _: states.append(message))
        before = publish_until_lost(link, mortal_rosbridge.kill)
        for n in range(50):
            with pytest.raises(LinkLost, match="Nothing was sent, and nothing is kept"):
                link.publish(GRIPPER, {"data": [width(500 + n)]})
        with pytest.raises(LinkLost):
            link.call("/robot/set", "std_srvs/SetBool", {"data": True}, 5.0)
        assert link.epoch == 1
        mortal_rosbridge.start()
        link.wait_up(UP_LIMIT)
        assert link.epoch == 2
        states.clear()
        wait_until(lambda: len(states) > 0, True, UP_LIMIT)
        mortal_rosbridge.wait_for_robot()
        while LAST not in received(robot_node):
            link.publish(GRIPPER, {"data": [LAST]})
            time.sleep(0.01)
        arrived = received(robot_node)
        count = arrived.index(LAST)
        assert arrived[:count] == before[:count]  # what was under way when the server died may be lost
        assert set(arrived[count:]) == {LAST}


def publish_until_lost(link, cut):
    """Publish distinct values at 100 Hz, `cut` after a while; what was sent."""
    sent = []
    deadline = time.monotonic() + 0.5 + DOWN_LIMIT
    while time.monotonic() < deadline:
        if len(sent) == 30:
            cut()
        value = width(len(sent))
        try:
            link.publish(GRIPPER, {"data": [value]})
        except LinkLost:
            return sent
        sent.append(value)
        time.sleep(0.01)
    pytest.fail("the link did not notice")


def test_what_waits_for_an_answer_fails_at_once(mortal_rosbridge, robot_node):
    with link_to(mortal_rosbridge) as link:
        outcome = []

        def ask():
            try:
                link.call("/robot/slow", "std_srvs/Trigger", {}, 30.0)
            except LinkLost as error:
                outcome.append(error)

        waiting = threading.Thread(target=ask)
        waiting.start()
        time.sleep(0.2)  # the call is at the robot, which takes a second
        mortal_rosbridge.kill()
        waiting.join(DOWN_LIMIT)
        assert not waiting.is_alive()
        assert len(outcome) == 1
