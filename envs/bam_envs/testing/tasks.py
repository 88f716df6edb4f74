"""The contract tests for your own tasks, with a robot and without one."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, iterate
from numpy.typing import NDArray

from bam_envs.core.robot import EnvIds, Robot, RobotState
from bam_envs.core.task import Task
from bam_envs.local.local_task import NoRobot
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.testing.assertions import assert_same_state, assert_same_value

Array = NDArray[np.float64]


class AnyTaskContract:
    """The contract of every task; inherit `TaskContract` or `LocalTaskContract`, which add to it."""

    steps = 60
    """Number of steps of each test."""

    def make(self, num_envs: int) -> Task:
        """Hook: a task for `num_envs` robots."""
        raise NotImplementedError("Override make(num_envs) to return the task under test.")

    def make_robot(self, num_robots: int) -> Robot:
        """Hook: robots for the task."""
        raise NotImplementedError("Override make_robot(num_robots) to return robots for the task.")

    def actions(self, task: Task, first: int = 0) -> Iterator[NDArray[Any]]:
        """Hook: random actions; environment k draws from its own generator, seeded ``first + k``. Shape: (n, ...)."""
        raise NotImplementedError("Override actions(task, first) to yield actions.")

    @contextmanager
    def running(self, num_envs: int = 1, seed: int = 0) -> Iterator[tuple[Task, Robot, RobotState]]:
        """A task at the start of an episode, its robot and the state; environment i is seeded ``seed + i``."""
        task, robot = self.make(num_envs), self.make_robot(num_envs)
        try:
            robot.connect()
            yield task, robot, _start(task, robot, np.arange(num_envs), seed)
        finally:
            robot.close()

    def test_observations_are_in_their_space(self) -> None:
        """One observation an environment, of its space's dtypes, finite, inside the limits."""
        with self.running(3) as (task, robot, state):
            for action in self.actions(task):
                observation = task.observe(state)
                assert batch_space(task.observation_space, task.num_envs).contains(observation)
                for env in self._each(task, state):
                    assert task.observation_space.contains(env), f"not in the space: {env}"
                state = robot.step(task.command(action, state))

    def test_scores_are_one_an_environment(self) -> None:
        """Finite float64 rewards, boolean ends, success ends the episode, infos of shape (n, ...)."""
        with self.running(3) as (task, robot, state):
            for action in self.actions(task):
                state = robot.step(task.command(action, state))
                score = task.score(state, action)
                assert score.reward.shape == score.terminated.shape == score.success.shape == (task.num_envs,)
                assert score.reward.dtype == np.float64
                assert np.isfinite(score.reward).all()
                assert score.terminated.dtype == score.success.dtype == np.bool_
                assert not (score.success & ~score.terminated).any(), "a success did not end the episode"
                for name, values in score.info.items():
                    assert values.shape[:1] == (task.num_envs,), f"info {name} has shape {values.shape}"
                    assert not name.startswith("_"), f"info {name} looks like a mask"

    def test_nothing_given_is_changed(self) -> None:
        """States and actions are not changed; observing twice returns the same."""
        with self.running(2) as (task, robot, state):
            for action in self.actions(task):
                kept, copied = copy.deepcopy(state), action.copy()
                assert_same_value(task.observe(state), task.observe(state), "observation")
                command = task.command(action, state)
                sent = command.copy()
                after = robot.step(command)
                task.score(after, action)
                assert_same_state(state, kept)
                np.testing.assert_array_equal(action, copied)
                np.testing.assert_array_equal(command, sent)
                state = after

    def test_one_of_many_is_the_one_alone(self) -> None:
        """Observation, command and score of environment i are bit for bit those of a single task with its seed."""
        many = self._record(3, first=0)
        for env in range(3):
            for together, alone in zip(many, self._record(1, first=env), strict=True):
                np.testing.assert_array_equal(together[env], alone[0])

    def _record(self, num_envs: int, first: int) -> list[NDArray[Any]]:
        """All results of an episode; environment k has the seed and the actions of ``first + k``."""
        results: list[NDArray[Any]] = []
        with self.running(num_envs, seed=first) as (task, robot, state):
            for action in self.actions(task, first):
                command = task.command(action, state)
                state = robot.step(command)
                score = task.score(state, action)
                observation = task.observe(state)
                results += list(observation.values()) if isinstance(observation, dict) else [observation]
                results += [command, score.reward, score.terminated, score.success]
        return results

    def test_resetting_one_leaves_the_others(self) -> None:
        """A new episode of environment 1 does not change 0 and 2."""
        with self.running(3) as (task, robot, state):
            for action in self.actions(task):
                state = robot.step(task.command(action, state))
            before = self._each(task, state)
            after = self._each(task, _start(task, robot, np.array([1]), seed=9))
            for env in (0, 2):
                assert_same_value(after[env], before[env], "observation")

    def _each(self, task: Task, state: RobotState) -> list[Any]:
        """The observation of each environment."""
        return list(iterate(batch_space(task.observation_space, task.num_envs), task.observe(state)))

    def test_seeds_decide(self) -> None:
        """The same seeds begin the same episodes."""
        with self.running(2, seed=5) as (task, _, state), self.running(2, seed=5) as (other, _, same):
            assert_same_value(task.observe(state), other.observe(same), "observation")
            assert_same_value(task.state_dict(), other.state_dict())

    def test_memory_is_saved_and_restored(self) -> None:
        """The result of `state_dict` does not change, and another task continues from it exactly."""
        with self.running(2) as (task, robot, state):
            actions = list(self.actions(task))
            for action in actions[: self.steps // 2]:
                state = robot.step(task.command(action, state))
                task.score(state, action)
            saved, kept = task.state_dict(), copy.deepcopy(task.state_dict())
            other = self.make(2)
            other.load_state_dict(copy.deepcopy(saved))
            for action in actions[self.steps // 2 :]:
                assert_same_value(task.observe(state), other.observe(state), "observation")
                command = task.command(action, state)
                np.testing.assert_array_equal(command, other.command(action, state))
                state = robot.step(command)
                assert_same_value(vars(task.score(state, action)), vars(other.score(state, action)), "score")
            assert_same_value(saved, kept)

    def test_handed_out_is_left_alone(self) -> None:
        """New episodes do not change observations, scores and memory that were returned."""
        for again in ([1], [0, 1]):
            with self.running(2) as (task, robot, state):
                for action in self.actions(task):
                    state = robot.step(task.command(action, state))
                    score = task.score(state, action)
                results = {"score": vars(score), "observation": task.observe(state), "memory": task.state_dict()}
                kept = copy.deepcopy(results)
                _start(task, robot, np.array(again), seed=9)
                assert_same_value(results, kept)

    def test_marks_are_places_and_colours(self) -> None:
        """The marks can be drawn."""
        with self.running() as (task, _, _):
            for position, colour in task.marks():
                assert np.shape(position) == (3,)
                assert len(colour) == 4


class TaskContract(AnyTaskContract):
    """The contract of a task with a robot: one-dimensional float32 spaces, and commands that keep its limits."""

    joint_step = 0.05
    """Maximum motion of a commanded joint in a period [rad]."""
    tool_step = 0.0125
    """Maximum motion of the commanded tool in a period [m]."""
    joints = 6
    """Number of joints of the arm, the first numbers of a command."""

    def make_robot(self, num_robots: int) -> Robot:
        """Hook: robots for the task."""
        return FakeRobot(num_robots)

    def tool_position(self, joints: Array) -> Array:
        """Hook: forward kinematics, (n, joints) [rad] -> (n, 3) [m]; that of a UR5e."""
        return GEOMETRY.tool_position(joints)

    def actions(self, task: Task, first: int = 0) -> Iterator[NDArray[np.float32]]:
        """Random actions, at the limits or inside, each kept for ten steps. Shape: (n, a) each.

        Environment k draws from its own generator, seeded ``first + k``.
        """
        rngs = [np.random.default_rng(first + env) for env in range(task.num_envs)]
        for step in range(self.steps):
            if step % 10 == 0:
                action = np.array([rng.uniform(-1, 1, task.action_space.shape) for rng in rngs], np.float32)
                action = np.sign(action) if step % 20 == 0 else action
            yield action

    def test_spaces_have_a_label_for_each_number(self) -> None:
        """One-dimensional float32 boxes; names differ; the limits are those of the labels. Images have a label each."""
        task = self.make(2)
        assert isinstance(task, Task), f"{type(task).__name__} lacks a member of the Task protocol"
        assert task.num_envs == 2
        seen, images = task.observation_space, dict[str, spaces.Space[Any]]()
        if isinstance(seen, spaces.Dict):
            images = {name: one for name, one in seen.items() if len(one.shape or ()) == 3}
            (seen,) = (one for name, one in seen.items() if name not in images)
        assert images.keys() <= {label.name for label in task.observation_labels}
        numbers = tuple(label for label in task.observation_labels if label.name not in images)
        for space, labels in ((seen, numbers), (task.action_space, task.action_labels)):
            assert isinstance(space, spaces.Box)
            assert space.dtype == np.float32
            assert space.shape == (len(labels),), f"{len(labels)} labels for a space of shape {space.shape}"
            assert len({label.name for label in labels}) == len(labels), "label names repeat"
            np.testing.assert_array_equal(space.low, np.array([label.low for label in labels], np.float32))
            np.testing.assert_array_equal(space.high, np.array([label.high for label in labels], np.float32))
            if labels is task.action_labels:
                assert space.low.tolist() == [-1] * len(labels)
                assert space.high.tolist() == [1] * len(labels)

    def test_commands_keep_the_robots_limits(self) -> None:
        """Inside the command's limits; no joint and no tool faster than allowed, from the first command on."""
        with self.running(3) as (task, robot, state):
            last, spec = self.first_command(state), robot.spec.command
            for action in self.actions(task):
                command = task.command(action, state)
                assert command.shape == (robot.num_robots, len(spec.labels))
                assert command.dtype == np.float64
                assert (command >= np.array(spec.low)).all()
                assert (command <= np.array(spec.high)).all()
                self.check_pace(last, command)
                state, last = robot.step(command), command

    def first_command(self, state: RobotState) -> Array:
        """Hook: the command before the first one, for `check_pace`. Shape: (n, m), or of its first numbers."""
        return state.signals["joint_position"]

    def check_pace(self, last: Array, command: Array) -> None:
        """Hook: assert that the step from `last` to `command`, both (n, m), is allowed in a period."""
        last, command = last[:, : self.joints], command[:, : self.joints]
        turn = np.abs(command - last).max()
        assert turn <= self.joint_step * (1 + 1e-9), f"a joint turned {turn} rad in a period"
        tool = np.linalg.norm(self.tool_position(command) - self.tool_position(last), axis=1).max()
        assert tool <= self.tool_step * (1 + 1e-9), f"the tool went {tool} m in a period"

    def test_actions_beyond_the_space_are_cut(self) -> None:
        """An action of 100 has the effect of 1."""
        with self.running() as (task, _, state), self.running() as (other, _, same):
            action = np.ones((1, *(task.action_space.shape or ())), np.float32)
            np.testing.assert_array_equal(task.command(100 * action, state), other.command(action, same))


class LocalTaskContract(AnyTaskContract):
    """The contract of a task without a robot: whole numbers as actions, and any observation that is made of arrays."""

    def make_robot(self, num_robots: int) -> Robot:
        """The robots of an environment that has none."""
        return NoRobot(num_robots)

    def actions(self, task: Task, first: int = 0) -> Iterator[NDArray[np.int64]]:
        """Random actions, a new one for each step."""
        rngs = [np.random.default_rng(first + env) for env in range(task.num_envs)]
        end: Any = getattr(task.action_space, "nvec", getattr(task.action_space, "n", None))
        for _ in range(self.steps):
            yield np.array([rng.integers(end) for rng in rngs])

    def test_labels_and_actions(self) -> None:
        """Names differ; actions are whole numbers from 0, one label for each, with its limits."""
        task = self.make(2)
        assert isinstance(task, Task), f"{type(task).__name__} lacks a member of the Task protocol"
        assert task.num_envs == 2
        assert isinstance(task.action_space, (spaces.Discrete, spaces.MultiDiscrete))
        ends = np.atleast_1d(getattr(task.action_space, "nvec", getattr(task.action_space, "n", 0)))
        assert [(label.low, label.high) for label in task.action_labels] == [(0, end - 1) for end in ends]
        for labels in (task.observation_labels, task.action_labels):
            assert len({label.name for label in labels}) == len(labels), "label names repeat"

    def test_pictures(self) -> None:
        """A picture is (h, w, 3) uint8, shows something, and changes nothing."""
        with self.running(2) as (task, _, state):
            draw = getattr(task, "picture", None)
            if draw is None:
                return
            kept, picture = task.observe(state), draw()
            assert (picture.dtype, picture.ndim, picture.shape[-1]) == (np.uint8, 3, 3)
            assert picture.min() < picture.max()
            assert_same_value(task.observe(state), kept, "observation")


def _start(task: Task, robot: Robot, env_ids: EnvIds, seed: int) -> RobotState:
    """Begin an episode in these environments; the k-th of them is seeded ``seed + k``."""
    state = robot.reset(
        env_ids, task.sample_initial(env_ids, [np.random.default_rng(seed + k) for k in range(len(env_ids))])
    )
    task.on_reset(env_ids, state)
    return state
