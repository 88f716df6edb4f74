"""The gate: nothing reaches the robot but what the guards let through, at no time and by no way."""

import copy
import itertools
import math
import pickle
import threading

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from bam_envs.core.errors import (
    InvalidValue,
    LinkLost,
    ProtocolError,
    ResetNeeded,
    SafetyStop,
    StaleState,
    StartNotReached,
)
from bam_envs.core.robot import Initial, Robot, RobotState
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.kinematic_base import SimulatedBase
from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.ros.codec import RobotInfo
from bam_envs.safety.arm_guards import JointSpeed
from bam_envs.safety.arm_tubes import ArmTubes
from bam_envs.safety.gate import ClearedCommand, SafeRobot
from bam_envs.safety.guard import Guard, Limits
from bam_envs.testing import ARM_HOME, RobotContract

FIRST = np.zeros(1, np.int64)
NAN = np.array([[math.nan] * 7])


def start_at(joints=ARM_HOME):
    return Initial({"joint_position": np.array(joints, dtype=np.float64)[None]}, FIRST)


class LiveArm(FakeRobot):
    """What a live arm is to a SafeRobot: reset moves nothing, commands must be cleared, states have an age."""

    needs_clearance = True
    info = None

    def __init__(self):
        super().__init__(1)
        self.now, self.old = 0.0, 0.0
        self.stuck, self.fails, self.during, self.look = None, None, None, lambda cleared: None
        self.lie = {}
        """Signals that are measured otherwise than they are."""
        self.cleared = []

    def clock(self):
        return self.now

    def age(self):
        return self.old

    def measure(self):
        state = super().measure()
        return RobotState({**state.signals, **self.lie}, state.stamp, state.command)

    def reset(self, rows, initial):
        return self.measure()

    def place(self, joints, width=0.085):
        """Somebody moves the arm by hand."""
        position = np.array([[*joints, width]])
        self.load_state_dict(self.state_dict() | {"position": position, "velocity": np.zeros((1, 6))})

    def step(self, command):
        if not isinstance(command, ClearedCommand):
            raise InvalidValue("not cleared")
        if self.during is not None:
            self.during()
        if self.fails is not None:
            raise self.fails
        self.look(command)
        self.cleared.append(command)
        self.now += self.spec.period
        before = self.state_dict()["position"]
        state = super().step(command.for_robot(self))
        if self.stuck is not None:
            after = self.state_dict()
            after["position"][:, self.stuck] = before[:, self.stuck]
            state = self.load_state_dict(after)
        return state


def live(joints=ARM_HOME, **options):
    """A live arm at `joints` and the gate before it, reset there."""
    arm = LiveArm()
    robot = SafeRobot(arm, clock=arm.clock, **options)
    robot.connect()
    arm.place(joints)
    return arm, robot, robot.reset(np.arange(1), start_at(joints))


class EarlyArm(LiveArm):
    """An arm whose steps end 10 ms before the next command is due."""

    due = 0.0

    def await_due(self):
        self.now = max(self.now, self.due)

    def step(self, command):
        self.due = self.now + self.spec.period
        state = super().step(command)
        self.now = self.due - 0.01
        return state


def test_a_command_is_judged_by_the_time_at_which_it_is_sent():
    arm = EarlyArm()
    robot = SafeRobot(arm, clock=arm.clock)
    robot.connect()
    arm.place(ARM_HOME)
    state = robot.reset(np.arange(1), start_at())
    for _ in range(4):
        asked = state.command.copy()
        asked[0, 5] += 0.025  # as much as the limit of acceleration allows in a whole period
        state = robot.step(asked)
        np.testing.assert_array_equal(state.command, asked)
        assert (robot.code, robot.is_held) == (0, False)


class LaggingArm(LiveArm):
    """An arm that is one command behind, also after a halt."""

    def __init__(self):
        super().__init__()
        self.behind = None

    def step(self, command):
        before = self.state_dict()["position"]
        position = before if self.behind is None else self.behind
        self.behind = command.for_robot(self)
        super().step(command)
        velocity = (position - before)[:, :6] / self.spec.period
        return self.load_state_dict(self.state_dict() | {"position": position.copy(), "velocity": velocity})


def fake(joints=ARM_HOME, **options):
    inner = FakeRobot()
    robot = SafeRobot(inner, **options)
    robot.connect()
    return inner, robot, robot.reset(np.arange(1), start_at(joints))


def away(state, *way):
    """A command that is `way` from where `state` was sent to."""
    command = np.array(state.command)
    command[0, : len(way)] += way
    return command


def turned(state, way):
    """The same, but only the last joint, which does not move the tool."""
    return away(state, 0, 0, 0, 0, 0, way)


class Guarded(RobotContract):
    sizes = (1,)
    holds_what_is_not_finite = True

    def move(self, robot, state):
        return self.stay(state) - 0.005


class TestSafeLiveArm(Guarded):
    def make(self, num_robots: int) -> Robot:
        arm = LiveArm()
        return SafeRobot(arm, clock=arm.clock)


class TestSafeBase(Guarded):
    def make(self, num_robots: int) -> Robot:
        return SafeRobot(SimulatedBase(num_robots, with_scans=False))

    def measured(self, state: RobotState):
        return state.signals["base_velocity"]

    def stay(self, state: RobotState):
        return np.zeros_like(state.command)


NUMBERS = st.one_of(
    st.floats(-8, 8),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0.0, 0.085, 2 * math.pi, -2 * math.pi, 1e308, -1e308, math.nan, math.inf, -math.inf]),
)
PLACES = st.lists(NUMBERS, min_size=7, max_size=7)
WAYS = st.lists(st.floats(-0.12, 0.12), min_size=7, max_size=7)
KEPT = st.integers(1, 12)
"""How many ticks the same is told."""
ORDERS = st.lists(
    st.one_of(
        st.tuples(st.just("place"), PLACES, KEPT),
        st.tuples(st.just("way"), WAYS, KEPT),
        st.tuples(st.sampled_from(["halt", "reset", "resume"]), st.none(), st.just(1)),
    ),
    max_size=12,
)


def tool_travel(one, other):
    return math.dist(*GEOMETRY.tool_position(np.stack([one[:6], other[:6]])))


class Watcher:
    """Follows what an arm is sent, and checks every tick of it."""

    def __init__(self, inner, state, limits):
        self.inner, self.limits = inner, limits
        self.tubes = ArmTubes(GEOMETRY, GEOMETRY.outline, tool=True)
        low, high = np.array(inner.spec.command.low), np.array(inner.spec.command.high)
        margin = np.array([limits.position_margin] * 6 + [0.0])
        self.low, self.high = low + margin, high - margin
        self.begin(state)

    def begin(self, state):
        """It was set somewhere, or halted: what follows begins there."""
        self.last, self.step = state.command[0].copy(), np.zeros(7)
        self.least, self.most = self.last.copy(), self.last.copy()
        self.count = len(self.inner.sent)

    def told(self, command):
        if np.isfinite(command).all():
            inside = np.clip(command[0], np.minimum(self.low, self.last), np.maximum(self.high, self.last))
            self.least, self.most = np.minimum(self.least, inside), np.maximum(self.most, inside)

    def look(self):
        for sent in self.inner.sent[self.count :]:
            self.check(sent[0], sent[0] - self.last)
        self.count = len(self.inner.sent)

    def check(self, sent, step):
        period, limits = 0.05, self.limits
        assert np.isfinite(sent).all()
        assert (sent >= np.minimum(self.low, self.last) - 1e-9).all()
        assert (sent <= np.maximum(self.high, self.last) + 1e-9).all()
        assert (np.abs(step[:6]) <= limits.joint_speed * period + 1e-8).all()
        assert abs(step[6]) <= 0.15 * period + 1e-9
        assert tool_travel(self.last, sent) <= limits.tool_speed * period + 1e-8
        change = np.abs(step - self.step)[:6]
        slower = (np.abs(step) <= np.abs(self.step) + 1e-12) & (step * self.step >= -1e-12)
        assert ((change <= limits.joint_acceleration * period**2 + 1e-8) | slower[:6]).all()
        assert GEOMETRY.tool_point(sent[:6])[2] >= -1e-6, "the tool is in the table"
        assert min(self.tubes.nearest(sent), self.tubes.lowest(sent)) >= limits.clearance - 1e-6
        assert (sent >= self.least - 1e-9).all(), "it passed the farthest place that it was told"
        assert (sent <= self.most + 1e-9).all(), "it passed the farthest place that it was told"
        self.last, self.step = sent, step


@settings(max_examples=60, deadline=None)
@given(
    ORDERS,
    st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6),
    st.sampled_from([0.5, 2.0, 10.0, 40.0]),
    st.sampled_from([0.02, 0.25, 1.0]),
)
def test_whatever_it_is_told_what_is_sent_keeps_every_limit_at_every_tick(orders, joints, acceleration, tool_speed):
    limits = Limits(joint_acceleration=acceleration, tool_speed=tool_speed, joint_jerk=5000.0)
    try:
        inner, robot, state = fake(joints, limits=limits)
    except InvalidValue:  # the arm would begin in itself or in the table
        reject()
    watcher = Watcher(inner, state, limits)
    for kind, numbers, times in orders:
        for _ in range(times):
            if kind in ("place", "way"):
                state = tell(robot, watcher, state, np.array([numbers]) + (state.command if kind == "way" else 0.0))
            elif kind == "halt":
                robot.halt()
                watcher.begin(state)
            elif kind == "reset":
                robot.resume()
                state = robot.reset(np.arange(1), start_at(joints))
                watcher.begin(state)
            else:
                robot.resume()
                watcher.step[:] = 0.0


def tell(robot, watcher, state, command):
    """One step; what a stopped robot refuses is not sent."""
    watcher.told(command)
    try:
        state = robot.step(command)
    except SafetyStop:
        assert len(watcher.inner.sent) == watcher.count
        robot.resume()
        watcher.begin(state)
        return state
    watcher.look()
    return state


SPEEDS = st.one_of(st.floats(-3, 3), st.sampled_from([math.nan, math.inf, 1e300]))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(SPEEDS, SPEEDS), max_size=40))
def test_whatever_a_base_is_told_it_keeps_its_limits(commands):
    robot = SafeRobot(SimulatedBase(with_scans=False))
    robot.connect()
    last = robot.reset(np.arange(1), Initial({}, FIRST)).command[0]
    np.testing.assert_array_equal(last, [0.0, 0.0])
    for command in commands:
        try:
            sent = robot.step(np.array([command])).command[0]
        except SafetyStop:
            robot.resume()
            last = np.zeros(2)
            continue
        assert (np.abs(sent) <= [0.5, 0.7]).all()
        gain = np.where(sent * last >= 0, np.abs(sent) - np.abs(last), np.abs(sent))
        assert (gain <= np.array([0.2, 0.25]) + 1e-9).all()
        if not np.isfinite(command).all():
            np.testing.assert_array_equal(sent, [0.0, 0.0])
        last = sent


def test_what_was_altered_is_counted_by_guard_and_told_by_status():
    _, robot, state = fake()
    slow = away(state, 0.01, -0.02)
    state = robot.step(slow)
    np.testing.assert_array_equal(state.command, slow)
    assert robot.status == ""
    robot.step(turned(state, 0.04))
    assert robot.status == "joint acceleration (G9)"
    counts = {"altered": 1, "held": 0, "stopped": 0}
    row = robot.report()["joint acceleration"]
    assert row == {"number": "G9", "limit": 10.0, "unit": "rad/s^2", **counts}
    assert [name for name, row in robot.report().items() if row["altered"]] == ["joint acceleration"]


def test_ticks_in_which_the_robot_is_held_on_the_way_to_its_start_are_told_and_not_counted():
    """A deployment counts the ticks of its episodes, and its report says in how many of these a guard acted."""
    arm, robot, _ = live()
    seen = []

    def pause_once():
        arm.now, arm.during = arm.now + 0.3, None

    robot.observe(lambda tick, state: seen.append((tick.approach, robot.status)))
    arm.during = pause_once
    robot.reset(FIRST, start_at(ARM_HOME + 0.1))
    assert (True, "command pace (G15)") in seen
    assert [name for name, row in robot.report().items() if row["altered"] or row["held"]] == []
    robot.step(NAN)
    assert (robot.report()["finite"]["held"], seen[-1]) == (1, (False, "finite (G2)"))


class Opener(Guard):
    """Allows everything, and more than it was asked."""

    number, name, unit, limit_value = "G99", "joint speed", "", math.inf

    def fault(self, tick):
        tick.last[:] += 1.0
        tick.age = math.inf

    def limit(self, tick):
        tick.last[:], tick.period, tick.approach = tick.goal, 100.0, True
        tick.command = tick.goal + 1.0
        return True


def turning_arm(*, simulated=False):
    """A lagging arm behind its guards that has turned a joint for six periods, and its state."""
    arm = LaggingArm()
    arm.info = RobotInfo("ur5e", simulated)
    robot = SafeRobot(arm, clock=arm.clock, limits=Limits(lag=0.05))
    robot.connect()
    arm.place(ARM_HOME)
    state = robot.reset(FIRST, start_at())
    for _ in range(6):
        state = robot.step(turned(state, 0.05))
    return arm, robot, state


@pytest.mark.parametrize("pause", [0.0, 0.2])
def test_an_arm_that_still_moves_when_the_next_motion_begins_follows_its_commands(pause):
    """A live agent goes to the start pose as soon as a person hands back, and a busy computer sends commands late."""
    arm, robot, state = turning_arm()
    if pause:
        arm.now += pause
        for _ in range(6):
            state = robot.step(turned(state, -0.05))
    else:
        robot.reset(FIRST, start_at())
    following = robot.report()["following"]
    assert (following["held"], following["stopped"]) == (0, 0)


@pytest.mark.parametrize("simulated", [False, True])
def test_a_command_before_a_rest_explains_no_motion(simulated):
    """Somebody moves the arm by hand; a joint that then jumps towards its old command stops a real one at once."""
    arm, robot, state = turning_arm(simulated=simulated)
    robot.halt()
    arm.now += 2.0
    moved = [*ARM_HOME[:5], ARM_HOME[5] - 0.3]
    arm.place(moved)
    state = robot.reset(FIRST, start_at(moved))
    arm.behind = np.array([[*moved[:5], moved[5] + 0.045, 0.085]])
    state = robot.step(turned(state, -0.005))
    if simulated:  # something that it touched has pushed it: it is held, and stopped if that goes on
        robot.step(turned(state, -0.005))
        assert (robot.status, robot.is_held) == ("following (G23)", True)
        return
    with pytest.raises(
        SafetyStop, match=r"G23\): wrist_3_joint moved \+0\.045 rad within a period, away from its commands"
    ):
        robot.step(turned(state, -0.005))


@pytest.mark.parametrize("kind", [FakeRobot, lambda: LiveArm()])
def test_guards_of_ones_own_are_asked_first_and_never_have_the_last_word(kind):
    inner = kind()
    robot = SafeRobot(inner, [Opener()])
    robot.connect()
    if isinstance(inner, LiveArm):
        inner.place(ARM_HOME)
    state = robot.reset(np.arange(1), start_at())
    sent = robot.step(turned(state, 0.5)).command
    assert np.abs(sent - state.command)[0, :6].max() <= 0.0125 + 1e-9
    assert len(robot.report()) == len(SafeRobot(FakeRobot()).report())


class Broken(Guard):
    """Does what a guard of one's own must not do."""

    number, name, unit, limit_value, patience = "G99", "broken", "", math.inf, 5

    def __init__(self, **does):
        self.does = does

    def fault(self, tick):
        return self.does.get("fault", lambda: None)()

    def hold(self, tick):
        return np.asarray(tick.last) + 2.0

    def limit(self, tick):
        tick.command = np.asarray(tick.command) * self.does.get("times", 1.0)
        return "times" in self.does


def test_a_guard_of_ones_own_that_holds_the_robot_moves_nothing():
    _, robot, state = live(guards=[Broken(fault=lambda: "no")])
    np.testing.assert_array_equal(robot.step(away(state, 0.1)).command, state.command)


def test_a_guard_of_ones_own_cannot_command_what_is_not_finite():
    arm, robot, state = live(guards=[Broken(times=math.nan)])
    halts, sent = arm.halts, len(arm.sent)
    with pytest.raises(InvalidValue, match=r"^The guard broken commanded \[nan, .*\]: correct it; nothing was sent\.$"):
        robot.step(state.command)
    assert (arm.halts, len(arm.sent)) == (halts + 1, sent)


def test_what_fails_in_a_guard_of_ones_own_or_in_an_observer_halts_the_robot():
    def fail(*anything):
        raise RuntimeError("a bug")

    for guards, observer in (([Broken(fault=fail)], None), ([], fail)):
        arm, robot, state = live(guards=guards)
        robot.observe(observer)
        halts = arm.halts
        with pytest.raises(RuntimeError, match="a bug"):
            robot.step(state.command)
        assert arm.halts == halts + 1


@pytest.mark.parametrize("what", ["not_ready", "tell_status"])
def test_a_stop_latches_whatever_fails_while_it_is_reported(what):
    def fail(*anything, stopped=True):
        if stopped:
            raise KeyboardInterrupt

    arm = LiveArm()
    setattr(arm, what, fail)
    robot = SafeRobot(arm, clock=arm.clock, limits=Limits(bad_ticks=1))
    robot.connect()
    arm.place(ARM_HOME)
    state, halts = robot.reset(np.arange(1), start_at()), arm.halts
    with pytest.raises(KeyboardInterrupt):
        robot.step(NAN)
    assert arm.halts == halts + 1
    with pytest.raises(SafetyStop, match=r"^The robot is still stopped by finite \(G2\): "):
        robot.step(state.command)


def test_ticks_in_which_the_robot_is_held_are_not_changed_commands():
    class Once(Broken):
        keeps_out = True

        def limit(self, tick):
            return self.does.pop("once", False)

    arm, robot, state = live(guards=[Once(once=True)], limits=Limits(hold_time=2.0))
    state = robot.step(state.command)
    arm.old = 0.2
    for _ in range(25):
        robot.step(state.command)
    assert [text for text in robot.warnings if text.startswith("changed commands")] == []


def test_no_attribute_opens_the_gate():
    _, robot, _ = live()
    for name in ("guards", "limits", "spec", "status", "num_robots", "step", "report"):
        with pytest.raises(AttributeError):
            setattr(robot, name, ())
    for kind, name in ((SafeRobot, "step"), (ClearedCommand, "for_robot"), (JointSpeed, "limit"), (Guard, "fault")):
        with pytest.raises(
            AttributeError, match=rf"^{kind.__name__}\.{name} cannot be replaced: it keeps a robot safe"
        ):
            setattr(kind, name, lambda *_: None)
        with pytest.raises(AttributeError, match="cannot be removed"):
            delattr(kind, name)
    with pytest.raises(AttributeError):
        robot.limits.tool_speed = math.inf


def test_what_is_refused_at_once():
    inner = FakeRobot()
    robot = SafeRobot(inner)
    robot.connect()
    for kind, text, act in (
        (ResetNeeded, "Nothing is known of the robot yet. Call reset() first.", lambda: robot.step(np.zeros((1, 7)))),
        (InvalidValue, "The command must have shape (1, 7), not (1, 6).", lambda: robot.step(np.zeros((1, 6)))),
        (InvalidValue, "A SafeRobot guards one robot, not 2 stepped together.", lambda: SafeRobot(FakeRobot(2))),
        (
            InvalidValue,
            "The limit tool_speed of a live robot must be 0.005 to 1 m/s, not inf.",
            lambda: SafeRobot(LiveArm(), limits=Limits(tool_speed=math.inf)),
        ),
        (
            InvalidValue,
            "The limit lag of a live robot must be 0.001 to 0.5 s, not 3.",
            lambda: SafeRobot(LiveArm(), limits=Limits(lag=3.0)),
        ),
    ):
        with pytest.raises(kind) as caught:
            act()
        assert str(caught.value) == text
    assert inner.sent == []


def test_a_joint_that_is_not_measured_is_refused():
    class Blind(FakeRobot):
        def __init__(self):
            super().__init__()
            spec = self.spec
            self.spec = type(spec)(spec.name, spec.signals[2:], spec.command, spec.period)

    with pytest.raises(InvalidValue) as caught:
        SafeRobot(Blind())
    assert str(caught.value) == (
        "The guards need shoulder_pan_joint, shoulder_lift_joint, elbow_joint, wrist_1_joint, wrist_2_joint, "
        "wrist_3_joint of fake measured in rad; no signal has it."
    )


def test_two_bad_ticks_hold_and_the_third_stops_until_a_person_resumes():
    """Over steps, resets and connections."""
    inner, robot, state = fake()
    robot.step(NAN)
    robot.step(NAN)
    sent = robot.step(away(state, 0.02)).command  # a good one between them counts anew
    for _ in range(2):
        np.testing.assert_array_equal(robot.step(NAN).command, sent)
        assert robot.status == "finite (G2)"
    halts, count = inner.halts, len(inner.sent)
    with pytest.raises(SafetyStop) as caught:
        robot.step(NAN)
    assert caught.value.guard == "finite"
    assert str(caught.value) == (
        "The robot was stopped by finite (G2): the command for shoulder_pan_joint, shoulder_lift_joint, elbow_joint, "
        "wrist_1_joint, wrist_2_joint, wrist_3_joint, gripper_width is not a finite number, 3 ticks in a row. "
        "When it is safe, call resume()."
    )
    assert inner.halts == halts + 1
    counts = {"altered": 0, "held": 5, "stopped": 1}
    assert robot.report()["finite"] == {"number": "G2", "limit": 3, "unit": "bad ticks in a row", **counts}
    robot.close()
    robot.connect()
    for act in (lambda: robot.step(state.command), lambda: robot.reset(np.arange(1), start_at())):
        with pytest.raises(SafetyStop) as caught:
            act()
        assert caught.value.guard == "finite"
        assert str(caught.value).startswith("The robot is still stopped by finite (G2): ")
        assert str(caught.value).endswith("When it is safe, call resume().")
    assert len(inner.sent) == count
    robot.resume()
    robot.step(robot.reset(np.arange(1), start_at()).command)


def test_stale_states_hold_for_half_a_second_and_then_stop():
    arm, robot, state = live()
    state = robot.step(away(state, 0.02))
    arm.old = 0.11
    for _ in range(9):
        np.testing.assert_array_equal(robot.step(away(state, 0.02)).command, state.command)
        assert robot.status == "state age (G3)"
    with pytest.raises(StaleState) as caught:
        robot.step(away(state, 0.02))
    assert str(caught.value) == (
        "The robot was stopped by state age (G3): the newest state is 0.110 s old, and at most 0.1 s are allowed, "
        "10 ticks in a row. Whether it stands is not known: stop it by hand if it moves. "
        "When it is safe, call resume()."
    )
    assert (caught.value.age, caught.value.limit) == (0.11, 0.1)
    assert robot.report()["state age"]["held"] == 10
    with pytest.raises(SafetyStop):
        robot.step(state.command)
    assert robot.age() == 0.11


def test_after_stale_states_it_goes_on_from_rest():
    arm, robot, state = live()
    state = robot.step(state.command)
    for _ in range(2):  # more of them are a bad link
        arm.old = 0.3
        for _ in range(5):
            state = robot.step(turned(state, 0.05))
        arm.old = 0.0
        after = robot.step(turned(state, 0.05))
        np.testing.assert_allclose((after.command - state.command)[0, 5], 0.025)
        state = after
    assert (robot.report()["state age"]["held"], robot.report()["state age"]["stopped"]) == (10, 0)


@pytest.mark.parametrize("paused", [False, True])
def test_no_motion_begins_at_a_stale_state(paused):
    """After a halt, and after a pause of this process, which halts it."""
    arm, robot, state = live()
    if paused:
        state = robot.step(away(state, 0.02))
        arm.now += 1.0
    else:
        robot.halt()
    arm.old, sent, halts = 0.3, len(arm.sent), arm.halts
    with pytest.raises(StaleState) as caught:
        robot.step(away(state, 0.02))
    assert str(caught.value) == (
        "The newest state is 0.300 s old, and a motion begins at a state of at most 0.1 s. Nothing was sent; "
        "look at the link, at what publishes the state, and at whether this computer is busy."
    )
    assert (len(arm.sent), arm.halts) == (sent, halts + 1)


def test_after_a_pause_of_this_process_a_motion_begins_at_the_state_that_lay_unread():
    arm, robot, state = live()
    robot.halt()
    ages = [0.3] * 20
    arm.age = lambda: ages.pop() if ages else 0.01
    robot.step(away(state, 0.02))
    assert ages == []
    assert robot.status == ""
    assert robot.report()["state age"]["stopped"] == 0


@pytest.mark.parametrize("fault", [ProtocolError("no stamp"), LinkLost("gone")])
def test_a_state_that_cannot_be_read_before_a_command_halts(fault):
    arm, robot, state = live()
    state = robot.step(away(state, 0.02))

    def fail():
        raise fault

    arm.age, halts, sent = fail, arm.halts, len(arm.sent)
    with pytest.raises(type(fault)):
        robot.step(away(state, 0.02))
    assert (arm.halts, len(arm.sent)) == (halts + 1, sent)


@pytest.mark.parametrize("lie", [{"joint_position": np.full((1, 6), 3.5)}, {"joint_velocity": np.full((1, 6), 4.0)}])
def test_a_measurement_beyond_the_data_sheet_stops_at_once(lie):
    arm, robot, state = live()
    arm.during = lambda: arm.lie.update(lie)
    with pytest.raises(SafetyStop, match=r"^The robot was stopped by measured limits \(G7\): joint_") as caught:
        robot.step(away(state, 0.02))
    assert caught.value.guard == "measured limits"
    with pytest.raises(SafetyStop):
        robot.step(state.command)


def test_a_live_arm_opens_its_gripper_and_goes_to_its_start_slowly():
    arm, robot, _ = live()
    begin, goal = ARM_HOME - np.array([0.1, 0, 0, 0, 0, 0.6]), ARM_HOME
    arm.place(begin, width=0.03)
    count = len(arm.sent)
    state = robot.reset(np.arange(1), start_at(goal))
    np.testing.assert_allclose(state.signals["joint_position"][0], goal, atol=1e-9)
    np.testing.assert_allclose(state.command[0, :6], goal, atol=1e-12)
    path = np.array([[*begin, 0.03], *[sent[0] for sent in arm.sent[count:]]])
    opening = np.abs(np.diff(path[:, 6])) > 0
    np.testing.assert_array_equal(path[1:][opening][:, :6], np.tile(begin, (opening.sum(), 1)))
    steps = np.diff(path, axis=0)
    assert np.abs(steps[:, :6]).max() <= 0.25 * 0.05 + 1e-9
    assert np.abs(np.diff(steps[:, :6], axis=0)).max() <= 10.0 * 0.05**2 + 1e-9
    assert len(steps) == 8 + 48  # 55 mm at 0.15 m/s, then 0.6 rad at 0.25 rad/s


def test_a_live_arm_that_is_there_is_sent_nothing():
    arm, robot, _ = live()
    count = len(arm.sent)
    robot.reset(np.arange(1), start_at(ARM_HOME + 0.01))
    assert len(arm.sent) == count


@pytest.mark.parametrize(
    ("old", "late", "else_"),
    [
        (0.05, 0.0, ""),
        (0.06, 0.0, "; the newest state was 0.06 s old: this computer or the link is busy"),
        (0.05, 0.03, "; the last command was sent 0.08 s ago: this computer or the link is busy"),
        (0.05, 0.02, "; 12 of the last 13 commands were late: this computer or the link is busy"),
    ],
)
def test_a_joint_that_is_blocked_on_the_way_to_the_start_stops_the_arm(old, late, else_):
    arm, robot, _ = live()
    arm.stuck, arm.old, arm.during = 1, old, lambda: setattr(arm, "now", arm.now + late)
    halts, count = arm.halts, len(arm.sent)
    with pytest.raises(SafetyStop) as caught:
        robot.reset(np.arange(1), start_at(ARM_HOME + 0.2))
    assert caught.value.guard == "following"
    assert str(caught.value) == (
        "The robot was stopped by following (G23): shoulder_lift_joint does not follow its commands: it is -0.012 rad "
        "from the last one, and beyond a lag of 0 s it may be 0.009 rad, and the tool 0.009 m: look for a protective "
        "stop, a paused program, an inactive controller, a low speed slider, or something in its way"
        f"{else_}. When it is safe, call resume()."
    )
    assert arm.halts > halts + 1
    assert np.abs(np.array(arm.sent[count:])[:, 0, 1] - ARM_HOME[1]).max() <= 0.0125 + 1e-9


def test_a_way_that_is_too_long_for_the_time():
    arm, robot, _ = live(limits=Limits(reset_timeout=0.1))
    text = r"The arm did not reach its start pose in 0\.1 s: shoulder_pan_joint is \+0\.1"
    with pytest.raises(StartNotReached, match=f"^{text}"):
        robot.reset(np.arange(1), start_at(ARM_HOME + 0.2))
    arm.not_ready = lambda: "protective stop"
    with pytest.raises(StartNotReached, match=rf"^Not ready: protective stop\. {text}"):
        robot.reset(np.arange(1), start_at(ARM_HOME + 0.2))


def test_a_start_outside_the_limits_is_refused_before_anything_moves():
    arm, robot, _ = live()
    goal = ARM_HOME.copy()
    goal[2] = 3.1
    count = len(arm.sent)
    with pytest.raises(InvalidValue) as caught:
        robot.reset(np.arange(1), start_at(goal))
    assert str(caught.value) == (
        "The start pose has elbow_joint at 3.100 rad, outside the -3.042 to 3.042 rad that the guards allow. "
        "Choose another start, or a smaller position_margin."
    )
    assert len(arm.sent) == count


def test_a_first_command_far_away_is_gone_to_slowly():
    arm, robot, state = live()
    far = away(state, 0.3)
    for _ in range(5):
        before = state.command
        state = robot.step(far)
        assert robot.status == "ramp-in speed (G14)"
        assert np.abs(state.command - before).max() <= 0.0125 + 1e-9
    assert len(arm.sent) == 5


def test_after_a_halt_the_gripper_goes_on_holding():
    arm, robot, state = live()
    closed = state.command.copy()
    closed[0, 6] = 0.0
    for _ in range(15):
        robot.step(closed)
    robot.halt()
    arm.place(ARM_HOME, width=0.04)
    assert robot.step(closed).command[0, 6] == 0.0


def test_a_halt_that_comes_just_before_the_command_is_repeated_after_it():
    arm, robot, state = live()
    seen = []

    def halt_meanwhile():
        arm.during = None
        thread = threading.Thread(target=robot.halt)
        thread.start()
        thread.join()
        seen.append(arm.halts)

    arm.during = halt_meanwhile
    robot.step(away(state, 0.02))
    assert arm.halts == seen[0] + 1
    pushed = ARM_HOME + 0.4
    arm.place(pushed)
    assert np.abs(robot.step(state.command).command[0, :6] - pushed).max() <= 0.0125 + 1e-9


def test_a_halt_while_the_time_since_the_last_command_is_measured():
    arm, meanwhile = LiveArm(), []
    robot = SafeRobot(arm, clock=lambda: (arm.now, [work() for work in meanwhile])[0])
    robot.connect()
    arm.place(ARM_HOME)
    state = robot.reset(np.arange(1), start_at())
    robot.step(away(state, 0.02))
    halts, meanwhile[:] = arm.halts, [lambda: (meanwhile.clear(), robot.halt())]
    robot.step(away(state, 0.02))
    assert arm.halts == halts + 2  # the second one after the command


def halt(arm, robot, state, pushed):
    robot.halt()
    arm.place(pushed)


def lose_link(arm, robot, state, pushed):
    arm.fails, halts = LinkLost("cut"), arm.halts
    with pytest.raises(LinkLost, match="cut"):
        robot.step(state.command)
    assert arm.halts == halts + 1
    arm.fails = None
    arm.place(pushed)


def stop(arm, robot, state, pushed):
    robot.step(NAN)
    robot.step(NAN)
    with pytest.raises(SafetyStop):
        robot.step(NAN)
    arm.place(pushed)
    robot.resume()


def pause(arm, robot, state, pushed):
    arm.now += 10.0
    arm.place(pushed)
    with pytest.raises(SafetyStop):
        robot.step(state.command)
    robot.resume()


def connect_again(arm, robot, state, pushed):
    robot.close()
    arm.place(pushed)
    robot.connect()
    try:
        robot.reset(np.arange(1), start_at(pushed))
    except InvalidValue:  # a pose outside the box is no start
        reject()


INTERRUPTIONS = {"halt": halt, "lost link": lose_link, "stop": stop, "pause": pause, "connect": connect_again}


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-0.04, 0.04), min_size=6, max_size=6),
    st.sampled_from(sorted(INTERRUPTIONS)),
    st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6),
    st.lists(st.floats(-8, 8), min_size=7, max_size=7),
)
def test_no_jump_from_where_somebody_moved_it_whatever_came_between(way, kind, push, command):
    arm, robot, state = live()
    for _ in range(5):
        state = robot.step(away(state, *way))
    pushed = arm.measure().signals["joint_position"][0] + push
    INTERRUPTIONS[kind](arm, robot, state, pushed)
    sent = robot.step(np.array([command])).command[0]
    assert np.abs(sent[:6] - pushed).max() <= 0.025 + 1e-9
    assert tool_travel(pushed, sent) <= 0.0125 + 1e-9


def test_a_late_command_is_not_executed():
    arm, robot, state = live()
    for _ in range(10):
        state = robot.step(turned(state, 0.03))
    arm.now += 0.06  # beyond two periods since the last command
    np.testing.assert_array_equal(robot.step(turned(state, 0.03)).command, state.command)
    assert robot.status == "command pace (G15)"
    assert np.abs(robot.step(turned(state, 0.03)).command - state.command).max() <= 0.025 + 1e-9


def test_a_policy_that_is_too_slow_moves_nothing_and_is_stopped():
    arm, robot, state = live()
    state = robot.step(turned(state, 0.02))
    for _ in range(9):
        arm.now += 0.3
        np.testing.assert_array_equal(robot.step(turned(state, 0.03)).command, state.command)
    arm.now += 0.3
    with pytest.raises(SafetyStop) as caught:
        robot.step(turned(state, 0.03))
    assert str(caught.value) == (
        "The robot was stopped by command pace (G15): the command came 0.350 s after the one before, and one is "
        "expected every 0.05 s: the policy takes too long, or this process was paused or the computer is busy, "
        "10 ticks in a row. When it is safe, call resume()."
    )


@pytest.mark.parametrize("when", ["in the episode", "on the way to the start"])
def test_after_a_pause_of_this_process_nothing_moves_before_a_person_resumes(when):
    arm, robot, state = live()
    for _ in range(3):
        state = robot.step(turned(state, 0.03))
    sent = len(arm.sent)

    def pause_once():
        arm.now, arm.during = arm.now + 10.0, None

    arm.during = pause_once
    stopped = r"^The robot was stopped by command pace \(G15\): the command came 10\.050 s after"
    if when == "in the episode":
        robot.step(turned(state, 0.03))
        with pytest.raises(SafetyStop, match=stopped):
            robot.step(turned(state, 0.03))
    else:
        with pytest.raises(SafetyStop, match=stopped):
            robot.reset(np.arange(1), start_at(ARM_HOME + 0.3))
    assert len(arm.sent) == sent + 1
    with pytest.raises(SafetyStop, match=r"^The robot is still stopped by command pace"):
        robot.step(state.command)
    robot.resume()
    robot.step(state.command)


def test_limits_hold_over_the_real_time_since_the_last_command():
    """Commands that are late every second tick come 29 ms after the one before."""
    arm, robot, state = live()
    arm.info = type("Info", (), {"lockstep": False})
    sent = [(arm.now, state.command[0])]
    for tick in range(20):
        arm.now += 0.021 if tick % 2 else -0.021
        begun = arm.now
        state = robot.step(away(state, 0.05, 0, 0, 0, 0, 0.2))
        sent.append((begun, state.command[0]))
    for (before, one), (now, other) in itertools.pairwise(sent[1:]):
        took = min(now - before, 0.05)
        assert tool_travel(one, other) <= 0.25 * took + 1e-9
        assert np.abs(other - one)[:6].max() <= 1.0 * took + 1e-9
    assert {round(now - before, 3) for (before, _), (now, _) in itertools.pairwise(sent[1:])} == {0.029, 0.071}


def test_a_blocked_joint_is_gone_back_to_no_faster_than_its_limit_where_ticks_are_short():
    arm, robot, state = live(limits=Limits(tool_speed=1.0, joint_acceleration=20.0))
    sent = [(arm.now, state.command[0])]
    for tick in range(22):
        arm.now -= 0.03 * (tick % 2)
        arm.stuck = [5] if tick >= 6 else None
        begun = arm.now
        state = robot.step(turned(state, 0.2))
        sent.append((begun, state.command[0]))
    for (before, one), (now, other) in itertools.pairwise(sent[1:]):
        assert np.abs(other - one)[:6].max() <= 1.0 * min(now - before, 0.05) + 1e-9
    assert robot.report()["following"]["held"] > 0


def test_a_robot_that_does_not_answer_is_held_and_then_stopped():
    arm, robot, state = live()
    arm.waiting = lambda: arm.now
    for _ in range(6):
        state = robot.step(turned(state, 0.01))
    assert robot.status == ""
    for _ in range(10):
        arm.now += 0.001
        try:
            np.testing.assert_array_equal(robot.step(turned(state, 0.01)).command, state.command)
        except SafetyStop as stop:
            told = str(stop)
    assert told == (
        "The robot was stopped by answer to a command (G4): a command that was sent 0.760 s ago is not answered, and "
        "at most 0.3 s are allowed: commands arrive late or not at all; check the network, and other clients that "
        "command the robot, 10 ticks in a row. When it is safe, call resume()."
    )


def test_an_arm_that_is_measured_too_fast_is_held_and_stopped_when_it_goes_on():
    arm, robot, state = live()
    state = robot.step(state.command)
    arm.lie = {"joint_velocity": np.array([[0, 0, 0, 0, 0, 1.5]])}
    robot.step(turned(state, 0.01))
    held = robot.step(turned(state, 0.02)).command
    assert robot.status == ""
    for _ in range(2):
        np.testing.assert_array_equal(robot.step(turned(state, 0.03)).command, held)
        assert robot.status == "measured joint speed (G8)"
    with pytest.raises(SafetyStop) as caught:
        robot.step(turned(state, 0.03))
    assert caught.value.guard == "measured joint speed"


def test_a_joint_that_is_measured_elsewhere_at_once_is_not_gone_to():
    arm, robot, state = live()
    for _ in range(5):
        state = robot.step(turned(state, 0.03))
    sent = len(arm.sent)
    arm.place(state.command[0, :6] + np.array([0, 0, 0, 0.5, 0, 0]))
    robot.step(state.command)  # measured before
    with pytest.raises(SafetyStop) as caught:
        robot.step(state.command)
    assert caught.value.guard == "measured jump"
    assert len(arm.sent) == sent + 1


def test_a_robot_that_waits_for_commands_does_not_mind_a_pause():
    arm, robot, state = live()
    arm.info = type("Info", (), {"lockstep": True})
    for _ in range(10):
        state = robot.step(turned(state, 0.02))
    arm.now += 60.0
    command = turned(state, 0.02)
    np.testing.assert_array_equal(robot.step(command).command, command)
    assert robot.info.lockstep


@pytest.mark.parametrize(("width", "begin"), [(-0.0004, 0.0), (0.0853, 0.085)])
def test_a_gripper_that_is_measured_beyond_its_range_begins_inside(width, begin):
    arm = LiveArm()
    robot = SafeRobot(arm, clock=arm.clock)
    robot.connect()
    arm.place(ARM_HOME - 0.1, width)
    state = robot.reset(np.arange(1), start_at())
    assert abs(arm.sent[0][0, 6] - begin) <= 0.0075 + 1e-9
    assert all(0.0 <= sent[0, 6] <= 0.085 for sent in arm.sent)
    assert state.command[0, 6] == 0.085


def test_a_gripper_that_is_not_measured():
    arm = LiveArm()
    arm.spec = type(arm.spec)(arm.spec.name, arm.spec.signals[:2], arm.spec.command, arm.spec.period)
    robot = SafeRobot(arm, clock=arm.clock)
    robot.connect()
    arm.place(ARM_HOME)
    state = robot.reset(np.arange(1), start_at())
    assert arm.sent == []  # it is there, and nobody waits for what nobody sees
    assert state.command[0, 6] == 0.085
    assert robot.step(away(state, 0.01)).command[0, 6] == 0.085


def test_nobody_else_makes_a_cleared_command_and_it_is_good_for_its_tick_alone():
    arm, robot, state = live()
    robot.step(away(state, 0.01))
    old = arm.cleared[-1]
    over = r"^The tick that this command was cleared for is over\. Give the next one to the SafeRobot\.$"
    for act, text in (
        (
            lambda: ClearedCommand(np.zeros((1, 7))),
            r"^Only a SafeRobot clears commands\. Build the robot with live_robot",
        ),
        (lambda: ClearedCommand(np.zeros((1, 7)), seal=object()), r"^Only a SafeRobot clears commands"),
        (lambda: type("Mine", (ClearedCommand,), {}), "ClearedCommand has no subclasses"),
        (lambda: arm.step(old), over),
        (lambda: old.for_robot(arm), over),
        (lambda: arm.step(object.__new__(ClearedCommand)), over),
        (lambda: copy.copy(old), "cannot be copied"),
        (lambda: copy.deepcopy(old), "cannot be copied"),
        (lambda: pickle.dumps(old), "cannot be copied"),
    ):
        with pytest.raises(InvalidValue, match=text):
            act()
    with pytest.raises(AttributeError):
        old._command = state.command


def test_a_cleared_command_is_read_only_and_for_one_robot():
    arm, robot, state = live()
    seen = []

    def look(cleared):
        with pytest.raises(ValueError, match="read-only"):
            cleared.for_robot(arm)[0, 0] = 1.0
        with pytest.raises(InvalidValue, match="was cleared for another robot"):
            cleared.for_robot(LiveArm())
        seen.append(cleared.for_robot(arm))

    arm.look = look
    robot.step(away(state, 0.01))
    assert len(seen) == 1
