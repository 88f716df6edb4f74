"""The contract test for your own robots."""

import copy
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from unittest import SkipTest

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import BamEnvsError, InvalidValue
from bam_envs.core.robot import EnvIds, Initial, Robot, RobotSpec, RobotState
from bam_envs.testing.assertions import assert_same_state, no_io, raised

Array = NDArray[np.float64]
ARM_HOME = np.array([-0.27, -1.54, 1.89, -1.93, -1.57, -1.84])
"""Joint positions with the tool of a UR5e above the table [rad]."""


class RobotContract:
    """The contract of every robot; each test makes a new robot and closes it."""

    sizes: tuple[int, ...] = (1, 3)
    """Numbers of robots that are stepped together in the tests, in rising order; (1,) for a live one."""
    still = 0.01
    """Maximum motion in a period of a joint that is commanded to stay [rad]."""
    holds_what_is_not_finite = False
    """Whether a command that is not finite makes the robot hold for a tick, rather than raise an error."""

    def make(self, num_robots: int) -> Robot:
        """Hook: a robot that is not connected."""
        raise NotImplementedError("Override make(num_robots) to return the robot under test.")

    def initial(self, robot: Robot, env_ids: EnvIds) -> Initial:
        """Hook: a possible start of an episode."""
        seeds = np.arange(len(env_ids), dtype=np.int64)
        pose = np.tile([0.5, 0.1, 0.3], (len(env_ids), 1))
        return Initial({"joint_position": np.tile(ARM_HOME, (len(env_ids), 1)), "object_pose": pose}, seeds)

    def measured(self, state: RobotState) -> Array:
        """Hook: the measured values of the first k numbers of the command. Shape: (n, k)."""
        return state.signals["joint_position"]

    def stay(self, state: RobotState) -> Array:
        """Hook: the command that keeps every joint in place. Shape: (n, m)."""
        return np.array(state.command)

    def move(self, robot: Robot, state: RobotState) -> Array:
        """Hook: a command close to the robot's position. Shape: (n, m)."""
        rate = np.array(robot.spec.command.max_rate or [1.0] * len(robot.spec.command.labels))
        return self.stay(state) - 0.1 * rate * robot.spec.period

    @contextmanager
    def running(self, num_robots: int = 1) -> Iterator[tuple[Robot, RobotState]]:
        """A connected robot that was reset, and its state."""
        robot = self.make(num_robots)
        try:
            robot.connect()
            env_ids = np.arange(num_robots)
            yield robot, robot.reset(env_ids, self.initial(robot, env_ids))
        finally:
            robot.close()

    def test_constructor_does_no_io(self) -> None:
        """No file, socket or thread; the spec is there before `connect`."""
        with no_io():
            robot = self.make(1)
        assert isinstance(robot, Robot), f"{type(robot).__name__} lacks a member of the Robot protocol"
        assert robot.num_robots == 1
        assert isinstance(robot.spec, RobotSpec)
        assert robot.spec.period > 0

    def test_spec_says_each_number_once(self) -> None:
        """Labels, units and limits of every signal have one length; names differ; limits are ordered."""
        spec = self.make(1).spec
        names = [signal.name for signal in spec.signals]
        assert len(set(names)) == len(names), f"signal names repeat: {names}"
        for signal in (*spec.signals, spec.command):
            size = len(signal.labels)
            assert size > 0, f"{signal.name} has no labels"
            assert len(signal.units) == len(signal.low) == len(signal.high) == size, f"lengths of {signal.name} differ"
            assert len(set(signal.labels)) == size, f"labels of {signal.name} repeat"
            ordered = all(low < high for low, high in zip(signal.low, signal.high, strict=True))
            assert ordered, f"limits of {signal.name}"
            assert signal.max_rate is None or len(signal.max_rate) == size, f"max_rate of {signal.name}"
        assert spec.command.max_rate is not None, "the command needs a max_rate"

    def test_step_before_connect_is_refused(self) -> None:
        """The error is a `BamEnvsError`, not an AttributeError."""
        robot = self.make(1)
        error = raised(BamEnvsError, lambda: robot.step(np.zeros((1, len(robot.spec.command.labels)))))
        assert str(error), "the error has no text"

    def test_connect_is_idempotent_and_moves_nothing(self) -> None:
        """A second `connect` does not move the robot."""
        with self.running() as (robot, before):
            robot.connect()
            after = robot.step(self.stay(before))
            moved = np.abs(self.measured(after) - self.measured(before)).max()
            assert moved <= self.still, f"connect() moved it by {moved}"

    def test_states_are_what_the_spec_says(self) -> None:
        """Names in the spec's order, shape (n, k), finite float64, one stamp and one command for each."""
        for n in self.sizes:
            with self.running(n) as (robot, state):
                _check_state(robot, state)
                _check_state(robot, robot.step(self.move(robot, state)))

    def test_stamps_go_on(self) -> None:
        """The stamp increases with every step."""
        with self.running() as (robot, first):
            second = robot.step(self.stay(first))
            assert (second.stamp > first.stamp).all()

    def test_state_has_the_command_that_was_sent(self) -> None:
        """The command can be recorded with the state."""
        with self.running(self.sizes[-1]) as (robot, state):
            command = self.move(robot, state)
            np.testing.assert_array_equal(robot.step(command).command, command)

    def test_it_goes_where_it_is_told(self) -> None:
        """Half a second after a small step, the robot is closer to its command."""
        with self.running() as (robot, state):
            command, start = self.move(robot, state), self.measured(state)
            for _ in range(math.ceil(0.5 / robot.spec.period)):
                state = robot.step(command)
            before = np.abs(command[:, : start.shape[1]] - start)
            after = np.abs(command[:, : start.shape[1]] - self.measured(state))
            assert (after < before).all(), f"left to go: {after}, at first {before}"

    def test_command_of_another_shape_is_refused(self) -> None:
        """The error names the expected and the actual shape; the robot continues."""
        with self.running() as (robot, state):
            m = len(robot.spec.command.labels)
            for shape in ((m,), (1, m + 1), (2, m)):
                error = raised(InvalidValue, lambda shape=shape: robot.step(np.zeros(shape)))  # type: ignore[misc]
                assert str(error) == f"The command must have shape {(1, m)}, not {shape}."
            robot.step(self.stay(state))

    def test_command_that_is_not_finite_is_not_sent(self) -> None:
        """An error that names the robot; or, where it says so, it holds and the state tells what was sent."""
        n = self.sizes[-1]
        with self.running(n) as (robot, state):
            for bad in (math.nan, math.inf, -math.inf):
                command = self.stay(state)
                command[n - 1, 0] = bad
                if self.holds_what_is_not_finite:
                    assert np.isfinite(robot.step(command).command).all()
                else:
                    error = raised(InvalidValue, lambda command=command: robot.step(command))  # type: ignore[misc]
                    assert str(error) == f"The command must be finite numbers; those of environments [{n - 1}] are not."
                robot.step(self.stay(state))

    def test_states_and_commands_are_left_alone(self) -> None:
        """Later steps, halts and resets do not change a returned state or a sent command."""
        with self.running(self.sizes[-1]) as (robot, first):
            command = self.move(robot, first)
            second = robot.step(command)
            kept, sent = copy.deepcopy((first, second)), command.copy()
            robot.step(self.stay(second))
            robot.halt()
            last = np.array([self.sizes[-1] - 1])
            robot.reset(last, self.initial(robot, last))
            assert_same_state(first, kept[0])
            assert_same_state(second, kept[1])
            np.testing.assert_array_equal(command, sent)

    def test_environments_are_independent(self) -> None:
        """Moving and resetting robot 1 leaves robots 0 and 2 exactly as they would be."""
        if 3 not in self.sizes:
            raise SkipTest("these robots are not stepped three at a time")
        with self.running(3) as (robot, state), self.running(3) as (other, same):
            command = self.stay(state)
            command[1] = self.move(robot, state)[1]
            state, same = robot.step(command), other.step(self.stay(same))
            assert_same_state(state, same, [0, 2])
            state = robot.reset(np.array([1]), self.initial(robot, np.array([1])))
            assert_same_state(state, same, [0, 2])
            assert_same_state(robot.step(self.stay(state)), other.step(self.stay(same)), [0, 2])

    def test_halt_never_raises(self) -> None:
        """Before `connect`, twice, from another thread, after `close`."""
        robot = self.make(1)
        robot.halt()
        with self.running() as (running, state):
            with ThreadPoolExecutor(1) as other:
                for _ in range(2):
                    other.submit(running.halt).result()
            running.step(self.stay(state))
            running.halt()
        running.halt()

    def test_close_is_idempotent(self) -> None:
        """Before `connect` and twice; afterwards commands are refused, and it can be connected again."""
        robot = self.make(1)
        robot.close()
        with self.running() as (running, state):
            running.close()
            running.close()
            raised(BamEnvsError, lambda: running.step(self.stay(state)))
            running.connect()
            running.reset(np.arange(1), self.initial(running, np.arange(1)))


def _check_state(robot: Robot, state: RobotState) -> None:
    n, spec = robot.num_robots, robot.spec
    images = {name: box for camera in spec.cameras for name, box in camera.spaces().items()}
    assert list(state.signals) == [*(signal.name for signal in spec.signals), *images]
    for name, box in images.items():
        assert all(box.contains(image) for image in state.signals[name]), f"{name} is not in {box}"
    for signal in spec.signals:
        array = state.signals[signal.name]
        assert array.shape == (n, len(signal.labels)), f"{signal.name} has shape {array.shape}"
        assert array.dtype == np.float64, f"{signal.name} is {array.dtype}"
        assert np.isfinite(array).all(), f"{signal.name} is not finite"
    assert state.stamp.shape == (n,)
    assert state.command.shape == (n, len(spec.command.labels))
