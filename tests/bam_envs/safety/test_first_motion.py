"""Before it is proved that commands reach the joints that are meant, no joint moves far or fast."""

import itertools
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bam_envs.core.errors import BamEnvsError, ResetNeeded, SafetyStop
from bam_envs.core.robot import Initial, RobotState
from bam_envs.live.command_proof import CommandProof, Controllers
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import arm_spec
from bam_envs.safety.first_motion import FASTEST, MOST
from bam_envs.safety.gate import SafeRobot

HOME = np.array([-0.27, -1.54, 1.89, -1.93, -1.57, -1.84])
ROW, PARTS = np.zeros(1, np.int64), 10
SPEC = arm_spec("ur5e", with_object=False)
CELLS = itertools.count()


@pytest.fixture(autouse=True)
def own_proofs(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))


class Wiring:
    """What a robot's side does to numbers: joint i is number `order[i]` of the six, times a scale, plus an offset."""

    def __init__(self, order=range(6), scale=(1.0,) * 6, offset=(0.0,) * 6):
        self.order, self.scale, self.offset = list(order), np.array(scale), np.array(offset)

    def __call__(self, numbers):
        return numbers[self.order] * self.scale + self.offset


class WiredArm:
    """A live arm in simulated time, which turns its joints at up to 3.14 rad/s to where its wiring sends them.

    With `timed`, it goes to a command in the time that the command says, else at once; `lag` [s] later.
    """

    needs_clearance = True
    num_robots = 1
    info = None

    def __init__(
        self,
        command=None,
        state=None,
        mode="trajectory",
        known=False,
        lag=0.03,
        stuck=(),
        sag=0.0,
        start=HOME,
        name=None,
    ):
        self.command_wiring, self.state_wiring = command or Wiring(), state or Wiring()
        profile = load_profile("ur5e")
        self.spec, sinks = profile.spec(SPEC, mode), profile.sinks(mode)
        joints = {sink.topic: sink.names for sink in sinks if not sink.is_named}
        self.proof = CommandProof(profile, sinks, Controllers((), joints), name or f"cell {next(CELLS)}")
        if known:
            self.proof.since = "2026-01-01 12:00"
        self.reach, self.now, self.stuck, self.sag = None, 0.0, list(stuck), sag
        self.joints, self.target, self.left = np.array(start), np.array(start) + sag, 0.0
        self.start, self.lag, self.queue, self.width = self.joints.copy(), lag, [], 0.085
        self.farthest = self.fastest = 0.0
        self.sent = np.full((1, 7), np.nan)

    def clock(self):
        return self.now

    def connect(self):
        pass

    def reset(self, env_ids, initial):
        return self.measure()

    def age(self):
        return 0.0

    def halt(self):
        pass

    def close(self):
        pass

    def tell_proved(self, lag):
        self.proof.done(lag)

    def measure(self):
        signals = {
            "joint_position": self.state_wiring(self.joints)[None],
            "joint_velocity": np.zeros((1, 6)),
            "gripper_width": np.array([[self.width]]),
        }
        return RobotState(signals, np.array([self.now]), self.sent.copy())

    def step(self, cleared):
        command = cleared.for_robot(self)
        self.sent = command.copy()
        reach = 0.0 if not self.proof.is_timed else 1.5 * self.spec.period if self.reach is None else self.reach
        self.queue.append((self.now + self.lag, self.command_wiring(command[0, :6]), reach))
        for _ in range(PARTS):
            self._part(self.spec.period / PARTS)
        self.width = float(command[0, 6])
        return self.measure()

    def _part(self, seconds):
        self.now += seconds
        while self.queue and self.queue[0][0] <= self.now + 1e-9:
            _, self.target, self.left = self.queue.pop(0)
        goal = self.target - self.sag
        way = (goal - self.joints) * (1.0 if self.left <= seconds else seconds / self.left)
        way = np.clip(way, -3.14 * seconds, 3.14 * seconds)
        way[self.stuck] = 0.0
        self.joints, self.left = self.joints + way, max(0.0, self.left - seconds)
        if not self.proof.is_done:
            self.fastest = max(self.fastest, float(np.abs(way).max()) / seconds)
            self.farthest = max(self.farthest, float(np.abs(self.joints - self.start).max()))


def driven(arm, initial=None):
    """The arm, its gate, and why it does not move (None if it does) after the way to its start pose."""
    robot = SafeRobot(arm, clock=arm.clock)
    robot.connect()
    signals = {"joint_position": arm.state_wiring(arm.joints)[None] if initial is None else initial[None]}
    try:
        robot.reset(ROW, Initial(signals, ROW))
    except BamEnvsError as error:
        return robot, str(error)
    return robot, None


UNITS = (1.0, -1.0, 180 / np.pi, -180 / np.pi, np.pi / 180, 1000.0, 0.001, 2.0, 0.5, 1.1)


def wirings():
    return st.builds(
        Wiring,
        st.permutations(range(6)),
        st.lists(st.sampled_from(UNITS), min_size=6, max_size=6),
        st.lists(st.sampled_from([0.0, 0.41, -0.6, 0.02]) | st.floats(-6.0, 6.0), min_size=6, max_size=6),
    )


@settings(max_examples=60, deadline=None)
@given(wirings() | st.none(), wirings() | st.none(), st.sampled_from(["trajectory", "position"]), st.data())
def test_no_joint_moves_far_or_fast_before_its_commands_are_proved(command, state, mode, data):
    start = np.array(data.draw(st.lists(st.floats(-2.9, 2.9), min_size=6, max_size=6)))
    arm = WiredArm(command, state, mode, lag=data.draw(st.sampled_from([0.0, 0.03, 0.1])), start=start)
    _, why = driven(arm)
    assert arm.farthest <= MOST
    assert arm.fastest <= FASTEST
    if why is None:
        there = arm.command_wiring(arm.state_wiring(arm.joints) + 0.02)  # what is commanded is what is measured
        np.testing.assert_allclose(arm.state_wiring(there), arm.state_wiring(arm.joints) + 0.02, atol=0.03)


@settings(max_examples=40, deadline=None)
@given(
    st.permutations(range(6)),
    st.lists(st.sampled_from([1.0, -1.0]), min_size=6, max_size=6),
    st.lists(st.sampled_from([0.0, 0.05, -0.41]), min_size=6, max_size=6),
)
def test_every_wrong_order_sign_and_offset_is_found(order, signs, offsets):
    wrong = list(order) != sorted(order) or min(signs) < 0.0 or any(offsets)
    arm = WiredArm(Wiring(order, signs, offsets))
    _, why = driven(arm)
    assert (why is not None) == wrong
    assert arm.farthest <= MOST
    assert arm.fastest <= FASTEST


def test_an_arm_that_does_as_it_is_told_is_proved_once_and_remembered():
    arm = WiredArm(name="cell 7")
    assert driven(arm)[1] is None
    assert arm.proof.is_done
    assert 6.0 < arm.now < 14.0
    np.testing.assert_allclose(arm.joints, HOME, atol=1e-4)
    again = WiredArm(name="cell 7")
    assert again.proof.is_known
    driven(again)
    assert 2.0 < again.now < 4.0  # the last joint alone
    other = CommandProof(load_profile("ur5e"), load_profile("ur5e").sinks(), Controllers((), {}), "cell 8")
    assert not other.is_known
    position = WiredArm(mode="position", name="cell 7")  # the same joints in another mode, whose order is known
    assert driven(position)[1] is None


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (
            {"command": Wiring((1, 0, 2, 3, 4, 5))},
            r"^The robot was stopped by first motion \(G25\): \w+ was commanded to stay where it is measured, and "
            r"moved [-+]0\.00\d rad: commands and measurements differ in the order of the joints, in a sign, an offset or "
            r"the unit\. When it is safe, call resume\(\)\.$",
        ),
        (
            {"command": Wiring(scale=(1, 1, 1, 1, 1, -1))},
            "wrist_3_joint was commanded to stay where it is measured, and",
        ),
        (
            {"state": Wiring(offset=(0, 0, 0.41, 0, 0, 0))},
            "elbow_joint was commanded to stay where it is measured, and",
        ),
        (
            {"command": Wiring((0, 1, 2, 3, 5, 4)), "start": (*HOME[:4], 0.5, 0.5)},
            "wrist_3_joint moved .* when wrist_2_joint was commanded: the commands have another order",
        ),
        ({"stuck": range(6)}, "all joints were commanded to move, and none moved: look for a protective stop"),
        ({"stuck": [3]}, r"wrist_1_joint was commanded to move \+0.020 rad, and did not move: look for"),
    ],
)
def test_a_wrong_arm_is_stopped_with_its_reason(options, expected):
    robot, why = driven(WiredArm(**options))
    with pytest.raises(SafetyStop, match="still stopped by first motion"):
        robot.step(np.zeros((1, 7)))
    assert re.search(expected, why), why


def test_an_arm_that_ignores_everything_is_named_within_three_seconds():
    for known in (False, True):
        arm = WiredArm(stuck=range(6), known=known)
        assert driven(arm)[1] is not None
        assert arm.now <= 3.0


def test_positions_that_are_executed_at_once_are_not_sent_unproved():
    arm = WiredArm(mode="position", name="cell 7")
    robot, why = driven(arm)
    assert why == (
        "The commands of cell 7 are not proved: /forward_position_controller/commands executes a position at once, so "
        "that a wrong sign or offset would swing the arm, and nothing has shown them yet: drive it once in the mode "
        "trajectory of the profile ur5e, which proves them in a small motion. Nothing has moved."
    )
    assert arm.now == 0.0
    with pytest.raises(ResetNeeded):
        robot.step(np.zeros((1, 7)))


def test_an_arm_that_sags_under_its_load_is_proved():
    assert driven(WiredArm(sag=np.array([0, 0.02, 0.015, 0.01, 0, 0])))[1] is None


@pytest.mark.parametrize("lag", [0.0, 0.05, 0.1, 0.125])
def test_late_arms_are_proved(lag):
    assert driven(WiredArm(lag=lag))[1] is None
