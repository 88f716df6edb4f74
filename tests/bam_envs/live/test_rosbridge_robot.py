"""A live robot through a rosbridge server: what is sent, what is believed, and what happens when something breaks."""

import multiprocessing
import threading
import time
from dataclasses import replace
from functools import partial
from importlib.resources import files

import numpy as np
import pytest

from bam_envs.core.errors import (
    InvalidValue,
    LinkLost,
    NoServer,
    NotInCommand,
    ProtocolError,
    RemoteError,
    ResetNeeded,
    SafetyStop,
    StaleState,
    UnknownName,
)
from bam_envs.core.robot import Initial
from bam_envs.live.rosbridge_robot import RosbridgeRobot
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import JOINTS, arm_spec
from bam_envs.ros.codec import HALT_TOPIC, SCENE_TOPIC, RobotInfo
from bam_envs.ros.freshness import read_tag
from bam_envs.ros.messages import tag_text
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.rosbridge.string_rpc import StringRpcService
from bam_envs.safety.gate import _clear

ROW = np.zeros(1, np.int64)
JOINT_COMMANDS, GRIPPER_COMMANDS = "/forward_position_controller/commands", "/gripper/commands"
DEADLINE = 10.0


class OpenGate:
    """Passes every command on to its robot, as no gate may: what the robot does with it is tested here."""

    def __init__(self, robot):
        self.robot = robot
        self.state = robot.measure()

    def step(self, command):
        self.robot.await_due()
        return self.robot.step(_clear(self.robot, np.array(command)))


class StillTime:
    """The clock of one robot, which stands still but while that robot waits, and then is at the end of the wait."""

    def __init__(self):
        self.now, self.events, self._is_set = 1000.0, [], False
        """Events: (time, what happens then, in a thread of its own) of those to come."""

    def __call__(self):
        return self.now

    def rule(self, robot):
        robot._woken = self

    def set(self):
        self._is_set = True

    def clear(self):
        self._is_set = False

    def wait(self, seconds):
        end = self.now + seconds
        while self.events and self.events[0][0] <= end and not self._is_set:
            self.now, happens = self.events.pop(0)
            thread = threading.Thread(target=happens)
            thread.start()
            thread.join(DEADLINE)
            assert not thread.is_alive()
        self.now = self.now if self._is_set else end


@pytest.fixture
def connect_in_still_time(connect):
    """`connect` with a clock that stands still; the robot, an open gate before it, and the clock."""

    def start(*arguments, **options):
        clock = StillTime()
        robot, gate = connect(*arguments, clock=clock, **options)
        clock.rule(robot)
        return robot, gate, clock

    return start


def robot_at(url, profile="ur5e_position", **options):
    return RosbridgeRobot(url, load_profile(profile), **options)


@pytest.fixture
def connect():
    """Connect to a robot; the robot, and an open gate before it."""
    robots = []

    def start(url, profile="ur5e_position", **options):
        robots.append(robot_at(url, profile, **options))
        robots[-1].connect()
        return robots[-1], OpenGate(robots[-1])

    yield start
    for robot in robots:
        robot.close()


def raised(kind, act):
    with pytest.raises(kind) as caught:
        act()
    assert type(caught.value) is kind
    return str(caught.value)


def test_joints_are_read_by_name(server, robot_on, connect):
    def shuffled(topic, message):
        if topic != "/joint_states":
            return message
        return message | {field: list(reversed(message[field])) for field in ("name", "position", "velocity")}

    scripted = robot_on(server)
    scripted.mangle = shuffled
    scripted.signals["joint_velocity"] = np.arange(6.0)
    scripted.signals["object_position"] = np.array([0.5, 0.1, 0.02])
    _, gate = connect(server.url)
    signals = gate.state.signals
    np.testing.assert_array_equal(signals["joint_position"], scripted.signals["joint_position"][None])
    np.testing.assert_array_equal(signals["joint_velocity"], [np.arange(6.0)])
    np.testing.assert_array_equal(signals["gripper_width"], [[0.085]])
    np.testing.assert_array_equal(signals["object_position"], [[0.5, 0.1, 0.02]])
    np.testing.assert_array_equal(signals["object_quaternion"], [[1.0, 0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(gate.state.command[0, :6], signals["joint_position"][0])


def test_commands_and_their_tags(server, robot_on, connect):
    scripted = robot_on(server)
    _, gate = connect(server.url)
    command = gate.state.command + 0.01
    states = [gate.step(command + n) for n in range(3)]
    np.testing.assert_array_equal([state.command for state in states], [command, command + 1, command + 2])
    scripted.wait_for(lambda: len(scripted.commands) == 6)
    assert [topic for topic, _, _ in scripted.commands] == [GRIPPER_COMMANDS, JOINT_COMMANDS] * 3
    assert [message["data"] for message in scripted.on(JOINT_COMMANDS)] == [
        (command[0, :6] + n).tolist() for n in range(3)
    ]
    tags = [read_tag(tag_text(message)) for _, _, message in scripted.commands]
    assert len({tag.session for tag in tags}) == 1
    assert [tag.epoch for tag in tags] == [1] * 6
    sequences = [tag.sequence for tag in tags]
    assert sequences == [sequences[0] + n // 2 for n in range(6)]
    assert all(tag.deadline - tag.sent == pytest.approx(0.1, abs=1e-5) for tag in tags)
    assert (np.diff([state.stamp[0] for state in states]) > 0).all()


def test_a_controller_that_holds_gets_set_points_between_commands(server, robot_on, tmp_path, connect_in_still_time):
    path = tmp_path / "mine.toml"
    row = 'hold = "measured"\nrate = 200.0\n'
    shipped = (files("bam_envs.robots") / "profiles" / "ur5e.toml").read_text()
    path.write_text(shipped.removesuffix('hold = "measured"\n') + row)
    scripted = robot_on(server)
    robot, gate, _ = connect_in_still_time(server.url, path, command="position")
    assert robot.spec.lag == pytest.approx(0.125)  # 0.1 s, and half a period
    start, command = gate.state.command[0].copy(), gate.state.command.copy()
    command[0, 0] += 0.2
    for _ in range(4):
        state = gate.step(command)
    np.testing.assert_array_equal(state.command, command)
    # Holds come over another connection, and may overtake set points.
    scripted.wait_for(lambda: len(scripted.on(JOINT_COMMANDS)) == 4 * 10)
    points = np.array([message["data"] for message in scripted.on(JOINT_COMMANDS)])
    robot.halt()
    # The gripper's hold follows its four commands, and then comes the arm's.
    scripted.wait_for(
        lambda: len(scripted.on(GRIPPER_COMMANDS)) == 5 and len(scripted.on(JOINT_COMMANDS)) == 4 * 10 + 1
    )
    # Each command begins a cubic that ends at rest two periods later, of which one is driven: a little beyond the goal.
    way = points[:, 0] - start[0]
    np.testing.assert_allclose(way[9::10], [0.1, 0.1875, 0.203125, 0.2015625], atol=1e-9)
    np.testing.assert_allclose(way[:10], [0.2 * s**2 * (3 - 2 * s) for s in np.arange(1, 11) / 20], atol=1e-9)
    np.testing.assert_array_equal(points[:, 1:], np.tile(command[0, 1:6], (40, 1)))


def test_only_a_gate_sends_commands(server, robot_on, connect):
    scripted = robot_on(server)
    robot, gate = connect(server.url)
    text = raised(InvalidValue, lambda: robot.step(gate.state.command))
    assert text == "Commands reach a live robot only through SafeRobot. Build it with live_robot(...)."
    assert scripted.commands == []


def test_before_connect_and_after_close(server, robot_on, connect):
    robot = robot_at("ws://127.0.0.1:9/cell_1")
    assert raised(ResetNeeded, robot.measure) == (
        "ur5e_position at ws://127.0.0.1:9/cell_1 is not connected. Call connect() first."
    )
    assert robot.age() == np.inf
    robot_on(server)
    robot, gate = connect(server.url)
    robot.close()
    robot.close()
    robot.halt()
    assert raised(ResetNeeded, lambda: gate.step(gate.state.command)).endswith("Call connect() first.")
    robot.connect()
    robot.connect()
    assert robot.measure().signals["gripper_width"] == 0.085


def test_wrong_addresses_and_ways():
    assert raised(InvalidValue, lambda: robot_at("http://robot")).startswith("Address 'http://robot' has the")
    raised(UnknownName, lambda: robot_at("ws://robot", command="positions"))
    robot = robot_at("ws://127.0.0.1:9")
    assert raised(NoServer, robot.connect).startswith("ws://127.0.0.1:9: refused: nothing listens there.")


def test_steps_last_a_period_each_and_end_before_their_deadlines_by_the_time_that_a_command_takes(
    server, robot_on, connect_in_still_time
):
    robot_on(server)
    robot, gate, clock = connect_in_still_time(server.url)
    begins, ends = [], []
    for computes in (0.004, 0.004, 0.02, 0.3, 0.0, 0.0):
        robot.await_due()
        begins.append(clock.now)
        robot.step(_clear(robot, gate.state.command.copy()))
        ends.append(clock.now)
        clock.now += computes
    # Each ends before its deadline by the longest time that was needed, at most a tenth of a period, which is slowly
    # forgotten; a pause does not count. The deadline after a late command (the second, the fourth) is 2 ms nearer.
    early = [0.0, 0.002 + 0.004, 0.004, 0.002 + 0.005, 0.005, 0.95 * 0.005]
    np.testing.assert_allclose(np.subtract(ends, begins), 0.05 - np.array(early), atol=1e-9)
    np.testing.assert_allclose(np.diff(begins), [0.054, 0.048, 0.066, 0.343, 0.05], atol=1e-9)


def test_a_halt_ends_the_wait_of_a_step_and_the_next_command_comes_half_a_period_after_the_last(
    server, robot_on, connect_in_still_time
):
    robot_on(server)
    spec = replace(arm_spec("ur5e", with_object=False), period=1.0)
    robot, gate, clock = connect_in_still_time(server.url, spec=spec)
    begin = clock.now
    clock.events.append((begin + 0.05, robot.halt))
    gate.step(gate.state.command)
    assert clock.now == begin + 0.05
    gate.step(gate.state.command)
    assert clock.now == begin + 1.5  # it waited for half a period, and lasted for one


def test_lockstep(server, robot_on, connect, simulation):
    scripted = robot_on(server, info=simulation)
    robot, gate = connect(server.url)
    assert robot.info == simulation
    for n in range(20):
        command = gate.state.command + 0.001 * n
        state = gate.step(command)
        assert len(scripted.on(JOINT_COMMANDS)) == n + 1
        assert robot.age() == 0.0
        np.testing.assert_array_equal(state.signals["joint_position"], command[:, :6])


def test_a_robot_that_answers_commands_owes_an_answer_to_what_does_not_arrive(
    server, robot_on, connect_in_still_time, until
):
    scripted = robot_on(server, info=RobotInfo("ur5e", simulated=True, lockstep=False, period=0.05))
    robot, gate, clock = connect_in_still_time(server.url)
    assert robot.waiting() == 0.0
    for _ in range(3):
        gate.step(gate.state.command)
    until(lambda: robot.waiting() == 0.0)
    answered = scripted.tag
    scripted.mangle = lambda topic, message: (
        message | {"header": message["header"] | {"frame_id": answered}} if topic == "/joint_states" else message
    )
    gate.step(gate.state.command)
    clock.now += 0.5
    assert robot.waiting() == pytest.approx(0.55)
    robot.halt()  # what has not been executed is not any more
    assert robot.waiting() == 0.0


def test_lockstep_without_an_answer(server, robot_on, connect, simulation):
    scripted = robot_on(server, info=simulation)
    _, gate = connect(Endpoint(server.url, timeout=1.0))
    scripted.mangle = lambda topic, message: None
    assert raised(StaleState, lambda: gate.step(gate.state.command)) == (
        f"{server.url}: no state answered the command in 1 s. Does the simulation run?"
    )


def test_lockstep_with_a_halt_just_before_the_command_waits_for_no_answer(server, robot_on, connect, simulation):
    """As of a person who takes over: the command is not sent, and the next one is."""
    scripted = robot_on(server, info=simulation)
    halting = []

    def clock():
        if halting and threading.current_thread() is threading.main_thread():
            halting.pop().halt()
        return time.monotonic()

    robot, gate = connect(server.url, clock=clock)
    halting.append(robot)
    gate.step(gate.state.command)
    assert halting == []
    gate.step(gate.state.command)
    assert [topic for topic, *_ in scripted.commands if topic != HALT_TOPIC] == [GRIPPER_COMMANDS, JOINT_COMMANDS]


def test_another_period(server, robot_on):
    robot_on(server, info=RobotInfo("box", simulated=True, lockstep=True, period=0.1))
    robot = robot_at(server.url)
    assert raised(InvalidValue, robot.connect) == (
        "box advances 0.1 s with each command, and the task's period is 0.05 s. Serve the environment of this task."
    )


def test_a_base_in_lockstep(server, robot_on, connect):
    info = RobotInfo("mir100", simulated=True, lockstep=True, period=0.1)
    scripted = robot_on(server, "mir100", info=info)
    _, gate = connect(server.url, "mir100")
    state = gate.step(np.array([[0.25, -0.5]]))
    np.testing.assert_array_equal(state.signals["base_velocity"], [[0.25, -0.5]])
    assert [topic for topic, _, _ in scripted.commands] == ["/cmd_vel_stamped"]
    robot = robot_at(server.url, "mir100", command="velocity")
    assert raised(InvalidValue, robot.connect) == (
        "mir100 advances with each command, and its answers cannot be told apart: velocity of the profile of mir100 "
        "has no room for a tag. Give it a mode that has, such as stamped messages."
    )


def test_a_cut_link_delivers_nothing_afterwards(server, robot_on, connect, start_pose, until):
    robot_on(server)
    robot, gate = connect(server.url)
    command = gate.state.command + 0.01
    server.close()
    text = raised(LinkLost, lambda: [gate.step(command) for _ in range(100)])
    assert text.startswith(server.url)
    for _ in range(5):
        raised(LinkLost, lambda: gate.step(command))
    with BridgeServer(port=server.port) as again:
        other = robot_on(again)
        back = f"{server.url}: the link dropped, and is back. Nothing is sent before reset()."
        until(lambda: raised(LinkLost, lambda: gate.step(command)) == back)
        assert [topic for topic, _, _ in other.commands if topic == JOINT_COMMANDS] == []
        robot.reset(ROW, start_pose)
        gate.step(command)
        other.wait_for(lambda: other.on(JOINT_COMMANDS))
        message = other.on(JOINT_COMMANDS)[0]
        assert message["data"] == command[0, :6].tolist()
        assert read_tag(tag_text(message)).epoch == 2
        robot.close()


@pytest.mark.parametrize("told", [False, True])
def test_a_halt_that_cannot_be_sent_is_told_once(server, robot_on, connect, caplog, told, until):
    """By the error of the step that found the link down, or else by a line of its own."""
    robot_on(server)
    robot, gate = connect(server.url)
    gate.step(gate.state.command)
    server.close()
    until(lambda: robot.age() == np.inf)
    text = "stop it by hand if it moves; a robot with a command timeout stops by itself."
    if told:
        down = f"{server.url}: the link is down. Nothing was sent, and nothing is kept; {text}"
        until(lambda: raised(LinkLost, lambda: gate.step(gate.state.command)) == down)
    else:
        until(lambda: robot.halt() or caplog.records)  # the connection of the halt may be noticed a little later
    for _ in range(3):
        robot.halt()
    robot.close()
    lines = [record.getMessage() for record in caplog.records if "halt" in record.getMessage()]
    assert len(lines) == (0 if told else 1)
    for line in lines:
        assert line.startswith(f"{server.url}: the halt could not be sent, the link is down (")
        assert line.endswith(f"): {text}")
        assert line.count(server.url) == 1


def test_a_halt_that_a_busy_computer_holds_up_comes_late_and_holds_the_arm_where_it_is_then(
    server, robot_on, connect, caplog, until
):
    scripted, entered, leave = robot_on(server), threading.Event(), threading.Event()
    robot, gate = connect(server.url)
    gate.step(gate.state.command)
    server.advertise("/busy", "std_msgs/Empty")
    robot._halting.subscribe("/busy", "std_msgs/Empty", lambda *_: (entered.set(), leave.wait(10.0)))
    until(lambda: server.publish("/busy", {}) or entered.wait(0.05))
    robot.halt()
    assert scripted.halts == 0
    there = (scripted.signals["joint_position"] + 0.01).tolist()
    scripted.signals["joint_position"][:] = there
    until(lambda: robot.measure().signals["joint_position"][0].tolist() == there)
    leave.set()
    scripted.wait_for(lambda: scripted.halts == 1 and len(scripted.on(JOINT_COMMANDS)) == 2)
    assert scripted.on(JOINT_COMMANDS)[1]["data"] == there
    assert [record.getMessage() for record in caplog.records] == [
        f"{server.url}: the halt could not be sent, the network thread took nothing for 0.5 s, and does this once it "
        "can: stop it by hand if it moves; a robot with a command timeout stops by itself."
    ]


def test_a_command_that_a_halt_overtook_is_not_sent(server, robot_on, connect):
    scripted, armed = robot_on(server), []

    def clock():
        if armed:
            armed.clear()
            robot.halt()
        return time.monotonic()

    robot, gate = connect(server.url, clock=clock)
    state = gate.step(gate.state.command)
    armed.append(True)  # the next step looks at the clock after it began
    np.testing.assert_array_equal(gate.step(gate.state.command + 0.01).command, state.command)
    scripted.wait_for(lambda: len(scripted.on(JOINT_COMMANDS)) == 2)
    assert all(message["data"] == state.command[0, :6].tolist() for message in scripted.on(JOINT_COMMANDS))


def test_a_command_that_waited_in_this_process_is_not_sent(server, robot_on, connect, caplog):
    scripted, looks, jump = robot_on(server), [], 0.0

    def clock():
        nonlocal jump
        if looks and threading.current_thread() is threading.main_thread():  # it is stopped between two looks
            looks.append(None)
            jump = 5.0 if len(looks) == 5 else jump  # after the lifetime of the command began
        return time.monotonic() + jump

    _, gate = connect(server.url, clock=clock)
    state = gate.step(gate.state.command)
    looks.append(None)
    late = gate.step(gate.state.command + 0.01)
    np.testing.assert_array_equal(late.command, state.command)
    assert [record.getMessage() for record in caplog.records] == [
        f"{server.url}: a command waited too long in this process, and was not sent."
    ]
    state = gate.step(gate.state.command + 0.02)
    scripted.wait_for(lambda: len(scripted.on(JOINT_COMMANDS)) == 2)
    assert scripted.on(JOINT_COMMANDS)[1]["data"] == state.command[0, :6].tolist()


def test_a_halt_overtakes_a_call_that_runs(lax, robot_on, connect):
    """One by which the robot is asked for its controllers."""
    server, blocks, release = lax(), threading.Event(), threading.Event()

    def list_controllers(request, caller):
        assert not blocks.is_set() or release.wait(DEADLINE)
        return {"controller": []}

    server.serve("/controller_manager/list_controllers", "", list_controllers)
    scripted = robot_on(server)
    robot, gate = connect(server.url)
    gate.step(gate.state.command + 0.01)
    calls = [message for _, message in server.frames if "list_controllers" in message.get("service", "")]
    blocks.set()
    asking = threading.Thread(target=robot.not_ready)
    asking.start()
    server.wait_for(lambda frames: sum("list_controllers" in one.get("service", "") for _, one in frames) > len(calls))
    robot.halt()
    scripted.wait_for(lambda: scripted.halts == 1)
    release.set()
    asking.join(DEADLINE)
    assert not asking.is_alive()


def test_what_a_halt_says(server, robot_on, connect, until):
    scripted = robot_on(server)
    robot, gate = connect(server.url)
    robot.halt()
    scripted.wait_for(lambda: len(scripted.commands) == 2)
    assert [topic for topic, _, _ in scripted.commands] == [HALT_TOPIC, JOINT_COMMANDS]  # the gripper was told nothing
    command = gate.state.command.copy()
    command[0, 6] = 0.03
    gate.step(command)
    scripted.wait_for(lambda: len(scripted.commands) == 4)
    for way, held in ((0.1, 0.1), (0.5, 0.0)):  # farther it cannot be: to go where it is measured would be a motion
        before = len(scripted.commands)
        gate.step(command)
        scripted.wait_for(lambda before=before: len(scripted.commands) == before + 2)
        there = (command[0, :6] + way).tolist()
        scripted.signals["gripper_width"], scripted.signals["joint_position"] = np.array([0.04]), np.array(there)
        until(lambda there=there: robot.measure().signals["joint_position"][0].tolist() == there)
        robot.halt()
        scripted.wait_for(lambda before=before: len(scripted.commands) == before + 5)
        (halt, gripper, joints) = scripted.commands[before + 2 :]
        assert halt[0] == HALT_TOPIC
        assert gripper[2]["data"] == [0.03]  # it goes on holding what it holds
        assert joints[2]["data"] == (command[0, :6] + held).tolist()  # the arm stays where it is
        assert {caller for _, caller, _ in (halt, gripper, joints)} != {scripted.commands[before][1]}


def test_who_only_looks_commands_nothing(server, robot_on, connect):
    scripted = robot_on(server)
    robot, gate = connect(server.url)
    robot.close()
    assert scripted.commands == []
    robot.connect()
    gate.step(gate.state.command)
    robot.close()
    scripted.wait_for(lambda: len(scripted.on(HALT_TOPIC)) == 1)


def test_a_halt_does_not_go_back_to_where_the_robot_was_some_time_ago(server, robot_on, connect):
    scripted, ahead = robot_on(server), [0.0]
    robot, gate = connect(server.url, clock=lambda: time.monotonic() + ahead[0])
    command = gate.state.command.copy()
    command[0, 5] += 0.02
    gate.step(command)
    scripted.mangle = lambda topic, message: None  # nothing more is heard of it
    ahead[0] = 1.0
    robot.halt()
    scripted.wait_for(lambda: len(scripted.on(HALT_TOPIC)) == 1 and len(scripted.on(JOINT_COMMANDS)) == 2)
    assert scripted.on(JOINT_COMMANDS)[-1]["data"] == command[0, :6].tolist()


def test_a_base_is_halted_with_zeros(server, robot_on, connect):
    scripted = robot_on(server, "mir100")
    robot, gate = connect(server.url, "mir100")
    assert {name: array.shape for name, array in gate.state.signals.items()} == {
        "base_pose": (1, 3),
        "base_velocity": (1, 2),
        "f_scan": (1, 501),
        "b_scan": (1, 511),
    }
    np.testing.assert_array_equal(gate.state.command, [[0.0, 0.0]])
    gate.step(np.array([[0.25, -0.5]]))
    scripted.wait_for(lambda: len(scripted.commands) == 1)
    robot.halt()
    scripted.wait_for(lambda: len(scripted.commands) == 3)
    assert [(topic, message.get("linear", {}).get("x")) for topic, _, message in scripted.commands] == [
        ("/cmd_vel", 0.25),
        (HALT_TOPIC, None),
        ("/cmd_vel", 0.0),
    ]


def test_without_a_halt_link_nothing_is_sent(server, robot_on, connect):
    scripted = robot_on(server)
    robot, gate = connect(server.url)
    robot._halting.close()
    assert raised(LinkLost, lambda: gate.step(gate.state.command)) == (
        f"{server.url}: the connection that halts the robot is down. Nothing is sent without it."
    )
    assert scripted.commands == []


@pytest.mark.parametrize(
    ("profile", "topic", "found", "expected"),
    [
        ("ur5e", "/object_pose", "std_msgs/String", "geometry_msgs/PoseStamped"),
        ("mir100", "/cmd_vel", "geometry_msgs/Wrench", "geometry_msgs/Twist"),  # a bridge would drop what is not
    ],
)
def test_a_topic_of_another_type(server, profile, topic, found, expected):
    for source in load_profile(profile).state:
        server.advertise(source.topic, found if source.topic == topic else source.type)
    server.subscribe("/cmd_vel", "geometry_msgs/msg/Wrench", lambda message, caller: None)
    robot = robot_at(server.url, profile)
    assert raised(ProtocolError, robot.connect) == (
        f"{topic} is a {found} there, and {expected} was expected. "
        f"Correct the topic or its type in the profile of {profile}."
    )


def test_a_controller_that_is_not_there(server):
    for topic in ("/joint_states", "/gripper/joint_states"):
        server.advertise(topic, "sensor_msgs/JointState")
    server.subscribe(GRIPPER_COMMANDS, "std_msgs/Float64MultiArray", lambda message, caller: None)
    robot = robot_at(Endpoint(server.url, timeout=1.0))
    assert raised(ProtocolError, robot.connect) == (
        f"Nobody listens to {JOINT_COMMANDS} (std_msgs/Float64MultiArray), which takes {', '.join(JOINTS)}. Is the "
        "controller active, and is the topic called so? Topics are in the profile of ur5e_position; this may be "
        "another robot than it describes."
    )


def test_a_silent_topic(server, robot_on):
    scripted = robot_on(server)
    scripted.mangle = lambda topic, message: None if topic == "/object_pose" else message
    robot = robot_at(Endpoint(server.url, timeout=1.0))
    assert raised(StaleState, robot.connect) == (
        "/object_pose (geometry_msgs/PoseStamped): no message in 1 s. Does it run, and is the topic called so? "
        "Topics are in the profile of ur5e_position."
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": list(JOINTS[:5]), "position": [0.0] * 5}, "wrist_3_joint missing; found: "),
        ({"position": [None] + [0.0] * 5}, "position of elbow_joint must be a finite number, not None."),
        ({"header": {"stamp": {"sec": "now", "nanosec": 0}}}, "header.stamp.sec must be a finite number"),
    ],
)
def test_what_a_robot_must_not_say(lax, robot_on, connect, changes, message):
    """Neither while it is driven, nor when it is connected."""
    server = lax()
    scripted = robot_on(server)
    _, gate = connect(server.url)
    scripted.mangle = lambda topic, good: {**good, **changes} if topic == "/joint_states" else good
    text = raised(ProtocolError, lambda: [gate.step(gate.state.command) for _ in range(100)])
    assert text.startswith(f"/joint_states: {message}")
    other = robot_at(server.url)
    assert raised(ProtocolError, other.connect) == text


def test_a_refused_command_and_a_late_one(server, robot_on, connect, until):
    """A late one is refused without a word; so the next one counts."""
    said = [RemoteError("expired: 0.2 s after its deadline")]

    def refuse(message, caller):
        raise said[-1]

    robot_on(server)
    _, gate = connect(server.url)
    server.subscribe(JOINT_COMMANDS, "std_msgs/Float64MultiArray", refuse)

    def answer():
        """Type and text of the error of a step, which may answer a command before it."""
        try:
            gate.step(gate.state.command)
        except (RemoteError, SafetyStop) as error:
            return type(error), str(error)
        return None, ""

    assert [answer()[0] for _ in range(3)] == [None] * 3
    for kind, text in (
        (RemoteError, "the elbow is broken"),
        (NotInCommand, "a is in command, not b; it passes on when a leaves."),
        (partial(SafetyStop, "following"), "The robot was stopped by following (G23): elbow. When it is safe, resume."),
    ):
        said.append(kind(text))
        until(lambda text=text: (found := answer())[0] is type(said[-1]) and text in found[1])


def test_a_scene_is_set_before_the_state_is_measured(server, robot_on, connect, simulation):
    scripted = robot_on(server, info=simulation)
    scenes = []

    def place(request, caller):
        scenes.append(dict(request))
        scripted.signals["object_position"] = np.array([*request["object_pose"][0][:2], 0.02])
        return {}

    service = StringRpcService(server, SCENE_TOPIC, place).start()
    try:
        robot, _ = connect(server.url)
        for n in range(3):
            pose = np.array([[0.5, 0.1 * n, 0.3]])
            state = robot.reset(ROW, Initial({"object_pose": pose}, np.array([n])))
            np.testing.assert_array_equal(state.signals["object_position"], [[0.5, 0.1 * n, 0.02]])
            assert scenes[-1]["object_pose"] == [[0.5, 0.1 * n, 0.3]]
            assert scenes[-1]["seeds"] == [n]
    finally:
        service.close()


def test_ros_1(lax, robot_on, connect):
    server = lax("ros1")
    scripted = robot_on(server)
    seconds = iter(range(1_700_000_000, 1_800_000_000))
    scripted.stamp = lambda: {"secs": next(seconds), "nsecs": 5}
    _, gate = connect(server.url, "ur5e")
    assert gate.state.stamp[0] >= 1_700_000_000
    gate.step(gate.state.command)
    scripted.wait_for(lambda: len(scripted.commands) == 2)
    message = scripted.commands[1][2]
    assert message["header"]["stamp"] == {"secs": 0, "nsecs": 0}
    assert message["points"][0]["time_from_start"] == {"secs": 0, "nsecs": 100_000_000}


def test_two_robots_behind_one_server(server, robot_on, connect):
    one, two = robot_on(server, namespace="/cell_1"), robot_on(server, namespace="/cell_2/arm")
    two.signals["gripper_width"] = np.array([0.02])
    (_, first), (_, second) = connect(f"{server.url}/cell_1"), connect(f"{server.url}/cell_2/arm/")
    assert (first.state.signals["gripper_width"], second.state.signals["gripper_width"]) == (0.085, 0.02)
    second.step(second.state.command + 0.01)
    two.wait_for(lambda: len(two.commands) == 2)
    assert one.commands == []


def drive(url, results):
    """In a worker: connect, step."""
    robot = robot_at(url)
    try:
        robot.connect()
        gate = OpenGate(robot)
        results.put(gate.step(gate.state.command).signals["gripper_width"].tolist())
    finally:
        robot.close()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_in_a_forked_worker(server, robot_on, connect, until):
    scripted = robot_on(server)
    robot, gate = connect(server.url)
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    worker = context.Process(target=drive, args=(server.url, results))
    worker.start()
    assert results.get(timeout=60) == [[0.085]]
    worker.join(DEADLINE)
    assert worker.exitcode == 0
    until(lambda: robot.not_ready() is None)  # for a second, somebody else has just commanded it
    before = len(scripted.on(JOINT_COMMANDS))
    gate.step(gate.state.command)  # this process goes on
    scripted.wait_for(lambda: len(scripted.on(JOINT_COMMANDS)) > before)


def subscriptions(server):
    asked = {}
    for _, frame in server.frames:
        if frame["op"] == "subscribe" and "/io_" not in frame["topic"] and "/speed_" not in frame["topic"]:
            asked[frame["topic"]] = (frame["throttle_rate"], frame["queue_length"])
    return asked


@pytest.mark.parametrize(("period", "rate"), [(0.05, 10), (0.004, 0)])
def test_states_are_asked_for_throttled_and_the_newest_alone(lax, robot_on, connect, period, rate):
    """Whole milliseconds: servers in Python drop a subscription for anything else, without a word."""
    server, profile = lax(), load_profile("ur5e")
    robot_on(server)
    shared = tuple(replace(one, partial=one.signal == "gripper_width") for one in profile.state)
    robot = RosbridgeRobot(server.url, replace(profile, state=shared), spec=replace(profile.spec(), period=period))
    robot.connect()
    robot.close()
    expected = (rate, 1 if rate else 0)
    assert subscriptions(server) == {
        "/joint_states": expected,
        "/object_pose": expected,
        "/gripper/joint_states": (0, 0),  # shared by several publishers, it comes whole
        "/scaled_joint_trajectory_controller/joint_trajectory": (
            0,
            0,
        ),  # to see whether somebody else commands the robot
        "/gripper/commands": (0, 0),
    }
    assert all(type(number) is int for pair in subscriptions(server).values() for number in pair)


def test_states_that_answer_commands_come_all(lax, robot_on, connect, simulation):
    server = lax()
    robot_on(server, info=simulation)
    connect(server.url)
    assert set(subscriptions(server).values()) == {(0, 0)}
