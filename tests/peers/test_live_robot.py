"""Our live robot, behind its guards, through a rosbridge server that is not ours, on a robot that is a ROS 2 node."""

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bam_envs.core.errors import LinkLost, NoServer, NotReady, SafetyStop, StaleState
from bam_envs.core.location import LiveRobot
from bam_envs.core.robot import Initial
from bam_envs.live.building import live_robot, profile_limits
from bam_envs.live.diagnosis import STEPS, Diagnosis
from bam_envs.live.examination import measured_link
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import arm_spec
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.contract import check_contract
from bam_train.environments import make_env

ROW = np.zeros(1, np.int64)
HOME = np.array([[0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]])
SPEC = arm_spec("ur5e", with_object=True)
PICK = Path(__file__).parents[2] / "checkpoints" / "pick-ppo.zip"
POSITIONS, GRIPPER, TRAJECTORY = "positions", "gripper", "trajectory"


@contextlib.contextmanager
def live(server, spec=SPEC, **options):
    robot = live_robot(server.url, spec, robot_name="node", **options)  # what is proved belongs to that name
    try:
        robot.connect()
        yield robot
    finally:
        robot.close()


@pytest.fixture(scope="module", autouse=True)
def own_proofs(tmp_path_factory):
    """What is proved of the node's commands is remembered for the next test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
        yield


@pytest.fixture(scope="module")
def connected(rosbridge, running_robot):
    """A robot whose commands are proved in its first motion."""
    with live(rosbridge) as robot:
        yield robot


@pytest.fixture
def driven(connected, robot_node):
    """The one that is connected, after a stop too."""
    yield connected
    connected.resume()


def start(robot, position=HOME):
    return robot.reset(ROW, Initial({"joint_position": position}, np.zeros(1, np.int64)))


def received(node, topic):
    return [entry["values"] for entry in node.ask("report")["received"] if entry["topic"] == topic]


def test_its_state_is_what_the_node_publishes_by_name(driven):
    signals = start(driven).signals
    np.testing.assert_allclose(signals["joint_position"], HOME, atol=0.02)
    np.testing.assert_allclose(signals["object_position"], [[0.5, 0.1, 0.02]])
    np.testing.assert_allclose(signals["object_quaternion"], [[1.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(signals["gripper_width"], [[0.085]], atol=2e-3)
    assert driven.age() < 0.1


def require_moves(robot, node, topic):
    """It moves where it is told, by commands on a topic."""
    target = start(robot).command.copy()
    target[0, 0] += 0.1
    target[0, 6] = 0.05
    for _ in range(30):
        state = robot.step(target)
    np.testing.assert_allclose(state.signals["joint_position"], target[:, :6], atol=1e-3)
    np.testing.assert_allclose(state.signals["gripper_width"], [[0.05]], atol=1e-3)
    np.testing.assert_allclose(received(node, topic)[-1], target[0, :6])
    assert received(node, GRIPPER)[-1] == pytest.approx([0.05])


def test_it_moves_where_a_trajectory_leads(driven, robot_node):
    require_moves(driven, robot_node, TRAJECTORY)


def test_the_start_pose_is_reached_slowly(driven, robot_node):
    away = HOME + 0.1
    np.testing.assert_allclose(start(driven, away).signals["joint_position"], away, atol=0.02)
    steps = np.diff(received(robot_node, TRAJECTORY), axis=0)
    assert np.abs(steps).max() <= driven.limits.reset_speed * SPEC.period + 1e-9
    np.testing.assert_allclose(start(driven).signals["joint_position"], HOME, atol=0.02)


def test_no_number_that_is_not_finite_reaches_the_node(driven, robot_node):
    command = start(driven).command
    for _ in range(10):  # until it rests there: a halt holds what is measured
        driven.step(command)
    robot_node.ask("forget")
    bad = np.where(np.arange(7) == 2, np.nan, command)
    for _ in range(driven.limits.bad_ticks - 1):
        np.testing.assert_allclose(driven.step(bad).command, command, atol=1e-3)
    with pytest.raises(SafetyStop):
        driven.step(bad)
    values = [value for kind in (TRAJECTORY, GRIPPER) for row in received(robot_node, kind) for value in row]
    assert values
    assert all(isinstance(value, float) for value in values)


def test_halt_stops_the_node(driven, robot_node, wait_until):
    start(driven)  # which halts it first
    wait_until(lambda: robot_node.ask("report")["halts"] > 0, True)
    before = robot_node.ask("report")["halts"]
    driven.halt()
    wait_until(lambda: robot_node.ask("report")["halts"] > before, True)


# Each from here on connects by itself: the one above would find that somebody else commands the robot.


def test_it_moves_to_positions_that_a_trajectory_proved(rosbridge, robot_node):
    with live(rosbridge, command="position") as robot:
        require_moves(robot, robot_node, POSITIONS)


def test_a_hundred_commands_a_second_arrive(rosbridge, robot_node, wait_until):
    """On a busy machine a state may be late and ROS may drop a command: neither is what is tested here."""
    count = 300
    patient = replace(profile_limits(load_profile("ur5e")), max_age=1.0)
    with live(rosbridge, replace(SPEC, period=0.01), limits=patient) as robot:
        command = start(robot).command
        robot_node.ask("forget")
        stamps = [robot.step(command).stamp[0] for _ in range(count)]
        wait_until(lambda: len(received(robot_node, TRAJECTORY)) >= 0.95 * count, True)
        assert (np.diff(stamps) >= 0).all()
        assert stamps[-1] - stamps[0] >= 0.9 * 0.01 * count  # no quicker than its clock


def step_on(robot, command):
    for _ in range(20):
        robot.step(command)


def test_the_server_dies_and_comes_back(mortal_rosbridge, robot_node):
    with live(mortal_rosbridge) as robot:
        command = start(robot).command
        robot.step(command)
        mortal_rosbridge.kill()
        with pytest.raises(LinkLost):
            step_on(robot, command)
        robot_node.ask("forget")
        with pytest.raises(LinkLost):
            robot.step(command)
        mortal_rosbridge.start()
        mortal_rosbridge.wait_for_robot()
        assert robot_node.ask("report")["received"] == []
        np.testing.assert_allclose(start(robot).signals["joint_position"], HOME, atol=0.02)
        robot.step(command)


PROGRAM = "/io_and_status_controller/robot_program_running"


def test_a_paused_program_is_named(rosbridge, robot_node, wait_until):
    """Said once, before we came; the server knows none of the other topics, and two of their types."""
    robot_node.ask("pause")
    paused = (
        f"the external control program is not running ({PROGRAM}): start it on the pendant; in headless mode call the "
        "service /io_and_status_controller/resend_robot_program"
    )
    try:
        with live(rosbridge) as robot:
            assert robot.not_ready() == paused
            with pytest.raises(NotReady, match="not ready: the external control program is not running"):
                start(robot)
            robot_node.ask("play")
            wait_until(robot.not_ready, None)
            command = start(robot).command
            robot.step(command)
            assert robot.info.text.endswith(
                "; it does not report safety_mode, robot_mode, speed_scaling, list_controllers)"
            )
            robot_node.ask("pause")
            wait_until(robot.not_ready, paused)
            with pytest.raises(NotReady):
                robot.step(command)
    finally:
        robot_node.ask("play")


def test_nobody_there(mortal_rosbridge):
    mortal_rosbridge.kill()
    robot = live_robot(mortal_rosbridge.url, SPEC)
    with pytest.raises(NoServer, match="refused"):
        robot.connect()
    robot.close()


def with_source(signal, **changes):
    profile = load_profile("ur5e")
    sources = (replace(one, **changes) if one.signal == signal else one for one in profile.state)
    return replace(profile, state=tuple(sources))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"topic": "/fingers/joint_states"}, r"/fingers/joint_states \(sensor_msgs/JointState\): no message in 3 s"),
        ({"type": "std_msgs/String"}, r"The server reported: .*/gripper/joint_states has another type"),
    ],
)
def test_a_topic_that_is_not_what_the_profile_says(changes, text, rosbridge, robot_node):
    robot = live_robot(rosbridge.url, SPEC, profile=with_source("gripper_width", **changes))
    with pytest.raises(StaleState, match=text):
        robot.connect()
    robot.close()


def test_a_diagnosis_finds_it_well_and_moves_nothing(rosbridge, robot_node):
    robot_node.ask("forget")
    for _ in range(3):  # on a busy computer, states come late
        diagnosis = Diagnosis(rosbridge.url, seconds=2.0)
        try:
            steps = list(diagnosis.steps())
        finally:
            diagnosis.close()
        if steps[-1].name == STEPS[-1]:
            break
    assert [step.name for step in steps] == list(STEPS)
    assert all(step.verdict != "failed" for step in steps), steps
    assert diagnosis.profile.name == "ur5e"
    assert robot_node.ask("report")["received"] == []
    inspection = diagnosis.inspection
    link = measured_link(inspection.trips, inspection.copies, inspection.readings["joint_position"])
    assert link.command_loss < 0.1
    assert 0.0 < link.command_delay[50] < 0.1


STATES = ("/joint_states", "/gripper/joint_states", "/object_pose")


def test_the_contract_is_compared_without_a_command(rosbridge, robot_node):
    env, place = make_env("bam/pick-v0", place=LiveRobot(rosbridge.url)), LiveRobot(rosbridge.url)
    robot_node.ask("forget")
    contract = check_contract(Checkpoint.open(PICK), env, place)
    assert [(one.what, one.found) for one in contract.refused] == []
    verdicts = {one.what: one.verdict for one in contract.checks}
    assert [verdicts[f"rate of {topic}"] for topic in STATES] == ["ok"] * 3
    assert (
        verdicts["command /scaled_joint_trajectory_controller/joint_trajectory"] == "unknown"
    )  # this bridge has no rosapi
    assert robot_node.ask("report")["received"] == []
    elsewhere = check_contract(Checkpoint.open(PICK), env, LiveRobot(f"{rosbridge.url}/cell"), timeout=0.5)
    assert [one.what for one in elsewhere.refused] == [f"topic {topic}" for topic in STATES]
