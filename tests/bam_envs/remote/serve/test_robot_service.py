import json
import math
import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import LinkLost, NotInCommand, PhysicsDiverged
from bam_envs.core.robot import Initial
from bam_envs.remote.serve.command_lease import CommandLease
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.remote.serve.robot_service import CommandSlot, Order, RobotService
from bam_envs.remote.serve.served_robot import ServedRobot
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.kinematic_arm import reach_arm
from bam_envs.robots.physics.kinematic_base import SimulatedBase
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import JOINTS
from bam_envs.ros.codec import RobotInfo, read_info
from bam_envs.ros.freshness import Tagger, read_echo
from bam_envs.rosbridge.bus import Caller
from bam_envs.rosbridge.sessions import LEASE_TOPIC, read_session
from bam_envs.testing.transports import MirrorEnv
from tests.bam_envs.making import encode_command

HOME = np.array([[0.0, -1.2, 1.6, -2.0, -1.57, 0.0]])
ARM, GRIPPER = "/forward_position_controller/commands", "/gripper/commands"
UR5E = load_profile("ur5e")


def initial():
    return Initial({"joint_position": HOME, "object_pose": np.array([[0.5, 0.1, 0.3]])}, np.zeros(1, dtype=np.int64))


def command(change=0.0, width=0.085):
    return np.concatenate([HOME[0] + change, [width]])


def in_order(message):
    return {
        **message,
        "position": [dict(zip(message["name"], message["position"], strict=True))[one] for one in JOINTS],
    }


class Service:
    """A service, its robot, its bus and its lease."""

    def __init__(self, bus, robot, realtime, lease=None, **options):
        self.bus, self.lease = bus, lease or CommandLease(5.0)
        self.robot = ServedRobot(robot, command_timeout=0.1, realtime=realtime)
        self.robot.connect()
        self.robot.reset(np.zeros(1, dtype=np.int64), initial())
        self.service = RobotService(self.robot, UR5E, bus, self.lease, **options)
        self.service.start()

    def session(self, caller="a"):
        """What signs for a new session of `caller`."""
        who = Caller(caller, f"{caller}:1") if caller else Caller("")
        return read_session(self.bus.services["/bam/session"][1]({}, who), "/bam/session")

    def send(self, numbers, tagger=None, caller="a", tag=None):
        """Every message of a command, signed by `tagger` if there is one; the first refusal, or None."""
        tag = tag or (tagger.next(1, 0.1) if tagger else None)
        for topic, _, message in encode_command(UR5E, self.robot.spec, numbers, tag, sign=tagger and tagger.sign):
            refusal = self.bus.say(topic, message, caller)
            if refusal is not None:
                return refusal
        return None

    def say(self, word, tagger, caller="a"):
        """A signed word about the lease; the refusal, or None."""
        tag = tagger.next(1, 0.1)
        return self.bus.say(LEASE_TOPIC, {"data": f"{word} {tagger.sign(tag, LEASE_TOPIC, word.encode())}"}, caller)

    def joints(self, condition=lambda message: True):
        """The newest joint states that fit, their positions in the order of `JOINTS`."""
        return in_order(self.bus.wait_for("/joint_states", lambda message: condition(in_order(message))))


@pytest.fixture
def serve(bus):
    served = []

    def make(robot=None, realtime=False, **options):
        served.append(Service(bus, robot or FakeRobot(1), realtime, **options))
        return served[-1]

    yield make
    for one in served:
        one.service.close()
        one.service.close()
        one.robot.close()


def test_what_it_offers(serve, bus):
    serve(namespace="/cell")
    assert bus.advertised == {
        "/cell/joint_states": "sensor_msgs/JointState",
        "/cell/gripper/joint_states": "sensor_msgs/JointState",
        "/cell/object_pose": "geometry_msgs/PoseStamped",
        "/cell/bam/scene/reply": "std_msgs/String",
    }
    assert {topic: entries[0][0] for topic, entries in bus.listeners.items()} == {
        "/cell/gripper/commands": "std_msgs/Float64MultiArray",
        "/cell/forward_position_controller/commands": "std_msgs/Float64MultiArray",
        "/cell/scaled_joint_trajectory_controller/joint_trajectory": "trajectory_msgs/JointTrajectory",
        "/cell/bam/halt": "std_msgs/Empty",
        "/cell/bam/lease": "std_msgs/String",
        "/cell/bam/scene/request": "std_msgs/String",
    }
    assert {name: kind for name, (kind, _) in bus.services.items()} == {
        "/cell/bam/robot": "std_srvs/Trigger",
        "/cell/bam/session": "std_srvs/Trigger",
        "/cell/controller_manager/list_controllers": "controller_manager_msgs/ListControllers",
    }
    advertised, listeners = set(bus.advertised), set(bus.listeners)
    service = serve(reach_arm(1, ur_model="ur5e"))  # without a gripper, and its topics
    assert set(bus.advertised) - advertised == {"/joint_states", "/bam/scene/reply"}
    trajectory = "/scaled_joint_trajectory_controller/joint_trajectory"
    assert set(bus.listeners) - listeners == {ARM, trajectory, "/bam/halt", "/bam/lease", "/bam/scene/request"}
    assert bus.say(ARM, {"data": (HOME[0] + 0.01).tolist()}, "a") is None
    state = service.joints(lambda message: message["position"] != HOME[0].tolist())
    np.testing.assert_allclose(state["position"], HOME[0] + 0.01)


@pytest.mark.parametrize(
    ("realtime", "text"),
    [
        (False, "ur5e, served in lockstep: its time advances with commands, 0.05 s each"),
        (True, "ur5e, served in real time; it rests 0.1 s after the last command"),
    ],
)
def test_it_says_what_it_is(serve, bus, realtime, text):
    serve(realtime=realtime)
    answer = bus.services["/bam/robot"][1]({}, None)
    assert answer["success"] is True
    assert read_info(answer["message"], "/bam/robot") == RobotInfo("ur5e", True, not realtime, 0.05, text, 0.1)


def test_in_lockstep_each_command_is_one_period_and_is_echoed(serve):
    """The echo is public; the signature of the command is not in it."""
    service = serve()
    tagger = service.session()
    assert service.send(command(0.01), tagger) is None
    state = service.joints(lambda message: message["header"]["frame_id"] == f"bam1 s={tagger.session} q=1")
    np.testing.assert_allclose(state["position"], HOME[0] + 0.01)
    assert abs(state["header"]["stamp"]["sec"] - time.time()) < 10
    assert service.robot.state.stamp == pytest.approx(0.05)


def test_in_lockstep_nothing_goes_on_before_a_command_is_complete(serve, bus):
    service = serve()
    gripper, arm = encode_command(UR5E, service.robot.spec, command(0.01, 0.04), None)
    assert (gripper[0], arm[0]) == (GRIPPER, ARM)
    bus.say(GRIPPER, gripper[2])
    count = len(bus.published)
    with bus.news:
        assert bus.news.wait_for(lambda: len(bus.published) > count + 6, 10)
    assert service.robot.state.stamp == 0.0
    bus.say(ARM, arm[2])
    service.joints(lambda message: message["position"][0] == 0.01)
    np.testing.assert_allclose(service.robot.target(), [command(0.01, 0.04)])


def test_in_real_time_states_come_with_or_without_commands(serve, bus, until):
    service = serve(SimulatedArm(1), realtime=True)
    for number in range(1, 11):
        assert service.send(command(0.005 * number)) is None
        count = len(bus.published)
        with bus.news:
            assert bus.news.wait_for(lambda count=count: len(bus.published) >= count + 9, 10)
    service.joints(lambda message: message["position"][0] > 0.001)
    # Nobody says anything any more: it rests, and still says where.
    until(lambda: service.robot.resting)
    stamp = service.robot.state.stamp[0]
    with bus.news:
        assert bus.news.wait_for(lambda: service.robot.state.stamp[0] > stamp, 10)


def test_bad_commands_are_refused_and_the_robot_does_not_move(serve, bus):
    service = serve()
    text = f"ProtocolError: {ARM}: data must have 6 ({', '.join(JOINTS)}) numbers, not 2."
    assert bus.say(ARM, {"data": [1.0, 2.0]}) == text
    for first in (None, math.nan, "1"):
        text = f"ProtocolError: {ARM}: data[0] must be a finite number, not {first!r}."
        assert bus.say(ARM, {"data": [first] + [0.0] * 5}) == text
    text = f"ProtocolError: {ARM}: shoulder_pan_joint must be -6.28319 to 6.28319 rad, not 7 rad."
    assert bus.say(ARM, {"data": [7.0] + [0.0] * 5}) == text
    assert service.robot.state.stamp == 0.0
    assert service.lease.holder is None


def test_old_commands_and_those_of_a_session_that_nobody_opened_are_refused(serve, tagger):
    service = serve()
    assert service.send(command(0.5), tagger) == (
        f"RemoteError: session {tagger.session} is not open here: reset(), which opens one at /bam/session; "
        "both sides must be of one version of bam-train"
    )
    tagger = service.session()
    first, second = tagger.next(1, 0.1), tagger.next(1, 0.1)
    assert service.send(command(0.01), tagger, tag=second) is None
    assert service.send(command(0.5), tagger, tag=first) == "RemoteError: old message: number 1 after number 2"
    late = replace(second, sequence=9, sent=second.sent - 5.0, deadline=second.sent - 4.9)
    assert service.send(command(0.5), tagger, tag=late).startswith("RemoteError: expired: ")
    assert service.send(command(0.02), tagger, tag=replace(tagger.next(2, 0.1), sequence=10)) is None
    old = replace(tagger.next(1, 0.1), sequence=11)
    assert service.send(command(0.5), tagger, tag=old) == ("RemoteError: old connection: epoch 1, and epoch 2 is there")


def forgeries(service, tagger, heard):
    """Messages of somebody who has heard everything but the key: (what it is, messages, the refusal)."""
    tag = tagger.next(1, 5.0)
    ahead = replace(tag, sequence=tag.sequence + 10**6)
    (_, _, gripper), (arm, _, message) = heard
    moved = {**message, "data": [value + 1.0 for value in message["data"]]}
    other = Tagger(session=tagger.session, key=bytes(32))
    wrong = f"RemoteError: session {tagger.session}: the signature of a message on {arm} is wrong"
    unsigned = encode_command(UR5E, service.robot.spec, command(0.5), ahead)[1][2]
    guessed = encode_command(UR5E, service.robot.spec, command(0.5), ahead, sign=other.sign)[1][2]
    label = message["layout"]["dim"][0]["label"].replace(" q=1 ", " q=1000000 ")
    counted = {**message, "layout": {**message["layout"], "dim": [{**message["layout"]["dim"][0], "label": label}]}}
    elsewhere = {**moved, "layout": gripper["layout"]}
    return arm, {
        "the tag without a signature": (unsigned, wrong),
        "a guessed key": (guessed, wrong),
        "the signature with other numbers": (moved, wrong),
        "the signature with another counter": (counted, wrong),
        "the signature of another topic": (elsewhere, wrong),
    }


@pytest.mark.parametrize("driver", ["a", ""])
def test_nothing_that_a_watcher_can_send_is_executed(serve, bus, driver):
    """On the embedded server, and through somebody else's bridge, where all senders are nameless."""
    service = serve()
    tagger = service.session(driver)
    heard = encode_command(UR5E, service.robot.spec, command(0.01), tagger.next(1, 5.0), sign=tagger.sign)
    assert [bus.say(topic, message, driver) for topic, _, message in heard] == [None, None]
    service.joints(lambda message: message["header"]["frame_id"] == f"bam1 s={tagger.session} q=1")
    stamp = service.robot.state.stamp[0]
    arm, forged = forgeries(service, tagger, heard)
    for what, (message, text) in forged.items():
        assert bus.say(arm, message, driver and "b") == text, what
    replayed = bus.say(arm, heard[1][2], driver and "b")
    other, old = f"session {tagger.session} is of another connection", "old message: number 1 after number 1"
    assert replayed == f"RemoteError: {other if driver else old}"
    assert bus.say(arm, {"data": [0.0] * 6}, driver and "b").startswith("NotInCommand: ")
    assert service.robot.state.stamp[0] == stamp
    assert service.send(command(0.02), tagger, driver) is None


def test_who_drives_keeps_command_by_signs_of_life_and_leaves_by_a_word(serve, bus):
    now = [0.0]
    service = serve(lease=CommandLease(2.0, lambda: now[0]))
    tagger = service.session("")
    assert service.send(command(0.01), tagger, "") is None
    for _ in range(10):
        now[0] += 1.0
        assert service.say("renew", tagger, "") is None
    assert service.send(command(0.02), caller="b").startswith("NotInCommand: ")
    forger = Tagger(session=tagger.session, key=bytes(32))
    wrong = f"RemoteError: session {tagger.session}: the signature of a message on /bam/lease is wrong"
    assert [service.say(word, forger, "") for word in ("renew", "leave")] == [wrong, wrong]
    assert bus.say(LEASE_TOPIC, {"data": "leave"}, "b") == (
        "ProtocolError: /bam/lease: expected renew or leave and a signed tag."
    )
    assert service.say("leave", tagger, "") is None
    assert service.robot.resting
    assert service.lease.holder is None
    assert "is not open here" in service.say("renew", tagger, "")


def test_one_client_is_in_command_and_the_others_are_told(serve, bus):
    service = serve()
    assert service.send(command(0.01), caller="a") is None
    assert service.send(command(0.5), caller="b") == (
        "NotInCommand: a:1 is in command, not b:1; it passes on when a:1 leaves or is silent for 5 s."
    )
    bus.leave("a")
    assert service.lease.holder is None
    assert service.send(command(0.02), caller="b") is None
    assert service.lease.holder == "b:1"


def test_a_session_ends_with_the_connection_that_opened_it(serve, bus):
    service = serve()
    tagger = service.session("control")
    assert service.send(command(0.01), tagger, "control") is None
    bus.leave("halt")
    assert service.lease.holder == f"session {tagger.session}"
    bus.leave("control")
    assert service.lease.holder is None
    assert "is not open here" in service.send(command(0.02), tagger, "again")
    tagger = service.session("old")  # whose connection may end late: who comes back leaves over the new one
    assert service.send(command(0.01), tagger, "old") is None
    assert service.say("leave", tagger, "new") is None
    assert service.send(command(0.02), service.session("new"), "new") is None


def test_a_step_that_outlives_its_client_ends_at_rest(serve, bus):
    service, begun, go = serve(), threading.Event(), threading.Event()

    class Env(MirrorEnv):
        robot = service.robot

        def step(self, action):
            begun.set()
            assert go.wait(10)
            self.robot.step(command(0.01)[None])
            return super().step(action)

    gym_api = GymApiService(EnvServer(Env(spaces.Discrete(3)), lease=service.lease, env_id="x"), bus).start()
    ask = partial(bus.services["/gym_env/gym_api_request"][1], caller=Caller("c", "c:1"))
    ask({"header": {"request_type": 2}})
    action = {"header": {"request_type": 1}, "action": [{"discrete_action": [1]}]}
    stepping = threading.Thread(target=ask, args=[action])
    stepping.start()
    assert begun.wait(10)
    bus.leave("c")
    go.set()
    stepping.join(10)
    gym_api.close()  # waits for who leaves
    assert service.robot.resting
    gym_api.env.close()


def test_what_a_client_sent_does_not_go_on_under_the_next_one(serve, bus):
    service = serve(SimulatedArm(1), realtime=True)
    service.send(command(0.5), caller="a")
    service.joints(lambda message: message["position"][0] > 0.005)
    service.lease.take("b", force=True)
    rest = service.robot.target()
    assert (rest[0, :6] < HOME[0] + 0.4).all()
    assert service.robot.resting


class Overtaken(CommandLease):
    """Command changes between the check of a command and the clock."""

    @property
    def holder(self):
        return "b"


def test_an_order_that_waits_while_command_changes_is_not_executed(serve, bus):
    service = serve(lease=Overtaken(5.0))
    service.service.clock.stop()
    service.send(command(0.5), caller="a")
    service.service.tick()
    assert service.robot.state.stamp == 0.0


def test_anybody_may_halt(serve, bus):
    service = serve(SimulatedArm(1), realtime=True)
    service.send(command(0.5), caller="a")
    service.joints(lambda message: message["position"][0] > 0.005)
    assert bus.say("/bam/halt", {}, "somebody") is None
    assert service.robot.resting
    assert service.lease.holder == "a:1"


def test_a_command_that_a_halt_overtakes_is_answered_and_moves_nothing(serve, bus):
    """Who waits for the state behind it would wait for nothing."""
    service = serve()
    tagger = service.session()
    service.service.clock.stop()  # the command waits for it
    assert service.send(command(0.5), tagger, "a") is None
    assert bus.say("/bam/halt", {}, "somebody") is None
    service.service.tick()
    assert service.joints()["header"]["frame_id"] == f"bam1 s={tagger.session} q=1"
    assert service.robot.state.stamp == 0.0
    assert service.robot.resting


@pytest.mark.parametrize("realtime", [True, False])
def test_a_halt_wins_over_a_command_that_is_just_being_taken(serve, bus, realtime):
    service = serve(SimulatedArm(1), realtime=realtime)
    halting, taken = threading.Thread(target=bus.say, args=("/bam/halt", {}, "somebody")), threading.Event()
    target = service.robot.target

    def slow_target():
        service.robot.target = target
        halting.start()
        halting.join(0.2)  # it must not get through before the command it has to stop
        taken.set()
        return target()

    service.robot.target = slow_target
    service.send(command(0.5))
    assert taken.wait(10.0)
    halting.join(10.0)
    assert (service.robot.target()[0, :6] < HOME[0] + 0.4).all()


def scene(bus, payload, caller="a", identity="1"):
    bus.say("/bam/scene/request", {"data": json.dumps({"id": identity, "payload": payload})}, caller)
    fits = f'"id":"{identity}"'
    return json.loads(bus.wait_for("/bam/scene/reply", lambda message: fits in message["data"])["data"])


def test_only_the_client_in_command_tells_what_the_guards_did(serve, bus):
    service, ann, bob = serve(namespace="/cell"), Caller("a", "a:1"), Caller("b", "b:1")
    check = bus.reserved["/cell/bam/status"]
    for taken, refused in ((False, ann), (True, bob), (False, ann)):
        if taken:
            service.lease.take("a:1", ann)
            check(ann)
        else:
            service.lease.release("a:1")
        with pytest.raises(NotInCommand, match=r"Topic /cell/bam/status is for the client in command\."):
            check(refused)


def test_the_scene_can_be_set(serve, bus):
    service = serve()
    assert scene(bus, {"object_pose": [[0.4, -0.1, 0.0]], "seeds": [7]}) == {"id": "1", "payload": {}}
    assert service.lease.holder == "a:1"
    np.testing.assert_allclose(service.robot.state.signals["object_position"][0, :2], [0.4, -0.1])
    assert scene(bus, {"object_pose": [0.45, 0.1, 0.0]}, identity="2") == {"id": "2", "payload": {}}
    assert scene(bus, {}, identity="3") == {"id": "3", "payload": {}}
    np.testing.assert_allclose(service.robot.state.signals["object_position"][0, :2], [0.45, 0.1])


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        ({"object_pose": [1.0]}, "object_pose must be a list of numbers, not 1.0."),
        ({"object_pose": [1.0, 2.0]}, "object_pose must be 3 numbers (x, y [m], yaw [rad]), not 2."),
        ({"object_pose": [1.0, "x", 0.0]}, "object_pose[1] must be a finite number, not 'x'."),
        ({"seeds": [-1]}, "seeds must be one number, 0 or more, not [-1]."),
        ({"seeds": [1.5]}, "seeds must be one number, 0 or more, not [1.5]."),
    ],
)
def test_a_wrong_scene_is_refused(serve, bus, payload, text):
    serve()
    assert scene(bus, payload) == {"id": "1", "error": text, "kind": "ProtocolError"}


def test_only_the_client_in_command_sets_the_scene(serve, bus):
    service = serve()
    tagger = service.session()
    service.send(command(), tagger, "a")
    assert scene(bus, {}, "b")["kind"] == "NotInCommand"
    tag = tagger.next(1, 5.0)
    request = {"id": f"{tagger.session}-2", "payload": {}}
    content = json.dumps(request, separators=(",", ":")).encode()
    signed = {**request, "tag": tagger.sign(tag, "/bam/scene", content)}
    bus.say("/bam/scene/request", {"data": json.dumps(signed)}, "a")
    bus.wait_for("/bam/scene/reply", lambda message: message["data"] == json.dumps(request, separators=(",", ":")))
    forged = {**signed, "payload": {"seeds": [7]}}
    bus.say("/bam/scene/request", {"data": json.dumps(forged)}, "a")
    text = f"session {tagger.session}: the signature of a message on /bam/scene is wrong"
    bus.wait_for("/bam/scene/reply", lambda message: text in message["data"])


def test_a_paced_robot_in_lockstep_executes_no_command_sooner(serve):
    """However fast they come, such as on the way to a start pose."""
    steps, stepped = [], threading.Semaphore(0)

    class Timed(FakeRobot):
        def step(self, command):
            steps.append(time.monotonic())
            stepped.release()
            return super().step(command)

    service = serve(Timed(1), paced=True)
    for k in range(11):
        assert service.send(command(0.01 * k)) is None
        assert stepped.acquire(timeout=10)
    assert steps[-1] - steps[0] > 10 * 0.8 * service.robot.spec.period


class Failing(FakeRobot):
    def step(self, command):
        raise PhysicsDiverged("The simulated state of environments [0] is not finite. Reset them.")


def test_a_robot_that_failed_takes_no_commands_until_a_reset(serve, bus, caplog, until):
    service = serve(Failing(1))
    assert service.send(command(0.1)) is None
    until(lambda: service.robot.fault is not None)
    assert service.send(command(0.1)) == (
        "RemoteError: ur5e failed, and needs a reset: "
        "The simulated state of environments [0] is not finite. Reset them."
    )
    service.robot.reset(np.zeros(1, dtype=np.int64), initial())
    service.service.clock.stop()
    assert service.send(command(0.1)) is None


def test_a_link_that_is_down_is_said_once_and_the_clock_goes_on(serve, bus, caplog):
    bus.stamp = lambda seconds: {"secs": 1, "nsecs": 2}  # as this bus spells it
    service = serve()
    assert service.joints()["header"]["stamp"] == {"secs": 1, "nsecs": 2}
    bus.fails = LinkLost("the link is down")
    service.service.clock.stop()
    service.service.tick()
    service.service.tick()
    assert [record.getMessage() for record in caplog.records] == ["ur5e: the link is down"]
    bus.fails = None
    count = len(bus.published)
    service.service.tick()
    assert len(bus.published) == count + 3
    bus.programs = 0  # that listen
    service.service.tick()
    assert len(bus.published) == count + 3


def test_the_tag_of_the_last_command_stays_until_command_changes(serve, bus):
    service = serve()
    service.send(command(), service.session(), "a")
    service.joints(lambda message: read_echo(message["header"]["frame_id"]) is not None)
    bus.leave("a")
    count = len(bus.published)
    with bus.news:
        assert bus.news.wait_for(lambda: len(bus.published) > count + 6, 10)
    assert service.joints()["header"]["frame_id"] == ""


@pytest.fixture
def base(bus):
    """A base in real time whose clocks are set by hand: ``tick()`` is one part of a period."""
    profile, now = load_profile("mir100"), [0.0]
    robot = ServedRobot(
        SimulatedBase(1), command_timeout=profile.command_timeout, zero_rests=True, realtime=True, now=lambda: now[0]
    )
    robot.connect()
    robot.reset(np.zeros(1, dtype=np.int64), Initial({}, np.zeros(1, dtype=np.int64)))
    service = RobotService(robot, profile, bus, CommandLease(5.0))
    service.start()
    service.clock.stop()

    def tick(number):
        for _ in range(number):
            service.tick()
            now[0] += robot.tick_period
        return robot.state.signals["base_velocity"][0]

    yield tick
    service.close()
    robot.close()


def drive(forwards):
    return {"linear": {"x": forwards, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.1}}


def test_a_base_stands_still_half_a_second_after_the_last_command(base, bus):
    assert bus.say("/cmd_vel", drive(0.2)) is None
    assert base(25).tolist() == [0.2, 0.1]
    assert base(10).tolist() == [0.0, 0.0]
    assert bus.say("/cmd_vel", drive(0.1)) is None
    assert base(5).tolist() == [0.1, 0.1]
    odometry = bus.wait_for("/odom")
    assert odometry["twist"]["twist"]["linear"]["x"] == 0.1


def test_messages_of_one_command_come_together_and_the_newest_wins():
    slot = CommandSlot()
    slot.put(Order({1: 0.08}, True, "of another client, which is forgotten", "b"))
    slot.put(Order({6: 0.08}, False, "first", "a"))
    slot.put(Order({6: 0.01}, False, "", "a"))
    assert slot.take(complete=True) == Order()
    slot.put(Order({0: 1.0}, True, "second", "a"))
    assert slot.take(complete=True) == Order({6: 0.01, 0: 1.0}, True, "second", "a", 1)
    assert slot.take(complete=True) == Order()
