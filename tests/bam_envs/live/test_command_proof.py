"""A live arm behind a rosbridge server: nothing moves far before its commands are proved, in real time."""

import json
import time

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, NotReady, SafetyStop
from bam_envs.live import rosbridge_robot
from bam_envs.live.building import live_robot
from bam_envs.live.command_proof import Controllers, ask_controllers
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import JOINTS
from bam_envs.ros.codec import RobotInfo
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint
from tests.bam_envs.live.conftest import HOME, ScriptedRobot

pytestmark = pytest.mark.proves
ROW = np.zeros(1, np.int64)
ARM, TRAJECTORY = "/forward_position_controller/commands", "/scaled_joint_trajectory_controller/joint_trajectory"
SWAPPED = ("shoulder_lift_joint", "shoulder_pan_joint", *JOINTS[2:])


class TimedArm(ScriptedRobot):
    """Goes to a trajectory's point in its time; `wiring` is what its driver makes of the joints."""

    def __init__(self, bus, wiring=lambda joints: joints, **options):
        super().__init__(bus, **options)
        self.wiring, self.goal, self.ends, self.at = wiring, None, 0.0, time.monotonic()
        self.farthest = 0.0

    def _move(self):
        message = self.last
        point = message["points"][0]
        reach = point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"]
        self.goal, self.ends = self.wiring(np.array(point["positions"])), time.monotonic() + reach

    def _listener(self, topic):
        listen = super()._listener(topic)

        def keep(message, caller):
            self.last = message
            listen(message, caller)

        return keep

    def publish(self):
        with self._lock:
            now, before = time.monotonic(), self.signals["joint_position"].copy()
            if self.goal is not None:
                left = max(self.ends - self.at, 1e-9)
                share = min(1.0, (now - self.at) / left)
                self.signals["joint_position"] = before + (self.goal - before) * share
            self.signals["joint_velocity"] = (self.signals["joint_position"] - before) / max(now - self.at, 1e-3)
            self.at = now
            self.farthest = max(self.farthest, np.abs(self.signals["joint_position"] - HOME).max())
        super().publish()


@pytest.fixture
def arm_on(server):
    arms = []

    def start(*arguments, **options):
        arms.append(TimedArm(server, *arguments, **options).start())
        return arms[-1]

    yield start
    for one in arms:
        one.stop()


@pytest.fixture
def connected(server):
    robots = []

    def connect(profile="ur5e", **options):
        # On a busy computer, too.
        robots.append(live_robot(server.url, profile=profile, guards={"max_age": 1.0, "action_age": 1.0}, **options))
        robots[-1].connect()
        return robots[-1]

    yield connect
    for robot in robots:
        robot.close()


@pytest.mark.parametrize(
    "wiring",
    [
        lambda joints: joints[[1, 0, 2, 3, 4, 5]],
        lambda joints: joints * (1, 1, -1, 1, 1, 1),
        lambda joints: joints + 0.41,
    ],
    ids=["swapped", "mirrored", "offset"],
)
def test_a_wrong_arm_hardly_moves_and_rests_after_the_stop(arm_on, connected, start_pose, wiring):
    arm = arm_on(wiring)
    robot = connected()
    assert robot.is_unproved
    with pytest.raises(SafetyStop, match=r"first motion \(G25\): \w+ was commanded to stay where it is measured, and"):
        robot.reset(ROW, start_pose)
    arm.wait_for(lambda: arm.on(TRAJECTORY)[-1]["points"][0]["time_from_start"]["sec"] == 1_000_000)
    assert arm.farthest < 0.05
    rests = arm.signals["joint_position"].copy()
    robot.close()
    np.testing.assert_allclose(arm.signals["joint_position"], rests, atol=1e-4)
    assert arm.on("/gripper/commands") == []


@pytest.mark.slow
def test_a_right_arm_is_proved_once(arm_on, connected, start_pose):
    """One that is known by a name; then its last joint alone moves 0.02 rad, and the others 0.0005 rad."""
    arm, moved = arm_on(), []
    for _ in range(2):
        robot = connected(robot_name="left arm")
        arm.commands.clear()
        assert robot.is_unproved
        robot.reset(ROW, start_pose)
        assert not robot.is_unproved
        moved.append(np.ptp([one["points"][0]["positions"] for one in arm.on(TRAJECTORY)], axis=0))
        robot.close()
    np.testing.assert_allclose(moved, [[0.02] * 6, [0.0005] * 5 + [0.02]], atol=1e-6)
    assert arm.farthest < 0.05


def test_positions_in_an_order_that_nothing_tells_are_not_sent(server, robot_on, connected, start_pose):
    scripted = robot_on(server)
    robot = connected("ur5e_position")
    with pytest.raises(NotReady) as caught:
        robot.reset(ROW, start_pose)
    assert str(caught.value) == (
        f"The commands of {server.url} are not proved: nothing tells in which order {ARM} takes {', '.join(JOINTS)}: "
        "the parameter joints of forward_position_controller cannot be read here. Nothing has moved."
    )
    robot.halt()
    assert scripted.on(ARM) == []


@pytest.mark.parametrize("order", [JOINTS, SWAPPED])
@pytest.mark.parametrize("way", ["interfaces", "parameter", "rosapi"])
def test_the_order_of_a_controller_is_read(server, robot_on, way, order):
    robot_on(server)
    rows = [{"name": "forward_position_controller", "state": "active", "type": "position_controllers/X"}]
    if way == "interfaces":
        rows[0]["required_command_interfaces"] = [f"{name}/position" for name in order]
    server.serve("/controller_manager/list_controllers", "x/X", lambda request, caller: {"controller": rows})
    if way == "parameter":
        answer = {"values": [{"type": 9, "string_array_value": list(order)}]}
        server.serve("/forward_position_controller/get_parameters", "x/X", lambda request, caller: answer)
    if way == "rosapi":
        asked = "/forward_position_controller:joints"
        server.serve(
            "/rosapi/get_param",
            "x/X",
            lambda request, caller: {"value": json.dumps(list(order)) if request["name"] == asked else ""},
        )
    profile, link = load_profile("ur5e_position"), RosbridgeLink(server.url)
    link.connect()
    try:
        controllers = ask_controllers(link, profile, profile.sinks())
    finally:
        link.close()
    assert controllers.joints == {ARM: order}
    assert controllers.fault(profile, profile.sinks()) == (
        ""
        if order == JOINTS
        else f"forward_position_controller takes the joints in the order {', '.join(SWAPPED)}, and the profile "
        f"ur5e_position sends {', '.join(JOINTS)}: give the labels of {ARM} in that order"
    )


@pytest.mark.parametrize(("state", "loop", "jerks"), [(False, None, True), (True, None, False), (False, True, False)])
def test_a_controller_that_begins_where_the_arm_is_measured_is_known(server, robot_on, state, loop, jerks):
    robot_on(server)
    values = [{"type": 0 if value is None else 1, "bool_value": bool(value)} for value in (state, loop)]
    name = "scaled_joint_trajectory_controller"
    server.serve(f"/{name}/get_parameters", "x/X", lambda request, caller: {"values": values})
    profile, link = load_profile("ur5e"), RosbridgeLink(server.url)
    link.connect()
    try:
        assert ask_controllers(link, profile, profile.sinks()).from_measured == ((name,) if jerks else ())
    finally:
        link.close()


@pytest.mark.parametrize(
    ("topic", "field", "off"),
    [("controller_state", "feedback", 0.0), ("controller_state", "feedback", 0.06), ("state", "actual", -3.0)],
)
def test_a_controller_that_measures_a_joint_elsewhere_is_sent_nothing(
    server, robot_on, connected, start_pose, topic, field, off
):
    """Such as where the profile has the scale of a joint wrong: a motion would show that too late."""
    scripted, name = robot_on(server), "scaled_joint_trajectory_controller"
    kind, there = "control_msgs/JointTrajectoryControllerState", [*HOME[[1, 0]], *HOME[2:5], HOME[5] + off]
    server.advertise(f"/{name}/{topic}", kind, latch=True)
    server.publish(f"/{name}/{topic}", {"joint_names": list(SWAPPED), field: {"positions": there}})
    robot = connected()
    if off == 0.0:
        assert robot.is_unproved
        return
    with pytest.raises(NotReady) as caught:
        robot.reset(ROW, start_pose)
    assert str(caught.value) == (
        f"The commands of {server.url} are not proved: {name} measures wrist_3_joint at {HOME[5] + off:.3f} rad, and "
        f"the profile ur5e reads {HOME[5]:.3f} rad: another joint, sign, offset or scale in the profile, or in the "
        "driver. Nothing has moved."
    )
    robot.close()
    rests = {message["points"][0]["time_from_start"]["sec"] for message in scripted.on(TRAJECTORY)}
    assert rests <= {1_000_000}  # of the halt: it stays where it is


def test_whose_commands_need_no_proof(server):
    profile, at = load_profile("ur5e"), Endpoint(server.url)
    link = RosbridgeLink(server.url)
    link.connect()
    try:
        for info in (RobotInfo("x", simulated=True), RobotInfo("x", agent=True)):
            assert rosbridge_robot.needed_proof(link, info, profile, profile.sinks(), at) is None
        base = load_profile("mir100")
        assert rosbridge_robot.needed_proof(link, None, base, base.sinks(), at) is None
        proof = rosbridge_robot.needed_proof(link, RobotInfo("x"), profile, profile.sinks(), at)
        assert (proof.fault, proof.is_timed, proof.is_known) == ("", True, False)
    finally:
        link.close()


def test_a_proof_is_remembered_for_a_robot_that_is_known_and_not_for_the_end_of_a_tunnel(server):
    profile, link = load_profile("ur5e"), RosbridgeLink(server.url)
    link.connect()

    def proof(info=None, name=""):
        endpoint = Endpoint(server.url, robot_name=name)
        return rosbridge_robot.needed_proof(link, info, profile, profile.sinks(), endpoint)

    left = RobotInfo("ur5e", identity="left arm")
    try:
        proof().done(0.1)
        assert not proof().is_known
        proof(name="left arm").done(0.1)
        assert [proof(left).is_known, proof(name="left arm").is_known, proof(name="right arm").is_known] == [1, 1, 0]
        with pytest.raises(InvalidValue, match=r"says that it is left arm, not right arm: correct the name, or the "):
            proof(left, name="right arm")
        server.serve("/dashboard_client/get_serial_number", "x/X", lambda *asked: {"serial_number": 2019550123})
        proof().done(0.1)
        assert proof(name="2019550123").is_known
    finally:
        link.close()


def test_a_remembered_proof_is_void_where_the_controller_takes_another_order_now(server):
    link, orders = RosbridgeLink(server.url), [JOINTS, SWAPPED]
    service = "/forward_position_controller/get_parameters"
    server.serve(service, "x/X", lambda *asked: {"values": [{"type": 9, "string_array_value": list(orders[0])}]})
    link.connect()

    def proof(name):
        profile, endpoint = load_profile(name), Endpoint(server.url, robot_name="left arm")
        return rosbridge_robot.needed_proof(link, None, profile, profile.sinks(), endpoint)

    try:
        assert "nothing has shown them yet" in proof("ur5e_position").fault
        proof("ur5e").done(0.1)
        assert (proof("ur5e_position").is_known, proof("ur5e_position").fault) == (True, "")
        del orders[0]
        assert proof("ur5e_position").fault.startswith(
            f"forward_position_controller takes the joints in the order {', '.join(SWAPPED)}, and the profile "
        )
    finally:
        link.close()


def test_a_proof_belongs_to_a_robot_with_its_controllers(tmp_path, monkeypatch):
    from bam_envs.live.command_proof import CommandProof

    profile = load_profile("ur5e")
    row = {"name": "scaled_joint_trajectory_controller", "type": "x/X", "required_command_interfaces": ["a/position"]}
    keys = {
        CommandProof(one, one.sinks(), Controllers(rows, {}), name).key
        for one, rows, name in (
            (profile, (), "cell 7"),
            (profile, (), "cell 8"),
            (profile, (row,), "cell 7"),
            (profile, ({**row, "required_command_interfaces": ["b/position"]},), "cell 7"),
            (profile, ({**row, "type": "y/Y"},), "cell 7"),
        )
    }
    assert len(keys) == 5
    states = [CommandProof(profile, profile.sinks(), Controllers(({**row, "state": s},), {}), "x").key for s in "ab"]
    assert states[0] == states[1]
