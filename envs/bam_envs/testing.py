"""Contract tests for robots and tasks of one's own: inherit, say how to make one, run pytest.

::

    from bam_envs.testing import RobotContract, TaskContract

    class TestMyRobot(RobotContract):
        def make(self, num_robots):
            return MyRobot(num_robots)

    class TestMyTask(TaskContract):
        def make(self, num_rows):
            return MyTask(num_rows)

They need nothing but NumPy and Gymnasium, and hold for arms with the signals of `bam_envs.robots.ur5e`; for another
robot, override the hooks that name an arm. Longer than other modules because both contracts are one list of promises.
"""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.errors import BamEnvsError, InvalidValue
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.robot import Initial, Robot, RobotSpec, RobotState, Rows, SignalSpec
from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.tasks.task import Score, Task

Array = NDArray[np.float64]
ARM_HOME = np.array([-0.27, -1.54, 1.89, -1.93, -1.57, -1.84])
"""Joint positions with the tool of a UR5e above the table [rad]."""


class RobotContract:
    """What every robot promises; each test makes a robot of its own and closes it."""

    still = 0.01
    """Farthest a joint that was told to stay may move in a period [rad]."""

    def make(self, num_robots: int) -> Robot:
        """Hook: a robot that is not connected."""
        raise NotImplementedError("Override make(num_robots) to return the robot under test.")

    def initial(self, robot: Robot, rows: Rows) -> Initial:
        """Hook: where an episode may start."""
        seeds = np.arange(len(rows), dtype=np.int64)
        pose = np.tile([0.5, 0.1, 0.3], (len(rows), 1))
        return Initial({"joint_position": np.tile(ARM_HOME, (len(rows), 1)), "object_pose": pose}, seeds)

    def stay(self, state: RobotState) -> Array:
        """Hook: the command that keeps every joint where it is. Shape: (n, m)."""
        return np.array(state.command)

    def move(self, robot: Robot, state: RobotState) -> Array:
        """Hook: a command a little away from where the robot is. Shape: (n, m)."""
        rate = np.array(robot.spec.command.max_rate or [1.0] * len(robot.spec.command.labels))
        return self.stay(state) - 0.1 * rate * robot.spec.period

    @contextmanager
    def running(self, num_robots: int = 1) -> Iterator[tuple[Robot, RobotState]]:
        """A connected robot that was reset, and its state."""
        robot = self.make(num_robots)
        try:
            robot.connect()
            rows = np.arange(num_robots)
            yield robot, robot.reset(rows, self.initial(robot, rows))
        finally:
            robot.close()

    def test_constructor_does_no_io(self) -> None:
        """No file, socket or thread; the spec is there before `connect`."""
        with _no_io():
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
            _check_signal(signal)
        assert spec.command.max_rate is not None, "the command needs a max_rate"

    def test_step_before_connect_is_refused(self) -> None:
        """An error of ours, not an AttributeError."""
        robot = self.make(1)
        error = _raised(BamEnvsError, lambda: robot.step(np.zeros((1, len(robot.spec.command.labels)))))
        assert str(error), "the error has no text"

    def test_connect_twice_is_once_and_moves_nothing(self) -> None:
        """A robot that was connected again is where it was."""
        with self.running() as (robot, before):
            robot.connect()
            after = robot.step(self.stay(before))
            moved = np.abs(after.signals["joint_position"] - before.signals["joint_position"]).max()
            assert moved <= self.still, f"connect() moved a joint by {moved} rad"

    def test_states_are_what_the_spec_says(self) -> None:
        """Names in the spec's order, shape (n, k), finite float64, one stamp and one command a row."""
        for n in (1, 3):
            with self.running(n) as (robot, state):
                _check_state(robot, state)
                _check_state(robot, robot.step(self.move(robot, state)))

    def test_stamps_go_on(self) -> None:
        """Time never stands still."""
        with self.running() as (robot, first):
            second = robot.step(self.stay(first))
            assert (second.stamp > first.stamp).all()

    def test_state_has_the_command_that_was_sent(self) -> None:
        """So that it can be recorded."""
        with self.running(2) as (robot, state):
            command = self.move(robot, state)
            np.testing.assert_array_equal(robot.step(command).command, command)

    def test_it_goes_where_it_is_told(self) -> None:
        """Half a second after a small step, it is closer to there than it was."""
        with self.running() as (robot, state):
            command, start = self.move(robot, state), state.signals["joint_position"]
            for _ in range(math.ceil(0.5 / robot.spec.period)):
                state = robot.step(command)
            before = np.abs(command[:, : start.shape[1]] - start)
            after = np.abs(command[:, : start.shape[1]] - state.signals["joint_position"])
            assert (after < before).all(), f"left to go: {after} rad, at first {before} rad"

    def test_command_of_another_shape_is_refused(self) -> None:
        """By name, with what was expected and found; the robot goes on."""
        with self.running() as (robot, state):
            m = len(robot.spec.command.labels)
            for shape in ((m,), (1, m + 1), (2, m)):
                error = _raised(InvalidValue, lambda shape=shape: robot.step(np.zeros(shape)))  # type: ignore[misc]
                assert str(error) == f"The command must have shape {(1, m)}, not {shape}."
            robot.step(self.stay(state))

    def test_command_that_is_not_finite_is_refused(self) -> None:
        """And names the row."""
        with self.running(2) as (robot, state):
            for bad in (math.nan, math.inf, -math.inf):
                command = self.stay(state)
                command[1, 0] = bad
                error = _raised(InvalidValue, lambda command=command: robot.step(command))  # type: ignore[misc]
                assert str(error) == "The command must be finite numbers; those of rows [1] are not."
            robot.step(self.stay(state))

    def test_states_and_commands_are_left_alone(self) -> None:
        """Later steps, halts and resets do not change a state that was handed out, nor a command that was given."""
        with self.running(2) as (robot, first):
            command = self.move(robot, first)
            second = robot.step(command)
            kept, sent = copy.deepcopy((first, second)), command.copy()
            robot.step(self.stay(second))
            robot.halt()
            robot.reset(np.array([1]), self.initial(robot, np.array([1])))
            _assert_same_state(first, kept[0])
            _assert_same_state(second, kept[1])
            np.testing.assert_array_equal(command, sent)

    def test_rows_are_independent(self) -> None:
        """Moving and resetting row 1 leaves rows 0 and 2 exactly as they would be."""
        with self.running(3) as (robot, state), self.running(3) as (other, same):
            command = self.stay(state)
            command[1] = self.move(robot, state)[1]
            state, same = robot.step(command), other.step(self.stay(same))
            _assert_same_rows(state, same, [0, 2])
            state = robot.reset(np.array([1]), self.initial(robot, np.array([1])))
            _assert_same_rows(state, same, [0, 2])
            _assert_same_rows(robot.step(self.stay(state)), other.step(self.stay(same)), [0, 2])

    def test_halt_never_raises(self) -> None:
        """Before `connect`, twice, from another thread, after `close`."""
        robot = self.make(1)
        robot.halt()
        with self.running() as (running, state):
            for _ in range(2):
                _in_thread(running.halt)
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
            _raised(BamEnvsError, lambda: running.step(self.stay(state)))
            running.connect()
            running.reset(np.arange(1), self.initial(running, np.arange(1)))


class TaskContract:
    """What every task promises, on robots that `make_robot` makes."""

    joint_step = 0.05
    """Farthest a commanded joint may go in a period [rad]."""
    tool_step = 0.0125
    """Farthest the commanded tool may go in a period [m]."""
    steps = 60
    """How long each test runs."""

    def make(self, num_rows: int) -> Task:
        """Hook: a task for `num_rows` robots."""
        raise NotImplementedError("Override make(num_rows) to return the task under test.")

    def make_robot(self, num_robots: int) -> Robot:
        """Hook: robots for the task."""
        return FakeRobot(num_robots)

    def tool_position(self, joints: Array) -> Array:
        """Hook: forward kinematics, (n, 6) [rad] -> (n, 3) [m]."""
        return GEOMETRY.tool_position(joints)

    @contextmanager
    def running(self, num_rows: int = 1, seed: int = 0) -> Iterator[tuple[Task, Robot, RobotState]]:
        """A task at the start of an episode, its robot and the state; row i is seeded ``seed + i``."""
        task, robot = self.make(num_rows), self.make_robot(num_rows)
        try:
            robot.connect()
            yield task, robot, _start(task, robot, np.arange(num_rows), seed)
        finally:
            robot.close()

    def actions(self, task: Task, first: int = 0) -> Iterator[NDArray[np.float32]]:
        """Actions of rows `first` and on. Shape: (n, a) each."""
        rows = [self.actions_of_row(task, first + row) for row in range(task.num_rows)]
        return map(np.stack, zip(*rows, strict=True))

    def actions_of_row(self, task: Task, row: int) -> Iterator[NDArray[np.float32]]:
        """Random actions, to the limit or inside, each kept for ten steps to get somewhere. Shape: (a,) each."""
        rng = np.random.default_rng(row)
        for step in range(self.steps):
            if step % 10 == 0:
                action = rng.uniform(-1, 1, task.action_space.shape).astype(np.float32)
                action = np.sign(action) if step % 20 == 0 else action
            yield action

    def test_spaces_have_a_label_for_each_number(self) -> None:
        """One-dimensional float32 boxes; names differ; the limits are those of the labels."""
        task = self.make(2)
        assert isinstance(task, Task), f"{type(task).__name__} lacks a member of the Task protocol"
        assert task.num_rows == 2
        for space, labels in (
            (task.observation_space, task.observation_labels),
            (task.action_space, task.action_labels),
        ):
            assert isinstance(space, spaces.Box)
            assert space.dtype == np.float32
            assert space.shape == (len(labels),), f"{len(labels)} labels for a space of shape {space.shape}"
            assert len({label.name for label in labels}) == len(labels), "label names repeat"
            np.testing.assert_array_equal(space.low, np.array([label.low for label in labels], np.float32))
            np.testing.assert_array_equal(space.high, np.array([label.high for label in labels], np.float32))
        assert (task.action_space.low == -1).all()
        assert (task.action_space.high == 1).all()

    def test_observations_are_in_their_space(self) -> None:
        """Float32, one row a robot, finite, inside the limits."""
        with self.running(3) as (task, robot, state):
            for action in self.actions(task):
                _check_observation(task, task.observe(state))
                state = robot.step(task.command(action, state))

    def test_commands_keep_the_robots_limits(self) -> None:
        """Inside the command's limits; no joint and no tool faster than allowed, from the first command on."""
        with self.running(3) as (task, robot, state):
            last = state.signals["joint_position"]
            for action in self.actions(task):
                command = task.command(action, state)
                self._check_command(robot, last, command)
                state, last = robot.step(command), command[:, :6]

    def _check_command(self, robot: Robot, last: Array, command: Array) -> None:
        spec = robot.spec.command
        assert command.shape == (robot.num_robots, len(spec.labels))
        assert command.dtype == np.float64
        assert (command >= np.array(spec.low)).all()
        assert (command <= np.array(spec.high)).all()
        turn = np.abs(command[:, :6] - last).max()
        assert turn <= self.joint_step * (1 + 1e-9), f"a joint turned {turn} rad in a period"
        tool = np.linalg.norm(self.tool_position(command[:, :6]) - self.tool_position(last), axis=1).max()
        assert tool <= self.tool_step * (1 + 1e-9), f"the tool went {tool} m in a period"

    def test_actions_beyond_the_space_are_cut(self) -> None:
        """An action of 100 does what 1 does."""
        with self.running() as (task, _, state), self.running() as (other, _, same):
            action = np.ones((1, *task.action_space.shape), np.float32)
            np.testing.assert_array_equal(task.command(100 * action, state), other.command(action, same))

    def test_scores_are_one_a_row(self) -> None:
        """Finite float64 rewards, boolean ends, success ends the episode, infos of shape (n,)."""
        with self.running(3) as (task, robot, state):
            for action in self.actions(task):
                state = robot.step(task.command(action, state))
                _check_score(task, task.score(state, action))

    def test_nothing_given_is_changed(self) -> None:
        """States and actions are the caller's; observing twice is seeing the same."""
        with self.running(2) as (task, robot, state):
            for action in self.actions(task):
                kept, given = copy.deepcopy(state), action.copy()
                np.testing.assert_array_equal(task.observe(state), task.observe(state))
                command = task.command(action, state)
                sent = command.copy()
                after = robot.step(command)
                task.score(after, action)
                _assert_same_state(state, kept)
                np.testing.assert_array_equal(action, given)
                np.testing.assert_array_equal(command, sent)
                state = after

    def test_row_of_many_is_the_row_alone(self) -> None:
        """Observation, command and score of row i are bit for bit those of a single task with its seed."""
        many = self._record(3, first=0)
        for row in range(3):
            for together, alone in zip(many, self._record(1, first=row), strict=True):
                np.testing.assert_array_equal(together[row], alone[0])

    def _record(self, num_rows: int, first: int) -> list[NDArray[Any]]:
        """Everything that `num_rows` rows say in an episode; row k has the seed and the actions of ``first + k``."""
        said: list[NDArray[Any]] = []
        with self.running(num_rows, seed=first) as (task, robot, state):
            for action in self.actions(task, first):
                command = task.command(action, state)
                state = robot.step(command)
                score = task.score(state, action)
                said += [command, task.observe(state), score.reward, score.terminated, score.success]
        return said

    def test_beginning_one_row_leaves_the_others(self) -> None:
        """A new episode of row 1 changes nothing of rows 0 and 2."""
        with self.running(3) as (task, robot, state):
            for action in self.actions(task):
                state = robot.step(task.command(action, state))
            before = task.observe(state)
            state = _start(task, robot, np.array([1]), seed=9)
            np.testing.assert_array_equal(task.observe(state)[[0, 2]], before[[0, 2]])

    def test_begin_follows_the_generators(self) -> None:
        """The same seeds begin the same episodes."""
        with self.running(2, seed=5) as (task, _, state), self.running(2, seed=5) as (other, _, same):
            np.testing.assert_array_equal(task.observe(state), other.observe(same))
            _assert_same_tree(task.state_dict(), other.state_dict())

    def test_memory_is_saved_and_restored(self) -> None:
        """What `state_dict` returned stays as it was, and another task goes on from it exactly."""
        with self.running(2) as (task, robot, state):
            actions = list(self.actions(task))
            for action in actions[: self.steps // 2]:
                state = robot.step(task.command(action, state))
                task.score(state, action)
            saved, kept = task.state_dict(), copy.deepcopy(task.state_dict())
            other = self.make(2)
            other.load_state_dict(copy.deepcopy(saved))
            for action in actions[self.steps // 2 :]:
                np.testing.assert_array_equal(task.observe(state), other.observe(state))
                command = task.command(action, state)
                np.testing.assert_array_equal(command, other.command(action, state))
                state = robot.step(command)
                _assert_same_score(task.score(state, action), other.score(state, action))
            _assert_same_tree(saved, kept)

    def test_saved_memory_is_a_copy(self) -> None:
        """Beginning another episode right after `state_dict` does not reach into what it returned."""
        with self.running(2) as (task, robot, state):
            for action in self.actions(task):
                state = robot.step(task.command(action, state))
            saved = task.state_dict()
            kept = copy.deepcopy(saved)
            _start(task, robot, np.array([1]), seed=9)
            _assert_same_tree(saved, kept)

    def test_marks_are_places_and_colours(self) -> None:
        """For pictures."""
        with self.running() as (task, _, _):
            for position, colour in task.marks():
                assert np.shape(position) == (3,)
                assert len(colour) == 4


def _start(task: Task, robot: Robot, rows: Rows, seed: int) -> RobotState:
    """Begin an episode on `rows`; row k of them is seeded ``seed + k``."""
    state = robot.reset(rows, task.begin(rows, [np.random.default_rng(seed + k) for k in range(len(rows))]))
    task.start(rows, state)
    return state


@contextmanager
def _no_io() -> Iterator[None]:
    """Files, sockets, processes and threads are refused inside."""
    names = ("builtins.open", "socket.socket.connect", "threading.Thread.start", "subprocess.Popen")
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(mock.patch(name, side_effect=AssertionError(f"the constructor used {name}")))
        yield


def _raised(kind: type[Exception], act: Callable[[], Any]) -> Exception:
    """The exception of `kind` that `act` raises."""
    try:
        act()
    except kind as error:
        return error
    raise AssertionError(f"{kind.__name__} was not raised")


def _in_thread(act: Callable[[], None]) -> None:
    """Run `act` in another thread; it must not raise."""
    errors: list[BaseException] = []

    def run() -> None:
        try:
            act()
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert not errors, f"raised in another thread: {errors[0]!r}"


def _check_signal(signal: SignalSpec) -> None:
    size = len(signal.labels)
    assert size > 0, f"{signal.name} has no labels"
    assert len(signal.units) == len(signal.low) == len(signal.high) == size, f"lengths of {signal.name} differ"
    assert len(set(signal.labels)) == size, f"labels of {signal.name} repeat"
    assert all(low < high for low, high in zip(signal.low, signal.high, strict=True)), f"limits of {signal.name}"
    assert signal.max_rate is None or len(signal.max_rate) == size, f"max_rate of {signal.name}"


def _check_state(robot: Robot, state: RobotState) -> None:
    n, spec = robot.num_robots, robot.spec
    assert list(state.signals) == [signal.name for signal in spec.signals]
    for signal in spec.signals:
        array = state.signals[signal.name]
        assert array.shape == (n, len(signal.labels)), f"{signal.name} has shape {array.shape}"
        assert array.dtype == np.float64, f"{signal.name} is {array.dtype}"
        assert np.isfinite(array).all(), f"{signal.name} is not finite"
    assert state.stamp.shape == (n,)
    assert state.command.shape == (n, len(spec.command.labels))


def _check_observation(task: Task, observation: NDArray[np.float32]) -> None:
    assert observation.dtype == np.float32
    assert observation.shape == (task.num_rows, *task.observation_space.shape)
    for row in observation:
        assert task.observation_space.contains(row), f"not in the space: {row.tolist()}"


def _check_score(task: Task, score: Score) -> None:
    n = task.num_rows
    assert score.reward.shape == score.terminated.shape == score.success.shape == (n,)
    assert score.reward.dtype == np.float64
    assert np.isfinite(score.reward).all()
    assert score.terminated.dtype == score.success.dtype == np.bool_
    assert not (score.success & ~score.terminated).any(), "a success did not end the episode"
    for name, values in score.info.items():
        assert values.shape == (n,), f"info {name} has shape {values.shape}"
        assert not name.startswith("_"), f"info {name} looks like a mask"


def _assert_same_state(one: RobotState, two: RobotState) -> None:
    _assert_same_rows(one, two, list(range(len(one.stamp))))


def _assert_same_rows(one: RobotState, two: RobotState, rows: list[int]) -> None:
    assert list(one.signals) == list(two.signals)
    for name, array in one.signals.items():
        np.testing.assert_array_equal(array[rows], two.signals[name][rows], err_msg=name)
    np.testing.assert_array_equal(one.stamp[rows], two.stamp[rows], err_msg="stamp")
    np.testing.assert_array_equal(one.command[rows], two.command[rows], err_msg="command")


def _assert_same_score(one: Score, two: Score) -> None:
    for name in ("reward", "terminated", "success"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)
    _assert_same_tree(one.info, two.info)


def _assert_same_tree(one: Any, two: Any, name: str = "state_dict") -> None:
    """Nested dicts, lists, arrays and plain values are equal."""
    assert type(one) is type(two), f"{name}: {type(one).__name__} and {type(two).__name__}"
    if isinstance(one, dict):
        assert list(one) == list(two), f"{name}: keys {list(one)} and {list(two)}"
        for key, value in one.items():
            _assert_same_tree(value, two[key], f"{name}[{key!r}]")
    else:
        np.testing.assert_array_equal(one, two, err_msg=name)
