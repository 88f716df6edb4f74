"""A diagnosis names the first thing that is wrong, and moves nothing."""

import asyncio
import contextlib
import itertools
import re
import socket
import threading
import time

import numpy as np
import pytest
from websockets.asyncio.server import serve

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.core.kinematics import UR_JOINTS
from bam_envs.core.location import LiveRobot
from bam_envs.core.timing import Pacer
from bam_envs.live import bringup, examination
from bam_envs.live.building import live_robot
from bam_envs.live.diagnosis import STEPS, Diagnosis
from bam_envs.live.examination import Reading, measured_link
from bam_envs.robots.profile import load_profile
from bam_envs.ros.codec import RobotInfo
from bam_envs.ros.messages import write_stamp

PATIENT = 'extends = "ur5e"\nname = "patient"\nkind = "arm"\nmax_age = 1.0\ncommand_timeout = 1.0\n'


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(bringup, "TIMEOUT", 2.0)


def late_by(seconds):
    """A pacer that tells of every other tick that it came so late, and of no other, however busy the computer is."""

    ticks = itertools.count()

    class Told(Pacer):
        def wait(self):
            super().wait()
            return seconds * (next(ticks) % 2)

    return Told


@pytest.fixture(autouse=True)
def idle(monkeypatch):
    """A computer that is not busy, as far as the pacer tells."""
    monkeypatch.setattr(examination, "Pacer", late_by(0.0))


@pytest.fixture
def patient(tmp_path):
    """A profile that a busy computer satisfies too; `more` is added to the file."""

    def write(more=""):
        (tmp_path / "patient.toml").write_text(PATIENT + more)
        return str(tmp_path / "patient.toml")

    return write


def diagnose(url, robot=None, profile=None, seconds=0.6):
    """The diagnosis, which is closed, and its steps by name."""
    diagnosis = Diagnosis(LiveRobot(url, profile=profile), robot, seconds=seconds)
    try:
        return diagnosis, {step.name: step for step in diagnosis.steps()}
    finally:
        diagnosis.close()


def link_of(diagnosis, about=""):
    """The measured link as a profile."""
    inspection = diagnosis.inspection
    return measured_link(inspection.trips, inspection.copies, inspection.readings["joint_position"], about)


def failure(steps):
    """The last step, which must have failed, and why."""
    assert list(steps) == list(STEPS[: len(steps)])
    *before, last = steps.values()
    assert all(step.verdict != "failed" for step in before)
    assert last.verdict == "failed", steps
    return last.name, last.found


def test_a_healthy_robot_passes_every_step_and_is_not_moved(server, robot_on, patient):
    robot = robot_on(server, info=RobotInfo("ur5e", text="a scripted robot"))
    diagnosis, steps = diagnose(server.url, profile=patient())
    assert list(steps) == list(STEPS)
    assert {step.verdict for step in steps.values()} <= {"ok", "warning"}, steps
    assert steps["rosbridge"].found == "answers as ROS 2; the robot describes itself: a scripted robot"
    topics = "/joint_states, /gripper/joint_states, /object_pose"
    assert steps["topics"].found == f"profile patient: {topics}; all of the expected types"
    assert steps["command path"].found.endswith("nothing was sent")
    assert robot.commands == []
    assert robot.halts == 0
    link = link_of(diagnosis, "here")
    assert link.about == "here"
    assert link.command_loss == link.state_loss == link.nulls == 0.0
    assert link.command_delay == sorted(link.command_delay)


def test_the_profile_that_fits_best_is_taken(server, robot_on):
    robot_on(server, "mir100")
    diagnosis, steps = diagnose(server.url)
    assert diagnosis.profile.name == "mir100"
    assert steps["topics"].verdict == "ok"


def test_a_closed_port():
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    name, why = failure(diagnose(f"ws://127.0.0.1:{port}")[1])
    assert name == "port"
    assert why.startswith(f"ws://127.0.0.1:{port}: refused: nothing listens there. Is the port open?")


@contextlib.contextmanager
def listening(start):
    """The address of the server that the coroutine `start` opens."""
    loop, started, ports, stop = asyncio.new_event_loop(), threading.Event(), [], asyncio.Event()

    async def main():
        async with await start() as server:
            ports.append(next(iter(server.sockets)).getsockname()[1])
            started.set()
            await stop.wait()

    thread = threading.Thread(target=lambda: loop.run_until_complete(main()))
    thread.start()
    assert started.wait(10.0)
    try:
        yield f"ws://127.0.0.1:{ports[0]}"
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(10.0)
        loop.close()


def test_a_port_of_another_service():
    async def say_hello(reader, writer):
        writer.write(b"SSH-2.0-OpenSSH_9.2\r\n")
        with contextlib.suppress(ConnectionError):
            await writer.drain()
        writer.close()

    with listening(lambda: asyncio.start_server(say_hello, "127.0.0.1", 0)) as url:
        name, why = failure(diagnose(url)[1])
    assert name == "websocket"
    assert "something listens there that is no WebSocket server" in why


def test_a_websocket_server_that_is_no_rosbridge():
    async def echo(connection):
        async for frame in connection:
            await connection.send(frame)

    async def start():
        return await serve(echo, "127.0.0.1", 0)

    with listening(start) as url:
        name, why = failure(diagnose(url)[1])
    assert name == "rosbridge"
    assert "an echo server" in why


def test_another_robot_than_the_profile_says(server, robot_on):
    robot_on(server, "mir100")
    name, why = failure(diagnose(server.url, profile="ur5e")[1])
    assert name == "topics"
    assert why.startswith(
        "there is no topic /joint_states (sensor_msgs/JointState), which has joint_position, joint_velocity."
    )


@pytest.mark.parametrize("tells", [True, False])
def test_another_arm_than_the_profile_says_is_named_by_its_joints(server, robot_on, tells):
    robot_on(server, "ros2_so_arm100", info=RobotInfo("ros2_so_arm100") if tells else None)
    other = (
        "this is another robot: joints shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, and {} has {}. "
        "If it is the right address, choose --robot-model so101, or a checkpoint for it."
    )
    sevenfold = other.format("xarm_ros2", ", ".join(f"joint{number}" for number in range(1, 8)))
    assert failure(diagnose(server.url, profile="xarm_ros2")[1]) == ("topics", sevenfold)
    franka = other.format("franka_ros2", ", ".join(f"fr3_joint{number}" for number in range(1, 8)))
    assert failure(diagnose(server.url, profile="franka_ros2")[1]) == ("topics", franka)  # whose topics are there
    with pytest.raises(ProtocolError) as error:  # as a program that moves it
        live_robot(server.url, profile="ur5e").connect()
    assert str(error.value) == f"{server.url}: {other.format('ur5e', ', '.join(UR_JOINTS))}"


def test_the_publishers_on_a_topic_are_one_line(server, robot_on):
    robot = robot_on(server, "xarm_ros2")
    found = diagnose(server.url, profile="xarm_ros2")[1]["rates and ages"].found
    rate = r"[\d.]+ Hz, age p50 [^;]+ ms, p99 [^;]+ ms"
    shared = rf"/xarm/joint_states {rate} \(joint_position\) and {rate} \(gripper_width\)"
    assert re.fullmatch(rf"{shared}; /object_pose {rate}", found), found
    assert robot.commands == []


def test_a_topic_of_another_type(server, robot_on):
    server.advertise("/object_pose", "std_msgs/Float64MultiArray")
    server.advertise("/joint_states", "sensor_msgs/JointState")
    server.advertise("/gripper/joint_states", "sensor_msgs/JointState")
    name, why = failure(diagnose(server.url)[1])
    assert name == "topics"
    assert why.startswith("/object_pose is a std_msgs/Float64MultiArray there, and geometry_msgs/PoseStamped was")


def test_a_robot_in_another_namespace(server, robot_on):
    robot_on(server, namespace="/cell_1")
    name, why = failure(diagnose(server.url, profile="ur5e")[1])
    assert name == "topics"
    assert why.endswith(f" It is there at another address: {server.url}/cell_1.")


@pytest.mark.parametrize("namespace", ["", "/cell_1"])
def test_a_topic_of_another_name(server, robot_on, namespace):
    for topic in ("/arm/joint_states", "/gripper/joint_states"):
        server.advertise(f"{namespace}{topic}", "sensor_msgs/JointState")
    server.advertise("/elsewhere/joint_states", "sensor_msgs/JointState")
    server.advertise(f"{namespace}/object_pose", "geometry_msgs/PoseStamped")
    name, why = failure(diagnose(f"{server.url}{namespace}", profile="ur5e")[1])
    assert name == "topics"
    elsewhere = "" if namespace else ", /elsewhere/joint_states"
    assert why.endswith(
        f' Is it /arm/joint_states{elsewhere}? Then give a profile with [rename], and in it "/joint_states" = '
        '"/arm/joint_states".'
    )


def test_the_profile_is_found_in_another_namespace(server, robot_on):
    robot_on(server, "mir100", namespace="/cell_1")
    diagnosis, steps = diagnose(server.url)
    assert diagnosis.profile.name == "mir100"
    assert failure(steps)[1].endswith(f" It is there at another address: {server.url}/cell_1.")


def test_a_silent_topic(server, robot_on, patient):
    robot = robot_on(server)
    robot.mangle = lambda topic, message: None if topic == "/object_pose" else message
    name, why = failure(diagnose(server.url, profile=patient())[1])
    assert name == "rates and ages"
    assert why.startswith("/object_pose (geometry_msgs/PoseStamped): no message in 0.6 s. Does its driver run?")


def test_states_that_stay_the_same(server, robot_on):
    robot = robot_on(server)
    frozen = write_stamp(time.time() - 5.0)
    robot.stamp = lambda: frozen
    name, why = failure(diagnose(server.url)[1])
    assert name == "rates and ages"
    assert why.startswith("/joint_states: the newest state is up to ")
    assert " and 100 ms is the limit (max_age in the profile), at " in why
    assert why.endswith("Hz. Their stamp stands still: the driver repeats an old measurement. Start it again.")


def test_states_that_are_old_when_they_arrive(server, robot_on):
    robot = robot_on(server)
    robot.stamp = lambda: write_stamp(time.time() - 5.0)
    why = failure(diagnose(server.url)[1])[1]
    assert "They are 5.0 s old when they arrive, so that a higher rate would change nothing, and the network " in why
    assert "Either the clock of the driver's computer is behind, and is to be set by the same NTP server" in why


def test_states_that_come_too_rarely(server, robot_on):
    robot, numbers = robot_on(server), iter(range(10**6))
    unstamped = {"header": {"stamp": {"sec": 0, "nanosec": 0}}}  # so that their age at arrival is not known
    robot.mangle = lambda topic, message: {**message, **unstamped} if next(numbers) % 60 < 3 else None
    why = failure(diagnose(server.url)[1])[1]
    assert why.endswith("Hz. They come too rarely: raise the rate of their driver.")


@pytest.fixture
def busy(monkeypatch):
    """A computer on which every other tick comes 0.1 s late, as far as the pacer tells."""
    monkeypatch.setattr(examination, "Pacer", late_by(0.1))


BUSY = r"this computer is busy: (\d+) of (\d+) ticks came late"


def test_late_states_on_a_busy_computer_are_not_the_robots_fault(server, robot_on, busy, monkeypatch):
    """Those of another computer's clock are, whatever keeps this one busy."""
    robot_on(server).stamp = lambda: write_stamp(time.time() - 5.0)
    name, why = failure(diagnose(server.url, profile="ur5e")[1])
    assert name == "rates and ages"
    assert re.search(f"Hz. But {BUSY}, and the robot may be in time: close other programs, and measure again.$", why)
    monkeypatch.setattr("bam_envs.live.diagnosis.is_loopback", lambda host: False)
    _, why = failure(diagnose(server.url, profile="ur5e")[1])
    assert "They are 5.0 s old when they arrive, so that a higher rate would change nothing, and the network " in why


def test_a_busy_computer_is_a_warning_where_states_are_in_time(server, robot_on, patient, busy):
    robot_on(server)
    warnings = diagnose(server.url, profile=patient())[1]["rates and ages"].warnings
    late, count = map(
        int, re.fullmatch(f"{BUSY}; close other programs, or the robot will be held", warnings[-1]).groups()
    )
    assert late >= count // 2


def without_elbow(message):
    keep = [index for index, name in enumerate(message["name"]) if name != "elbow_joint"]
    return {**message, **{key: [message[key][one] for one in keep] for key in ("name", "position", "velocity")}}


def test_a_joint_that_vanishes(server, robot_on, patient):
    robot = robot_on(server)
    robot.mangle = lambda topic, message: without_elbow(message) if topic == "/joint_states" else message
    name, why = failure(diagnose(server.url, profile=patient())[1])
    assert name == "rates and ages"
    assert "elbow_joint" in why


def test_some_unreadable_states_are_a_warning_and_measured(server, robot_on, patient):
    robot, numbers = robot_on(server), iter(range(10**6))
    robot.mangle = lambda topic, message: (
        without_elbow(message) if topic == "/joint_states" and next(numbers) % 4 == 0 else message
    )
    diagnosis, steps = diagnose(server.url, profile=patient())
    assert "messages cannot be read: /joint_states" in steps["rates and ages"].warnings[0]
    assert 0.0 < link_of(diagnosis).nulls < 1.0


@pytest.mark.slow
def test_a_server_that_passes_no_message_on_and_whose_clock_is_apart(lax, robot_on, patient, monkeypatch):
    monkeypatch.setattr("bam_envs.live.diagnosis.MAX_CLOCK_OFFSET", 0.0)
    server = lax()
    robot_on(server)
    steps = diagnose(server.url, profile=patient())[1]
    assert steps["topics"].warnings == ("the server has no rosapi node, so that types of topics cannot be checked",)
    ntp = "set both clocks by the same NTP server, or recordings of both cannot be compared"
    assert steps["clock"].warnings == (ntp,)
    name, why = failure(steps)
    assert name == "round trip"
    assert why.startswith("what is published on /bam/ping does not come back in 2 s")


@pytest.mark.slow
def test_nobody_takes_commands(server, robot_on, patient):
    robot_on(server)
    profile = patient('\n[rename]\n"/scaled_joint_trajectory_controller/joint_trajectory" = "/other/commands"\n')
    name, why = failure(diagnose(server.url, profile=profile)[1])
    assert name == "command path"
    assert why.startswith(
        "Nobody listens to /other/commands (trajectory_msgs/JointTrajectory), which takes shoulder_pan"
    )


def test_a_robot_in_a_protective_stop(server, robot_on, patient):
    robot = robot_on(server)
    server.advertise("/io_and_status_controller/safety_mode", "ur_dashboard_msgs/SafetyMode", latch=True)
    server.publish("/io_and_status_controller/safety_mode", {"mode": 3})
    name, why = failure(diagnose(server.url, profile=patient())[1])
    assert name == "command path"
    assert why == (
        "protective stop (/io_and_status_controller/safety_mode): see what the arm ran into; 5 s after the stop unlock "
        "it on the pendant, or by the service /dashboard_client/unlock_protective_stop, and start its program again. "
        "Run this again when the robot takes commands"
    )
    assert robot.commands == []


def test_a_joint_beyond_its_limits_is_a_warning(server, robot_on, patient):
    robot_on(server).signals["joint_position"][2] = 3.1
    warnings = diagnose(server.url, profile=patient())[1]["guards"].warnings
    assert warnings[-1].startswith("elbow_joint is at 3.100 rad, beyond -3.042 to 3.042 rad: jog it back")


def test_a_robot_that_stops_late_is_a_warning(server, robot_on, patient):
    robot_on(server)
    warnings = diagnose(server.url, profile=patient("watchdog = 0.3\n"))[1]["guards"].warnings
    assert len(warnings) == 1
    assert warnings[0].startswith("robot's watchdog (G5): the robot stops by itself only 0.3 s after the last command")


# What is measured


def measured(trips, delays=(0.0,), copies=0, count=1, unread=0):
    source, rows = load_profile("ur5e").state[0], np.zeros(count - unread)
    stamps, values = (None,) * len(rows), np.zeros((len(rows), 6))
    reading = Reading(source, count, rows, stamps, np.array(delays), values, len(rows), 100.0, np.zeros(1), "")
    return measured_link(np.array(trips, float), copies, reading)


def test_a_way_is_a_round_trip_less_half_the_median():
    link = measured([0.02] * 100 + [0.05])
    assert link.command_delay == [0.01] * 100 + [0.04]
    assert link.state_delay == link.command_delay  # without stamps


def test_a_state_is_as_old_as_its_stamp_says():
    link = measured([0.02] * 11, np.linspace(0.0, 0.1, 101))
    assert link.state_delay == pytest.approx(np.maximum(np.linspace(0.0, 0.1, 101), 0.01))


def test_losses_copies_and_nulls():
    lost = float("nan")
    link = measured([0.02, lost, lost, lost, 0.02, lost] + [0.02] * 14, copies=2, count=10, unread=1)
    assert (1 - link.command_loss) * (1 - link.state_loss) == pytest.approx(0.8)
    assert (link.burst, link.duplicates, link.nulls) == (2.0, 0.1, 0.1)


def test_too_few_pings_make_no_profile():
    with pytest.raises(InvalidValue, match=r"3 pings came back, and quantiles need 10\. Measure for longer\."):
        measured([0.02] * 3)


@pytest.mark.slow
def test_a_delay_of_the_network_is_in_both_directions(server, robot_on, patient):
    delay = 0.03

    async def pump(reader, writer):
        loop = asyncio.get_running_loop()
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65536):
                loop.call_later(delay, writer.write, data)
        loop.call_later(delay, writer.close)

    async def pass_on(reader, writer):
        there, back = await asyncio.open_connection("127.0.0.1", server.port)
        await asyncio.gather(pump(reader, back), pump(there, writer))

    robot_on(server)
    with listening(lambda: asyncio.start_server(pass_on, "127.0.0.1", 0)) as url:
        diagnosis, steps = diagnose(url, profile=patient(), seconds=2.0)  # 40 pings, of which 10 are enough
        time.sleep(2 * delay)  # the last bytes are on their way
    assert steps["guards"].verdict != "failed"
    link = link_of(diagnosis)
    assert diagnosis.inspection.round_trips.min() >= 2 * delay
    for delays in (link.command_delay, link.state_delay):
        assert 0.8 * delay <= delays[50] <= 10 * delay
