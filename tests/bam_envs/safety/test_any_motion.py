"""Whatever is commanded, however late it comes, whatever is lost and whatever is measured: the limits hold."""

import math
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bam_envs.core.errors import LinkLost, RobotFault, SafetyStop
from bam_envs.core.robot import Initial, RobotState
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.kinematic_base import SimulatedBase
from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Limits
from bam_envs.testing import ARM_HOME

ROW = np.zeros(1, np.int64)
SLACK = 1e-8
HALT = "halt"


class Cell:
    """A live robot whose link loses and delays messages, and whose sensors are wrong, as the test says."""

    needs_clearance = True
    num_robots = 1
    info = None

    def __init__(self, robot, measured):
        self.robot, self.spec, self.measured = robot, robot.spec, measured
        self.now, self.old, self.owed, self.lie, self.is_lost, self.is_cut = 0.0, 0.0, 0.0, 0.0, False, False
        self.events = []
        """What the robot was sent, in order: (command, measured just before it), or `HALT`."""

    def clock(self):
        return self.now

    def age(self):
        return self.old

    def waiting(self):
        return self.owed

    def connect(self):
        self.robot.connect()

    def place(self, initial):
        self.state = self.robot.reset(ROW, initial)
        self.followed = self.state.command

    def measure(self):
        values = self.state.signals[self.measured] + self.lie
        self.shown = values[0]
        return RobotState({**self.state.signals, self.measured: values}, self.state.stamp, self.state.command)

    def reset(self, env_ids, initial):
        return self.measure()

    def step(self, cleared):
        command = cleared.for_robot(self).copy()
        if self.is_cut:
            raise LinkLost("The link is down.")
        self.events.append((command[0], self.shown))
        self.followed = self.followed if self.is_lost else command
        self.now += self.spec.period
        self.state = self.robot.step(self.followed)
        return self.measure()

    def halt(self):
        self.events.append(HALT)

    def close(self):
        pass


def mostly(normal, *others):
    return st.one_of(st.just(normal), st.just(normal), st.just(normal), *others)


def tick_strategy(size, reach):
    numbers = st.one_of(
        st.floats(-reach, reach), st.sampled_from([0.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 7.0, -7.0])
    )
    ways = st.lists(st.floats(-reach, reach), min_size=size, max_size=size)
    return st.fixed_dictionaries(
        {
            "command": st.one_of(ways, ways, st.lists(numbers, min_size=size, max_size=size)),
            "is_way": st.booleans(),
            "late": mostly(0.0, st.floats(0.0, 0.3), st.floats(0.0, 3.0)),
            "old": mostly(0.0, st.floats(0.0, 0.2), st.just(math.inf)),
            "owed": mostly(0.0, st.floats(0.0, 1.0)),
            "lie": mostly(0.0, st.floats(-0.01, 0.01), st.floats(-9.0, 9.0), st.just(math.nan)),
            "is_lost": mostly(False, st.booleans()),
            "is_cut": mostly(False, mostly(False, st.just(True))),
            "before": mostly("", st.sampled_from(["halt", "resume", "reset"])),
            "times": st.integers(1, 6),
        }
    )


def drive(cell, gate, initial, ticks):
    """Give the gate every command; a robot that a fault ends was sent a halt last."""
    last = np.zeros(len(cell.spec.command.labels))
    for tick in ticks:
        cell.old, cell.owed, cell.lie = tick["old"], tick["owed"], tick["lie"]
        cell.is_lost, cell.is_cut = tick["is_lost"], tick["is_cut"]
        for _ in range(tick["times"]):
            cell.now += tick["late"]
            count = len(cell.events)
            try:
                {"": lambda: None, "halt": gate.halt, "resume": gate.resume, "reset": lambda: gate.reset(ROW, initial)}[
                    tick["before"]
                ]()
                command = np.array([tick["command"]]) + (last if tick["is_way"] else 0.0)
                last = gate.step(command).command[0]
            except RobotFault as error:
                assert cell.events[-1] is HALT or count == len(cell.events)
                if isinstance(error, SafetyStop) or gate.stopped is not None:
                    refused(cell, gate)
                    gate.resume()


def refused(cell, gate):
    """A stop latches: nothing is sent before a person resumes."""
    count = len(cell.events)
    assert cell.events[-1] is HALT
    assert gate.code != 0
    with pytest.raises(SafetyStop, match=r"^The robot is still stopped by "):
        gate.step(np.zeros((1, len(cell.spec.command.labels))))
    assert len(cell.events) == count


@settings(max_examples=60, deadline=None)
@given(st.lists(tick_strategy(7, 0.15), max_size=12), st.floats(0.1, 1.0), st.floats(0.02, 0.25))
def test_no_command_to_an_arm_is_beyond_a_limit(ticks, joint_speed, tool_speed):
    limits = Limits(joint_speed=joint_speed, tool_speed=tool_speed)
    cell = Cell(FakeRobot(), "joint_position")
    gate = SafeRobot(cell, limits=limits, clock=cell.clock)
    gate.connect()
    initial = Initial({"joint_position": np.array([ARM_HOME])}, ROW)
    cell.place(initial)
    gate.reset(ROW, initial)
    with mock.patch("bam_envs.safety.gate.FRESH_PAUSE", 0.0):
        drive(cell, gate, initial, ticks)
    low, high = np.array(cell.spec.command.low), np.array(cell.spec.command.high)
    before = HALT
    for event in cell.events:
        if event is not HALT:
            command, shown = event
            assert np.isfinite(command).all()
            assert (command >= low).all()
            assert (command <= high).all()
            # From the command before; or, where a motion begins, from where the arm is measured.
            begins = [shown] if before is HALT else [before[0][:6], shown]
            assert any(is_near(command[:6], one, limits) for one in begins)
        before = event


def is_near(command, begin, limits):
    """Whether the joints `command` are one step from `begin`."""
    travel = math.dist(GEOMETRY.tool_point(command), GEOMETRY.tool_point(begin))
    near = (np.abs(command - begin) <= limits.joint_speed * 0.05 + SLACK).all()
    return bool(near) and travel <= limits.tool_speed * 0.05 + SLACK


@settings(max_examples=60, deadline=None)
@given(st.lists(tick_strategy(2, 1.0), max_size=12), st.floats(0.1, 0.5), st.floats(0.5, 2.0))
def test_no_command_to_a_base_is_beyond_a_limit(ticks, base_speed, base_acceleration):
    limits = Limits(base_speed=base_speed, base_acceleration=base_acceleration)
    cell = Cell(SimulatedBase(with_scans=False), "base_velocity")
    gate = SafeRobot(cell, limits=limits, clock=cell.clock)
    gate.connect()
    initial = Initial({}, ROW)
    cell.place(initial)
    gate.reset(ROW, initial)
    with mock.patch("bam_envs.safety.gate.FRESH_PAUSE", 0.0):
        drive(cell, gate, initial, ticks)
    last = np.zeros(2)
    for event in cell.events:
        command = np.zeros(2) if event is HALT else event[0]
        assert np.isfinite(command).all()
        assert (np.abs(command) <= [base_speed, 0.7]).all()
        gain = np.where(command * last >= 0, np.abs(command) - np.abs(last), np.abs(command))
        assert (gain <= np.array([base_acceleration, 2.5]) * 0.1 + SLACK).all()
        last = command


@pytest.mark.parametrize("wrong", [9.0, math.nan])
def test_a_motion_does_not_begin_at_a_measurement_beyond_the_data_sheet(wrong):
    cell = Cell(FakeRobot(), "joint_position")
    gate = SafeRobot(cell, clock=cell.clock)
    gate.connect()
    initial = Initial({"joint_position": np.array([ARM_HOME])}, ROW)
    cell.place(initial)
    state = gate.step(gate.reset(ROW, initial).command)
    gate.halt()
    cell.lie, count = wrong, len(cell.events)
    with pytest.raises(SafetyStop, match=r"^The robot was stopped by measured limits \(G7\): joint_position of "):
        gate.step(state.command)
    assert cell.events[count:] == [HALT] * (len(cell.events) - count)
