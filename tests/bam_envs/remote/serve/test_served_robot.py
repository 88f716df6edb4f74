import threading
import time
from unittest import mock

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, PhysicsDiverged, RemoteError, ResetNeeded
from bam_envs.core.robot import Initial
from bam_envs.core.timing import Ticker
from bam_envs.remote.serve.served_robot import PARTS, ServedRobot
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.mujoco_arm import SimulatedArm

HOME = np.array([[0.0, -1.2, 1.6, -2.0, -1.57, 0.0]])
ROWS = np.zeros(1, dtype=np.int64)


def initial(joints=HOME):
    return Initial({"joint_position": joints, "object_pose": np.array([[0.5, 0.1, 0.3]])}, np.zeros(1, dtype=np.int64))


def command(change=0.0, width=0.085):
    return np.concatenate([HOME + change, [[width]]], axis=1)


class Without:
    """A robot that cannot do one thing."""

    def __init__(self, robot, missing):
        self._robot, self._missing = robot, missing

    def __getattr__(self, name):
        if name == self._missing:
            raise AttributeError(name)
        return getattr(self._robot, name)


@pytest.fixture
def hands():
    """A clock that is set by hand."""
    clock = mock.Mock(side_effect=lambda: clock.now, now=0.0)
    return clock


@pytest.fixture
def serve(hands):
    served = []

    def make(robot, now=hands, **options):
        served.append(ServedRobot(robot, command_timeout=0.1, now=now, **options))
        served[-1].connect()
        served[-1].reset(ROWS, initial())
        return served[-1]

    yield make
    for one in served:
        one.close()


@pytest.fixture
def arm():
    robot = SimulatedArm(1)
    robot.connect()
    yield robot
    robot.close()


def ticks(served, hands, number):
    for _ in range(number):
        served.tick()
        hands.now += served.tick_period


def test_fast_a_step_is_the_robots_own_bit_for_bit(serve, arm):
    served = serve(SimulatedArm(1))
    arm.reset(ROWS, initial())
    for change in (0.01, 0.02, 0.05):
        ours, theirs = served.step(command(change)), arm.step(command(change))
        for name, value in theirs.signals.items():
            np.testing.assert_array_equal(ours.signals[name], value)
        assert served.state is ours


def test_in_real_time_a_command_takes_a_period_of_ticks(serve, arm, hands):
    served = serve(SimulatedArm(1), realtime=True)
    assert served.tick_period == pytest.approx(0.01)
    served.follow(command(0.02))
    ticks(served, hands, PARTS)
    arm.reset(ROWS, initial())
    np.testing.assert_allclose(
        served.state.signals["joint_position"], arm.step(command(0.02)).signals["joint_position"]
    )
    np.testing.assert_allclose(served.state.stamp, [0.05])


@pytest.fixture
def stream(serve, hands):
    """Sends the pan joint of a simulated arm steps of 0.02 rad, and notes its highest speed after each tick."""
    served = serve(SimulatedArm(1), realtime=True)
    served.command_timeout = 0.5

    def period(step, parts=PARTS, count=1):
        served.follow(command(0.02 * step * np.eye(6)[:1]), count=count)
        for _ in range(parts):
            ticks(served, hands, 1)
            period.speeds.append(np.abs(served.state.signals["joint_velocity"]).max())

    period.served, period.hands, period.speeds = served, hands, []
    for step in range(1, 9):
        period(step)
    period.usual = max(period.speeds)
    return period


def arrives(stream, last):
    """Whether the arm is never much faster than its commands, and comes to the `last` one."""
    ticks(stream.served, stream.hands, 4 * PARTS)
    there = HOME + 0.02 * last * np.eye(6)[0]
    np.testing.assert_allclose(stream.served.state.signals["joint_position"], there, atol=0.005)
    return max(stream.speeds) < 1.3 * stream.usual


@pytest.mark.parametrize("burst", [1, 2])  # the commands of the lost time come in one tick, or in two
@pytest.mark.parametrize("held", [0, 3])  # periods in which the last of them comes again
def test_a_robot_whose_clock_stood_still_catches_up_slowly(stream, hands, burst, held):
    hands.now += 3 * 0.05  # commands 9, 10 and 11 come meanwhile
    if burst == 2:
        stream(9, parts=1)
    stream(11, count=4 - burst)
    for step in [*[11] * held, *range(12, 40)]:
        stream(step)
    assert arrives(stream, 39)


@pytest.mark.parametrize("late", [2, 4])
def test_a_command_soon_after_a_late_one_does_not_make_the_robot_fast(stream, late):
    for step in range(9, 40):
        stream(step, parts=PARTS + late * (step % 5 == 0) - late * (step % 5 == 1))
    assert arrives(stream, 39)


def test_wrong_commands_are_refused_and_a_clock_that_stands_still_is_an_error(serve):
    served = serve(FakeRobot(1), realtime=True, patience=0.01)
    with pytest.raises(InvalidValue, match=r"must have shape \(1, 7\), not \(1, 6\)"):
        served.step(np.zeros((1, 6)))
    with pytest.raises(InvalidValue, match="finite"):
        served.step(np.full((1, 7), np.nan))
    with pytest.raises(RemoteError, match=r"The clock of .* has stood still for 0.01 s\."):
        served.step(command())


def test_a_robot_without_parts_is_stepped_a_period_at_a_time(serve, hands):
    robot = FakeRobot(1)
    served = serve(Without(robot, "slices"), realtime=True)
    assert served.tick_period == 0.05
    served.follow(command(0.02))
    served.tick()
    np.testing.assert_array_equal(robot.sent[-1], command(0.02))


def test_without_fresh_commands_the_arm_rests_where_it_is(serve, hands):
    served = serve(SimulatedArm(1), realtime=True)
    for step in range(1, 5):
        served.follow(command(0.1 * step))
        ticks(served, hands, PARTS)
    # The last one is 0.05 s old: it is good for 0.05 s more.
    served.follow(command(0.5))
    ticks(served, hands, 12)
    assert (served.target() != command(0.5)).any()
    rest = served.target()
    np.testing.assert_allclose(rest[0, :6], served.state.signals["joint_position"][0], atol=0.02)
    ticks(served, hands, 100)
    np.testing.assert_array_equal(served.target(), rest)
    np.testing.assert_allclose(served.state.signals["joint_velocity"], 0.0, atol=1e-3)


def test_after_the_command_timeout_a_command_begins_from_where_the_arm_is(serve, hands):
    served = serve(SimulatedArm(1), realtime=True)
    served.follow(command(0.1))
    ticks(served, hands, 50)
    before = served.state.signals["joint_position"].copy()
    served.follow(command(1.5))
    ticks(served, hands, 1)
    moved = np.abs(served.state.signals["joint_position"] - before)
    assert moved.max() < np.pi * 0.01  # no faster than the arm can, from the pose it had


def test_commands_that_come_quickly_never_exceed_the_speed_of_the_arm(serve, hands):
    served = serve(SimulatedArm(1), realtime=True)
    setpoints = [served.setpoint]
    for _ in range(40):
        served.follow(command(1.5))
        ticks(served, hands, 2)
        setpoints.append(served.setpoint)
    speed = np.abs(np.diff(np.concatenate(setpoints)[:, :6], axis=0)) / 0.02
    assert speed.max() <= np.pi + 1e-9


def test_a_command_one_part_early_loses_none(serve, hands):
    served = serve(SimulatedArm(1), realtime=True)
    served.follow(command(0.02))
    ticks(served, hands, PARTS - 1)
    served.follow(command(0.04))
    ticks(served, hands, 1)
    np.testing.assert_allclose(served.setpoint[0, :6], HOME[0] + 0.02)
    ticks(served, hands, PARTS)
    np.testing.assert_allclose(served.setpoint[0, :6], HOME[0] + 0.04)


def test_halt_stops_at_once_and_again_changes_nothing(serve, hands):
    served = serve(FakeRobot(1), realtime=True)  # which says no set point, and rests where it was measured
    served.follow(command(3.0))
    ticks(served, hands, PARTS)
    served.halt()
    measured = np.concatenate([served.state.signals[name] for name in ("joint_position", "gripper_width")], axis=1)
    np.testing.assert_array_equal(served.target(), measured)
    served = serve(SimulatedArm(1), realtime=True)
    served.follow(command(0.5))
    ticks(served, hands, 3)
    served.halt()
    rest = served.target()
    np.testing.assert_array_equal(rest[:, :6], served.state.signals["joint_position"])
    ticks(served, hands, 2)
    served.halt()
    np.testing.assert_array_equal(served.target(), rest)


def test_a_robot_in_lockstep_has_the_speed_of_its_step_until_it_rests(serve):
    """No time passes any more, in which it would come to rest."""
    served = serve(SimulatedArm(1))
    moved = served.step(command(0.05))
    assert np.abs(moved.signals["joint_velocity"]).max() > 0.01
    assert served.state is moved
    served.halt()
    placed = served.state
    served.place_object(np.array([[0.5, 0.0, 0.0]]), ROWS)
    for state in (placed, served.state):
        np.testing.assert_array_equal(state.signals["joint_velocity"], np.zeros((1, 6)))
    np.testing.assert_array_equal(placed.signals["joint_position"], moved.signals["joint_position"])


def test_after_the_command_timeout_a_closed_gripper_keeps_holding_and_a_base_rests_at_zero_speed(serve, hands):
    served = serve(SimulatedArm(1), realtime=True)
    for _ in range(10):
        served.follow(command(0.0, 0.0))
        ticks(served, hands, PARTS)
    ticks(served, hands, 50)
    assert served.target()[0, 6] < 0.01
    base = serve(FakeRobot(1), realtime=True, zero_rests=True)
    base.follow(command(0.1))
    hands.now += 0.11
    base.tick()
    np.testing.assert_array_equal(base.target(), np.zeros((1, 7)))


def test_a_step_in_real_time_waits_for_the_clock(serve):
    served = serve(SimulatedArm(1), time.monotonic, realtime=True)
    clock = Ticker(served.tick, 0.001)
    clock.start()
    stamps = [served.step(command(0.01 * i)).stamp[0] for i in range(1, 4)]
    clock.stop()
    assert np.diff(stamps).min() >= 0.05 - 1e-9


def test_a_halt_ends_a_step_that_is_waited_for_in_time(serve):
    served = serve(SimulatedArm(1), time.monotonic, realtime=True)
    states = []
    thread = threading.Thread(target=lambda: states.append(served.step(command(0.1))))
    thread.start()
    while served.resting:
        served.tick()
    served.halt()
    for _ in range(PARTS):
        served.tick()
    thread.join(10)
    assert states == [served.state]


class Failing(FakeRobot):
    def step(self, command):
        raise PhysicsDiverged("The simulated state of environments [0] is not finite. Reset them.")

    def slices(self, command, parts):
        yield self.step(command)


@pytest.mark.parametrize("mode", ["fast", "followed", "stepped"])
def test_a_fault_reaches_the_step_that_waits_and_stays_until_a_reset(serve, mode):
    served = serve(Failing(1), time.monotonic, realtime=mode != "fast")
    clock = Ticker(served.tick, 0.001)
    if mode == "followed":
        served.follow(command())
        served.tick()
        served.tick()
    else:
        if mode == "stepped":
            clock.start()
        with pytest.raises(PhysicsDiverged, match="not finite"):
            served.step(command())
        clock.stop()
    assert str(served.fault) == "The simulated state of environments [0] is not finite. Reset them."
    served.reset(ROWS, initial())
    assert served.fault is None


def test_the_scene_changes_and_the_arm_stays(serve):
    served = serve(SimulatedArm(1))
    served.step(command(0.05))
    joints = served.state.signals["joint_position"].copy()
    served.place_object(np.array([[0.4, -0.1, 0.0]]), np.zeros(1, dtype=np.int64))
    np.testing.assert_allclose(served.state.signals["object_position"][0, :2], [0.4, -0.1])
    np.testing.assert_array_equal(served.state.signals["joint_position"], joints)
    assert sorted(served.state_dict()) == ["command", "physics", "setpoint"]
    assert not any(hasattr(served, name) for name in ("no_such_thing", "_no_such_thing"))
    served = serve(Without(FakeRobot(1), "place_object"))
    with pytest.raises(RemoteError, match=r"fake has no object that could be placed\."):
        served.place_object(np.zeros((1, 3)), np.zeros(1, dtype=np.int64))


def test_time_stands_still_before_the_first_reset_and_after_the_end(hands):
    served = ServedRobot(SimulatedArm(1), command_timeout=0.1, realtime=True, now=hands)
    served.halt()
    served.tick()
    assert served.state is None
    served.connect()
    served.reset(ROWS, initial())
    served.close()
    served.tick()
    assert served.state is None


def test_a_step_that_waits_is_told_of_the_end(serve):
    served = serve(SimulatedArm(1), time.monotonic, realtime=True)
    failures = []

    def step():
        with pytest.raises(ResetNeeded, match=r"^The served robot was closed\.$"):
            served.step(command())
        failures.append(True)

    thread = threading.Thread(target=step)
    thread.start()
    while served.resting:
        served.tick()
    served.close()
    thread.join(10)
    assert failures == [True]
