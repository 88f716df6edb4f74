"""The newest messages as a state, and how old that is; clocks are the test's."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from bam_envs.core.errors import ProtocolError, StaleState
from bam_envs.live.state import LiveState, Mailbox
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import JOINTS, arm_spec
from bam_envs.rosbridge.bus import UNKNOWN_CALLER

WALL = 1_700_000_000.0


class Clock:
    now = 10.0

    def __call__(self):
        return self.now


def at(seconds):
    return {"sec": int(seconds // 1), "nanosec": round(seconds % 1 * 1e9)}


def joints(stamp):
    header = {"stamp": at(stamp), "frame_id": ""}
    return {"header": header, "name": list(JOINTS), "position": [stamp] * 6, "velocity": [0.0] * 6}


def gripper(stamp, name="gripper_width"):
    return {"header": {"stamp": at(stamp), "frame_id": ""}, "name": [name], "position": [0.05]}


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def state(clock):
    """An arm's state; our wall clock is `WALL` ahead of the monotonic one."""
    profile = load_profile("ur5e")
    return LiveState(profile, profile.spec(arm_spec("x", with_object=False)), clock, lambda: clock() + WALL)


def hear(state, topic, message):
    state.listener(topic)(message, UNKNOWN_CALLER)


def hear_all(state, stamp):
    hear(state, "/joint_states", joints(stamp))
    hear(state, "/gripper/joint_states", gripper(stamp))


def test_the_newest_message_counts(state):
    hear_all(state, 1.0)
    hear(state, "/joint_states", joints(2.0))
    signals, stamp = state.read()
    assert stamp == 2.0
    assert list(signals) == ["joint_position", "joint_velocity", "gripper_width"]
    np.testing.assert_array_equal(signals["joint_position"], np.full((1, 6), 2.0))


def test_before_everything_came(state):
    hear(state, "/joint_states", joints(1.0))
    assert state.age() == np.inf
    with pytest.raises(StaleState) as caught:
        state.read()
    assert str(caught.value) == "/gripper/joint_states (sensor_msgs/JointState): no message yet."


def test_age_since_arrival(state, clock):
    hear_all(state, 0.0)  # no stamp
    assert state.age() == 0.0
    clock.now += 0.3
    assert state.age() == pytest.approx(0.3)
    hear(state, "/joint_states", joints(0.0))
    assert state.age() == pytest.approx(0.3)  # the gripper's is as old
    hear(state, "/gripper/joint_states", gripper(0.0))
    assert state.age() == 0.0


def test_age_by_stamps_of_a_clock_that_is_off(state, clock):
    shift = 5000.0
    for delay in (0.02, 0.01, 0.5):  # the second one is the quickest
        clock.now += 1.0
        hear_all(state, WALL + shift + clock.now - delay)
        age = state.age()
    assert age == pytest.approx(0.49, abs=1e-3)


@pytest.mark.parametrize(
    ("ahead", "late", "age"),
    [(3.0, 0.25, 0.25), (0.0, 3600.0, 0.0)],  # by the server's clock; a clock that nobody set is not compared
)
def test_age_with_the_offset_of_the_server(state, clock, ahead, late, age):
    state.server_offset = lambda: -ahead
    hear_all(state, WALL + clock.now + ahead - late)
    assert state.age() == pytest.approx(age, abs=1e-5)


def test_a_stamp_that_stands_still_is_stale(state, clock):
    for _ in range(5):
        hear_all(state, WALL)
        clock.now += 0.1
        age = state.age()
    assert age == pytest.approx(0.5)


def test_a_simulators_clock_only_has_to_go_on(state, clock):
    for stamp in (1.0, 1.001, 5.0):
        clock.now += 1.0
        hear_all(state, stamp)
        assert state.age() == 0.0
    clock.now += 1.0
    hear_all(state, 5.0)
    assert state.age() == 1.0


def test_a_source_may_be_slower_than_the_others(clock):
    profile = load_profile("ur5e")
    profile = replace(profile, state=tuple(replace(source, max_age=0.5) for source in profile.state))
    state = LiveState(profile, profile.spec(arm_spec("x", with_object=False)), clock)
    hear_all(state, 0.0)
    clock.now += 0.45
    assert state.age() == pytest.approx(0.05)  # 0.1 is allowed, and 0.4 more for these
    assert state.read()[1] == 10.0  # without stamps, when it came


def test_publishers_that_share_a_topic(clock):
    profile = load_profile("ur5e")
    joint, finger = profile.source("joint_position"), profile.source("gripper_width")
    shared = (replace(joint, partial=True), replace(finger, topic=joint.topic, names=("finger",), partial=True))
    profile = replace(profile, state=shared, signals=(profile.signals[0], profile.signals[2]))
    state = LiveState(profile, profile.spec(), clock)
    for message in (joints(1.0), gripper(2.0, "finger"), gripper(3.0, "mobile_base_wheel")):
        hear(state, "/joint_states", message)
    signals, _ = state.read()
    np.testing.assert_array_equal(signals["joint_position"], np.ones((1, 6)))
    np.testing.assert_array_equal(signals["gripper_width"], [[0.05]])
    hear(state, "/joint_states", gripper(4.0, "elbow_joint"))
    with pytest.raises(ProtocolError) as caught:
        state.read()
    others = ", ".join(name for name in JOINTS if name != "elbow_joint")
    assert str(caught.value) == f"/joint_states: {others} missing; found: elbow_joint."


def test_a_stamp_that_is_none(state):
    hear_all(state, 1.0)
    broken = joints(1.0)
    broken["header"]["stamp"] = {"sec": 1, "nanosec": 2_000_000_000}
    hear(state, "/joint_states", broken)
    with pytest.raises(ProtocolError) as caught:
        state.age()
    assert str(caught.value) == (
        "/joint_states: header.stamp must be seconds and nanoseconds, not {'nanosec': 2000000000, 'sec': 1}."
    )


def test_ages_are_forgotten_with_the_connection(state, clock):
    hear_all(state, WALL + clock.now)
    state.age()
    state.mailbox.clear()
    state.forget_ages()
    assert state.age() == np.inf
    clock.now += 1.0
    hear_all(state, WALL + clock.now - 30.0)
    assert state.age() == 0.0  # as quick as any of this connection


def test_the_mailbox_keeps_the_newest(clock):
    mailbox = Mailbox(clock)
    mailbox.put(("a", "b"), 1)
    clock.now = 11.0
    mailbox.put(("a",), 2)
    slots = mailbox.newest()
    assert [(slots[name].message, slots[name].arrived, slots[name].number) for name in "ab"] == [
        (2, 11.0, 2),
        (1, 10.0, 1),
    ]
    assert not mailbox.wait_for(lambda slots: "c" in slots, 0.01)
    waiting = threading.Thread(target=lambda: mailbox.wait_for(lambda slots: not slots, 10.0))
    waiting.start()
    mailbox.clear()
    waiting.join(10.0)
    assert not waiting.is_alive()


def test_a_command_is_answered_when_no_source_is_older(state):
    def answered(stamp, tag):
        message = joints(stamp)
        message["header"]["frame_id"] = tag
        return message

    hear_all(state, 1.0)
    assert not state.await_answer("bam1 s=a q=1", lambda: False, 0.01)
    hear(state, "/joint_states", answered(2.0, "bam1 s=a q=1"))
    assert not state.await_answer("bam1 s=a q=1", lambda: False, 0.01)  # the gripper's message is older
    assert state.await_answer("bam1 s=a q=1", lambda: True, 0.0)
    hear(state, "/gripper/joint_states", gripper(2.0))
    assert state.await_answer("bam1 s=a q=1", lambda: False, 0.0)
    assert state.echo() == ("a", 1)
