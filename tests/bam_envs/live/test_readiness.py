"""What a robot says of its being ready: it is named before anything moves, and instead of what follows from it."""

import numpy as np
import pytest

from bam_envs.core.errors import NotReady, SafetyStop
from bam_envs.live.building import live_robot
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import JOINTS
from bam_envs.ros.codec import RobotInfo

ROW = np.zeros(1, np.int64)
SAFETY, MODE, PROGRAM = (
    f"/io_and_status_controller/{name}" for name in ("safety_mode", "robot_mode", "robot_program_running")
)
SPEED = "/speed_scaling_state_broadcaster/speed_scaling"
LIST = "/controller_manager/list_controllers"
TYPES = {one.topic: one.type for name in ("ur5e", "mir100") for one in load_profile(name).readiness}
JOINTS_TOPIC = "/scaled_joint_trajectory_controller/joint_trajectory"
ACTIVE = {"scaled_joint_trajectory_controller": "active", "forward_position_controller": "inactive"}
CLEAR = (
    "see what the arm ran into; 5 s after the stop unlock it on the pendant, or by the service "
    "/dashboard_client/unlock_protective_stop, and start its program again"
)
BRAKES, PENDANT = "power the arm on and release its brakes on the pendant", "set it to 100 % on the pendant"


class Driver:
    """Says on a server what a robot's driver says."""

    def __init__(self, server):
        self.server, self.controllers = server, dict(ACTIVE)

    def say(self, topic, **message):
        self.server.advertise(topic, TYPES[topic], latch=True)
        self.server.publish(topic, message)

    def offer_controllers(self):
        self.server.serve(LIST, "controller_manager_msgs/ListControllers", self._list)

    def _list(self, request, caller):
        return {"controller": [{"name": name, "state": state} for name, state in self.controllers.items()]}

    def say_ready(self):
        self.say(SAFETY, mode=1)
        self.say(MODE, mode=7)
        self.say(PROGRAM, data=True)
        self.say(SPEED, data=100.0)


@pytest.fixture
def driver(server):
    return Driver(server)


@pytest.fixture
def connected(server, robot_on):
    """Connect to a scripted robot, behind its guards."""
    robots = []

    def connect(profile="ur5e", frozen=False, **options):
        scripted = robot_on(server, profile)
        scripted.frozen = frozen
        robots.append(live_robot(server.url, profile=profile, **options))
        robots[-1].connect()
        return robots[-1]

    yield connect
    for robot in robots:
        robot.close()


def test_a_robot_that_is_ready_moves(driver, connected, start_pose):
    driver.say_ready()
    driver.offer_controllers()
    robot = connected()
    assert robot.not_ready() is None
    robot.step(robot.reset(ROW, start_pose).command)
    assert robot.info.text == (f"the robot at {driver.server.url}, which does not describe itself (profile ur5e)")


@pytest.mark.parametrize(
    ("profile", "topic", "message", "text"),
    [
        ("ur5e", SAFETY, {"mode": 1}, None),
        ("ur5e", SAFETY, {"mode": 3}, f"protective stop ({SAFETY}): {CLEAR}"),
        (
            *("ur5e", SAFETY, {"mode": 7}),
            f"robot emergency stop ({SAFETY}): release the emergency stop, then {BRAKES}",
        ),
        (
            *("ur5e", SAFETY, {"mode": 99}),
            f"safety mode 99 ({SAFETY}): the pendant shows what is wrong and how to clear it",
        ),
        ("ur5e", SAFETY, [1], None),
        ("ur5e", MODE, {"mode": 5}, f"idle, brakes engaged ({MODE}): {BRAKES}"),
        ("ur5e", MODE, {"mode": -1}, f"no controller ({MODE}): {BRAKES}"),
        (
            *("ur5e", PROGRAM, {"data": False}),
            f"the external control program is not running ({PROGRAM}): start it on the pendant; in headless mode call "
            "the service /io_and_status_controller/resend_robot_program",
        ),
        ("ur5e", SPEED, {"data": 30.0}, f"the speed slider is at 30 % ({SPEED}): {PENDANT}"),
        ("ur5e", SPEED, {"data": "fast"}, None),
        ("ur5e", SPEED, {}, None),
        (
            *("mir100", "/robot_state", {"robotState": 10}),
            "emergency stop (/robot_state): release the emergency stop, then press the reset button on the robot",
        ),
        (
            *("mir100", "/robot_state", {"robot_state": 12}),
            "error (/robot_state): its web page shows what is wrong and how to clear it",
        ),
    ],
)
def test_what_a_message_says(profile, topic, message, text):
    (readiness,) = (one for one in load_profile(profile).readiness if one.topic == topic)
    assert readiness.trouble(message) == text


@pytest.mark.parametrize(
    ("topic", "message", "text"),
    [
        (SAFETY, {"mode": 3}, f"protective stop ({SAFETY}): {CLEAR}"),
        (SPEED, {"data": 30.0}, f"the speed slider is at 30 % ({SPEED}): {PENDANT}"),
    ],
)
def test_an_arm_that_is_not_ready_does_not_begin(driver, connected, start_pose, topic, message, text):
    driver.say_ready()
    driver.say(topic, **message)
    robot = connected()
    assert robot.not_ready() == text
    with pytest.raises(NotReady) as caught:
        robot.reset(ROW, start_pose)
    assert str(caught.value) == (
        f"{driver.server.url}: not ready: {text}. Nothing moves before it is ready and reset() is called."
    )


def test_two_programs_do_not_drive_one_robot(server, robot_on, connected, start_pose, until):
    """The second one neither moves nor holds the robot; the first one goes on."""
    first, second = connected(), live_robot(server.url)
    second.connect()
    command = first.reset(ROW, start_pose).command
    first.step(command)
    until(lambda: second.not_ready() is not None)
    assert second.not_ready() == (f"somebody else commands the robot on {JOINTS_TOPIC}; end the other program first")
    with pytest.raises(NotReady, match="somebody else commands the robot"):
        second.reset(ROW, start_pose)
    second.halt()
    second.close()
    assert first.not_ready() is None
    first.step(command)


def test_a_command_of_somebody_else_stops_a_robot_in_motion(server, connected, start_pose, until):
    robot = connected()
    command = robot.reset(ROW, start_pose).command
    robot.step(command)
    server.advertise(JOINTS_TOPIC, "trajectory_msgs/JointTrajectory")
    point = {"positions": command[0, :6].tolist()}
    server.publish(
        "/scaled_joint_trajectory_controller/joint_trajectory", {"joint_names": list(JOINTS), "points": [point]}
    )
    until(lambda: robot.not_ready() is not None)
    with pytest.raises(NotReady, match=f"somebody else commands the robot on {JOINTS_TOPIC}"):
        robot.step(command)


def test_a_stop_in_mid_episode_is_named_at_once(driver, connected, start_pose, until):
    driver.say_ready()
    robot = connected()
    command = robot.reset(ROW, start_pose).command
    robot.step(command)
    driver.say(SPEED, data=30.0)  # may dip while it moves: the guards look at what follows from it
    until(lambda: robot.not_ready() is not None)
    robot.step(command)
    driver.say(SAFETY, mode=3)
    until(lambda: "protective" in robot.not_ready())
    with pytest.raises(NotReady, match="not ready: protective stop"):
        robot.step(command)
    driver.say_ready()  # it becomes ready without a new connection
    until(lambda: robot.not_ready() is None)
    robot.reset(ROW, start_pose)


def test_what_follows_from_it_is_told_with_it(driver, connected, start_pose, until):
    """The slider was pulled down while the arm moved: it does not follow any more, and why is said first."""
    driver.say_ready()
    robot = connected(frozen=True)
    command = robot.reset(ROW, start_pose).command.copy()
    driver.say(SPEED, data=30.0)
    until(lambda: robot.not_ready() is not None)
    command[0, 0] += 0.3

    def go_on():
        for _ in range(100):
            robot.step(command)

    with pytest.raises(SafetyStop) as caught:
        go_on()
    assert str(caught.value).startswith(
        f"The robot was stopped by following (G23): not ready: the speed slider is at 30 % ({SPEED}): "
        f"{PENDANT}: shoulder_pan_joint "
    )


@pytest.mark.parametrize(
    ("change", "way", "text"),
    [
        ({}, "trajectory", None),
        ({}, "position", "the controller forward_position_controller is inactive"),
        ({"forward_position_controller": "unconfigured"}, "position", "forward_position_controller is unconfigured"),
        ({"scaled_joint_trajectory_controller": "running"}, "trajectory", None),  # as ROS 1 calls it
        (None, "trajectory", "the controller scaled_joint_trajectory_controller is not loaded: ros2 control switch_"),
    ],
)
def test_controllers(driver, connected, start_pose, change, way, text):
    driver.controllers = {} if change is None else driver.controllers | change
    driver.offer_controllers()
    robot = connected(command=way)
    if text is None:
        assert robot.not_ready() is None
    else:
        assert text in robot.not_ready()
        assert " --activate " in robot.not_ready()
        with pytest.raises(NotReady, match=text):
            robot.reset(ROW, start_pose)


def test_what_is_not_said_is_in_the_description(driver, connected, start_pose):
    driver.server.advertise(SAFETY, "std_msgs/String")  # of another type: it is not listened to
    driver.say(MODE, state="on")  # of another version: it has no mode
    robot = connected()
    assert robot.not_ready() is None
    assert robot.info.text.endswith(
        "which does not describe itself (profile ur5e; it does not report safety_mode, robot_mode, "
        "robot_program_running, speed_scaling, list_controllers)"
    )
    robot.reset(ROW, start_pose)


def test_a_robot_that_describes_itself_is_not_asked(server, driver, robot_on, simulation):
    driver.say(SAFETY, mode=3)
    robot_on(server, info=simulation)
    robot = live_robot(server.url, profile="ur5e")
    robot.connect()
    assert robot.not_ready() is None
    assert robot.info == RobotInfo("ur5e", simulated=True, lockstep=True, period=0.05)
    robot.close()


def test_what_the_server_cannot_pass_on_is_no_refusal(lax, robot_on, start_pose):
    """A server without the types of a driver says so, and the robot is driven without."""
    server = lax()
    robot_on(server)
    robot = live_robot(server.url, profile="ur5e")
    robot.connect()
    server.send(SAFETY, {"op": "status", "level": "error", "msg": "unknown type", "id": f"subscribe:{SAFETY}"})
    robot.step(robot.reset(ROW, start_pose).command)
    robot.close()
