"""Live robots behind their guards: served robots, through a server, as any robot."""

import json

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, LinkLost, ProtocolError, SafetyStop, UnknownName
from bam_envs.core.location import Credentials
from bam_envs.core.robot import EnvIds, Initial, Robot, RobotState
from bam_envs.live.building import live_robot, profile_limits
from bam_envs.live.rosbridge_robot import RosbridgeRobot
from bam_envs.remote.serve.command_lease import CommandLease
from bam_envs.remote.serve.robot_service import RobotService
from bam_envs.remote.serve.served_robot import ServedRobot
from bam_envs.robots.base_description import base_model
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.kinematic_base import SimulatedBase
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import JOINTS, arm_spec
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Limits
from bam_envs.testing import RobotContract

ROW = np.zeros(1, np.int64)


class Box:
    """A robot in a box: a fake one, served on a port of its own."""

    def __init__(self, robot, initial, realtime):
        profile = load_profile("mir100" if isinstance(robot, SimulatedBase) else "ur5e")
        self.server = BridgeServer(port=0).start()
        self.robot = ServedRobot(
            robot, command_timeout=profile.command_timeout, zero_rests=profile.kind == "base", realtime=realtime
        )
        self.robot.connect()
        self.robot.reset(ROW, initial)
        self.service = RobotService(self.robot, profile, self.server, CommandLease(0.5))
        self.service.start()

    def close(self):
        self.service.close()
        self.server.close()
        self.robot.close()


class LiveContract(RobotContract):
    """Of live robots: n is 1, and each test has a box of its own."""

    sizes = (1,)
    holds_what_is_not_finite = True
    realtime = False

    @pytest.fixture(autouse=True)
    def _boxes(self):
        served = [self.served(), self.served()]  # as many as a test makes robots
        self.boxes = [Box(robot, self.initial(robot, ROW), self.realtime) for robot in served]
        self.urls = [box.server.url for box in self.boxes]
        yield
        for box in self.boxes:
            box.close()

    def served(self):
        raise NotImplementedError

    def make(self, num_robots: int) -> Robot:
        return live_robot(self.urls.pop(), self.served().spec)


class TestLiveArm(LiveContract):
    def served(self):
        return FakeRobot(1)

    def move(self, robot: Robot, state: RobotState) -> np.ndarray:
        return self.stay(state) - 0.005


class TestLiveArmInRealTime(TestLiveArm):
    realtime = True

    def test_stamps_go_on(self) -> None:
        """On a busy computer a state may come a period late."""
        with self.running() as (robot, first):
            assert any((robot.step(self.stay(first)).stamp > first.stamp).all() for _ in range(10))


class TestLiveBase(LiveContract):
    def served(self):
        return SimulatedBase(1)

    def initial(self, robot: Robot, env_ids: EnvIds) -> Initial:
        return Initial({}, np.zeros(1, np.int64))

    def measured(self, state: RobotState) -> np.ndarray:
        return state.signals["base_velocity"]

    def move(self, robot: Robot, state: RobotState) -> np.ndarray:
        return np.array([[0.1, 0.1]])


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("http://robot:9090", ", not 'http://robot:9090'. Did you mean 'ws://robot:9090'?"),
        ("10.0.0.5:9090", ", not '10.0.0.5:9090'. Did you mean 'ws://10.0.0.5:9090'?"),
        (
            "tcp://10.0.0.5:5555",
            "; 'tcp://10.0.0.5:5555' is that of a whole environment. Give it as transport='tcp://10.0.0.5:5555' "
            "(--transport).",
        ),
        ("", ", such as ws://10.0.0.5:9090, not ''."),
    ],
)
def test_an_address_of_something_else(url, text):
    with pytest.raises(InvalidValue) as caught:
        live_robot(url)
    assert str(caught.value) == f"A live robot's address is ws://host:port or wss://host:port{text}"


def test_certificates_without_tls():
    with pytest.raises(InvalidValue) as caught:
        live_robot("ws://robot", credentials=Credentials("ca.pem"))
    assert str(caught.value) == (
        "ws://robot: ca_file is for wss:// only, and this address is without TLS; leave it out."
    )
    live_robot("wss://robot", credentials=Credentials("ca.pem"))


def test_its_profile():
    assert live_robot("ws://robot").spec == arm_spec("ur5e", with_object=True)
    assert live_robot("ws://robot", base_model("mir100").spec()).spec == base_model("mir100").spec()
    assert live_robot("ws://robot", profile="mir100").spec.name == "mir100"
    assert live_robot("ws://robot", profile=load_profile("mir100")).spec.name == "mir100"
    with pytest.raises(UnknownName, match="Did you mean 'ur5e'"):
        live_robot("ws://robot", profile="ur5")
    with pytest.raises(InvalidValue, match=r"^The robot profile \. cannot be read: "):
        live_robot("ws://robot", profile="")  # of a variable that was never set: not the default instead
    with pytest.raises(InvalidValue, match=r"^The profile mir100 is that of another robot: it has linear_"):
        live_robot("ws://robot", arm_spec("ur5e", with_object=False), profile="mir100")


def test_its_limits(tmp_path):
    path = tmp_path / "slow.toml"
    path.write_text(
        'extends = "ur5e"\nname = "slow"\nkind = "arm"\nmax_age = 0.2\n[limits]\njoint_speed = 0.25\ntool_speed = 0.1\n'
    )
    expected = Limits(joint_speed=0.25, tool_speed=0.1, max_age=0.2)
    assert profile_limits(load_profile(path)) == expected
    assert live_robot("ws://robot", profile=path).limits == expected
    assert live_robot("ws://robot", profile=path, limits=Limits()).limits == Limits()
    assert live_robot("ws://robot", profile="mir100").limits == Limits(max_age=0.5)


def test_some_limits_of_its_guards():
    slow = live_robot("ws://robot", profile="mir100", guards={"base_speed": 0.2}).limits
    assert slow == Limits(max_age=0.5, base_speed=0.2)
    with pytest.raises(InvalidValue) as caught:
        live_robot("ws://robot", guards={"tool_speed": 2.0})
    assert str(caught.value) == "The limit tool_speed of a live robot must be 0.005 to 1 m/s, not 2."
    for wrong in (5, [], "joint_speed=0.3"):
        with pytest.raises(InvalidValue) as caught:
            live_robot("ws://robot", guards=wrong)
        expected = f"guards= must be limits by name, such as {{'joint_speed': 0.3}}, not {wrong!r}."
        assert str(caught.value) == expected


@pytest.mark.parametrize(
    ("spec", "limit", "value"),
    [
        (base_model("mir100").spec(), "box_x_min", -1.0),
        (base_model("mir100").spec(with_scans=False), "laser_slow", 0.5),
        (arm_spec("ur5e", with_object=False), "base_speed", 0.3),
        (arm_spec("ur5e", with_object=False), "singularity_slow", 15.0),  # not along straight lines
    ],
)
def test_a_limit_that_no_guard_of_the_robot_has_is_refused(spec, limit, value):
    with pytest.raises(InvalidValue) as caught:
        live_robot("ws://robot", spec, guards={limit: value})
    assert str(caught.value) == (
        f"The limit {limit} would change nothing: {spec.name} has no guard for it in this task. Leave it out; "
        "bam-deploy --print-guards lists the guards."
    )


def test_what_its_guards_did_is_published_in_every_tick(server, robot_on, start_pose, until):
    robot_on(server, namespace="/arm_1")
    heard = []
    server.subscribe("/arm_1/bam/status", "std_msgs/String", lambda message, caller: heard.append(message["data"]))
    robot = live_robot(f"{server.url}/arm_1")
    robot.connect()
    try:
        state = robot.reset(np.zeros(1, np.int64), start_pose)
        assert heard == []
        state = robot.step(state.command)
        far = state.command + np.array([0, 0, 0, 0, 0, 0.04, 0])
        robot.step(far)
        for _ in range(2):
            robot.step(np.full_like(far, np.nan))
        with pytest.raises(SafetyStop):
            robot.step(np.full_like(far, np.nan))
    finally:
        robot.close()
    until(lambda: len(heard) >= 5)
    expected = [
        (0, "", False),
        (9, "joint acceleration (G9)", False),
        *[(2, "finite (G2)", stop) for stop in (0, 0, 1)],
    ]
    assert [tuple(json.loads(one).values()) for one in heard] == expected
    assert (robot.code, robot.status) == (2, "finite (G2)")
    assert robot.stopped.startswith("finite (G2): the command for shoulder_pan_joint")


def test_its_token(tmp_path, robot_on, start_pose):
    path = tmp_path / "token"
    with pytest.raises(InvalidValue, match=r"^The token file .* cannot be read: "):
        live_robot("ws://robot", credentials=Credentials(token_file=str(path)))
    path.touch(0o600)
    path.write_text("secret\n")
    with BridgeServer(port=0, token="secret") as server:
        robot_on(server)
        robot = live_robot(server.url, credentials=Credentials(token_file=str(path)))
        robot.connect()
        robot.reset(ROW, start_pose)
        robot.close()
        with pytest.raises(LinkLost, match=r"the server asks for a token, and none was given \(HTTP 401\)"):
            live_robot(server.url).connect()


def test_no_way_leads_around_the_gate(server, robot_on, start_pose):
    """Neither an array nor a command of an earlier tick."""
    scripted = robot_on(server)
    inner = RosbridgeRobot(server.url, load_profile("ur5e"))
    robot = SafeRobot(inner)
    robot.connect()
    try:
        state, kept = robot.reset(ROW, start_pose), []
        step, inner.step = inner.step, lambda command: kept.append(command) or step(command)
        robot.step(state.command)
        before = len(scripted.on("/forward_position_controller/commands"))
        for forged in (state.command, kept[0], type(kept[0]), None):
            with pytest.raises(InvalidValue):
                step(forged)
        assert len(scripted.on("/forward_position_controller/commands")) == before
    finally:
        robot.close()


def test_a_robot_that_talks_nonsense_is_halted(lax, robot_on, start_pose):
    server = lax()
    scripted = robot_on(server)
    robot = live_robot(server.url)
    robot.connect()
    try:
        state = robot.reset(ROW, start_pose)
        halts = scripted.halts
        scripted.mangle = lambda topic, message: message | {"name": []} if topic == "/joint_states" else message
        with pytest.raises(ProtocolError) as caught:
            [robot.step(state.command) for _ in range(100)]
        assert str(caught.value) == f"/joint_states: {', '.join(JOINTS)} missing; found: no name."
        scripted.wait_for(lambda: scripted.halts > halts)
    finally:
        robot.close()
