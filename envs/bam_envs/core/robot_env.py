"""A Robot and a Task joined as a Gymnasium environment: `RobotEnv` for one, `RobotVectorEnv` for n stepped together.

They are in one file because they must agree: environment i of a `RobotVectorEnv` equals a `RobotEnv` with the
same seed, bit for bit.
"""

import copy
import math
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, ResetNeeded, UnknownName
from bam_envs.core.location import LiveRobot
from bam_envs.core.robot import EnvIds, Robot, RobotState
from bam_envs.core.spaces import indexed
from bam_envs.core.task import Label, Task, first_info, present
from bam_envs.core.wording import brief

RENDER_MODES = ["rgb_array", "human"]


def render_modes() -> list[str]:
    """The render modes of this machine: a window needs a display."""
    headless = sys.platform.startswith("linux") and not os.environ.keys() & {"DISPLAY", "WAYLAND_DISPLAY"}
    return ["rgb_array"] if headless else list(RENDER_MODES)


def describe(robot: Robot, task: Task) -> dict[str, list[dict[str, Any]]]:
    """Name, unit and limits of every number of observation, action, state and command; plain values.

    A missing limit is ``"inf"`` or ``"-inf"``, as in `bam_envs.core.spaces`: JSON has no infinities.
    """

    def described(label: Label) -> dict[str, Any]:
        row = asdict(label)
        return row | {side: str(row[side]) for side in ("low", "high") if math.isinf(row[side])}

    labels = {"observation": task.observation_labels, "action": task.action_labels}
    rows = {kind: [described(label) for label in group] for kind, group in labels.items()}
    return {**rows, **robot.spec.describe()}


class _RobotAndTask:
    """Base class of both environments.

    Args:
        robot: A robot with as many robots as the task has environments.
        task: The task.
        render_mode: ``"rgb_array"``, ``"human"`` or None.
    """

    def __init__(self, robot: Robot, task: Task, render_mode: str | None) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise InvalidValue(f"render_mode must be one of {RENDER_MODES} or None, not {render_mode!r}.")
        self.robot, self.task, self.render_mode = robot, task, render_mode
        self.metadata: dict[str, Any] = {"render_modes": render_modes(), "render_fps": round(1 / robot.spec.period)}
        self.state: RobotState | None = None
        """The last state, or None when no episode runs."""
        self.says_success: bool = getattr(task, "says_success", True)
        """Whether infos have ``is_success``; a task may not know what success is."""

    @property
    def period(self) -> float:
        """Time between two actions [s]."""
        return self.robot.spec.period

    def describe(self) -> dict[str, list[dict[str, Any]]]:
        """Name, unit and limits of every number of observation, action, state and command."""
        return describe(self.robot, self.task)

    def _begin(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], options: Mapping[str, Any]) -> RobotState:
        """Begin a new episode in the environments `env_ids`; returns the state of all environments."""
        sample: Any = self.task.sample_initial
        initial = sample(env_ids, rngs, options) if options else sample(env_ids, rngs)
        self.robot.connect()
        state = self.robot.reset(env_ids, initial)
        self.task.on_reset(env_ids, state)
        return state

    def _reset_options(self, options: object, extra: str | None = None) -> dict[str, Any]:
        """A copy of the options of `reset`; the task must know all of them except `extra`, the environment's option."""
        if options is not None and not isinstance(options, Mapping):
            raise InvalidValue(f"options= of reset must be a dict of names and values, not {brief(options)}.")
        checked, known = dict(options or {}), getattr(self.task, "reset_options", ())
        for name in checked:
            if name not in known and name != extra:
                raise UnknownName("reset option", name, known)
        return checked

    def _running(self) -> RobotState:
        if self.state is None:
            raise ResetNeeded("No episode is running: it ended, or never began. Call reset() first.")
        return self.state

    def _draw(self) -> NDArray[np.uint8] | None:
        """An image of the first environment, if the robot can draw one."""
        if self.render_mode is None:
            gym.logger.warn('render() without a render_mode shows nothing. Make it with render_mode="rgb_array".')
            return None
        draw, picture = getattr(self.robot, "render", None), getattr(self.task, "picture", None)
        if picture is not None and self.render_mode == "rgb_array":
            drawn: NDArray[np.uint8] = picture()
            return drawn
        if draw is None:
            other = "None" if picture is None else '"rgb_array"'
            name = f"The robot {self.robot.spec.name!r}" if picture is None else type(self.task).__name__
            what = "picture" if picture is None else "window"
            raise InvalidValue(f"{name} has no {what}; use render_mode={other}.")
        image: NDArray[np.uint8] | None = draw(self.render_mode, self.task.marks())
        return image


class RobotEnv(_RobotAndTask, gym.Env[Any, Any]):
    """One robot and one task. The robot is connected at the first `reset`.

    Args:
        robot: A robot with ``num_robots == 1``.
        task: A task of one environment.
        render_mode: ``"rgb_array"``, ``"human"`` or None.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 20}  # noqa: RUF012 - Gymnasium's attribute

    def __init__(self, robot: Robot, task: Task, render_mode: str | None = None) -> None:
        super().__init__(robot, task, render_mode)
        self.observation_space, self.action_space = task.observation_space, task.action_space
        self.last_state: RobotState | None = None
        """The newest state, kept after the end of an episode."""
        self._first = np.zeros(1, dtype=np.int64)
        self._observed: Any = None
        self._tell_step = getattr(robot, "tell_step", None)
        self._made_by: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How `gymnasium.make` made it, with the address of a `roslibpy.Ros`, which cannot be copied as wrappers do."""
        return self._made_by

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        robot: Any = None if spec is None else spec.kwargs.get("robot")
        ros = robot.url if isinstance(robot, LiveRobot) else robot
        if spec is not None and hasattr(ros, "factory"):
            spec, url = copy.copy(spec), ros.factory.url
            spec.kwargs = {**spec.kwargs, "robot": replace(robot, url=url) if isinstance(robot, LiveRobot) else url}
        self._made_by = spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; a live robot goes to its start pose slowly."""
        gym.Env.reset(self, seed=seed)
        task_options = self._reset_options(options)
        self.state = self.last_state = self._begin(self._first, [self.np_random], task_options)
        if self.render_mode == "human":
            self.render()
        self._observed = indexed(self.task.observe(self.state), 0)
        return self._observed, self._outcome(success=False)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Send the command of `action` (a,), or a whole number; observe and score one period later."""
        before = self._running()
        batch = checked_action(self.action_space, action)[None]
        state = self.robot.step(self.task.command(batch, before))
        score = self.task.score(state, batch)
        observation = indexed(self.task.observe(state), 0)
        terminated = bool(score.terminated[0])
        self.state, self.last_state = None if terminated else state, state
        if self._tell_step is not None:
            reward, success = float(score.reward[0]), bool(score.success[0])
            self._tell_step(self._observed, batch[0], reward, observation, terminated=terminated, success=success)
            self._observed = observation
        if self.render_mode == "human":
            self.render()
        info = self._outcome(success=bool(score.success[0])) | first_info(score)
        return observation, float(score.reward[0]), terminated, False, info

    def _outcome(self, *, success: bool) -> dict[str, Any]:
        """The success as an info, if the task knows what that is."""
        return {"is_success": success} if self.says_success else {}

    def state_dict(self) -> dict[str, Any]:
        """The complete state of a simulated robot, its task and its generator; plain arrays and values."""
        robot: Any = self.robot
        rng = self.np_random.bit_generator.state
        return {"robot": robot.state_dict(), "task": copy.deepcopy(self.task.state_dict()), "rng": rng}

    def load_state_dict(self, state: dict[str, Any]) -> Any:
        """Restore the result of `state_dict`; returns the observation."""
        robot: Any = self.robot
        self.state = self.last_state = robot.load_state_dict(state["robot"])
        self.task.load_state_dict(state["task"])
        self.np_random.bit_generator.state = state["rng"]
        self._observed = indexed(self.task.observe(self.state), 0)
        return self._observed

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """An image (480, 640, 3) for ``rgb_array``, None for ``human``."""
        return self._draw()

    def close(self) -> None:
        """Halt the robot and drop the link."""
        self.state = None
        self.robot.close()


def checked_action(space: gym.Space[Any], action: Any) -> NDArray[Any]:
    """`action` as an array that `space` can use: of its shape, and finite; whole numbers only inside it.

    Raises:
        InvalidValue: It cannot be used.
    """
    array = np.asarray(action)
    if array.shape != space.shape:
        raise InvalidValue(f"The action must have shape {space.shape}, not {array.shape}.")
    if isinstance(space, gym.spaces.Box):
        array = array.astype(np.float32, copy=False)
        if not all(map(math.isfinite, array.ravel().tolist())):
            raise InvalidValue(f"The action must be finite numbers, not {array.tolist()}.")
    elif array.dtype.kind not in "iu" or not space.contains(array.astype(space.dtype)[()]):
        raise InvalidValue(f"The action must be in {space}, not {array.tolist()}.")
    return array


class RobotVectorEnv(_RobotAndTask, gym.vector.VectorEnv[Any, Any, NDArray[Any]]):
    """n simulated robots stepped together; environment i equals a `RobotEnv` with the same seed, bit for bit.

    An environment whose episode ends starts the next one in the same step (`AutoresetMode.SAME_STEP`): its last
    observation and info are in ``infos["final_obs"]`` and ``infos["final_info"]``; its other infos are the new
    episode's.

    Args:
        robot: n robots.
        task: A task of n environments.
        max_episode_steps: Steps after which an episode is truncated; None for never.
        render_mode: ``"rgb_array"``, ``"human"`` or None; shows the first environment.
    """

    def __init__(
        self, robot: Robot, task: Task, max_episode_steps: int | None = None, render_mode: str | None = None
    ) -> None:
        super().__init__(robot, task, render_mode)
        self.metadata["autoreset_mode"] = AutoresetMode.SAME_STEP
        self.num_envs, self.max_episode_steps = robot.num_robots, max_episode_steps
        self.single_observation_space, self.single_action_space = task.observation_space, task.action_space
        self.observation_space = batch_space(task.observation_space, self.num_envs)
        self.action_space = batch_space(task.action_space, self.num_envs)
        self.elapsed = np.zeros(self.num_envs, dtype=np.int64)
        """Steps since each episode began. Shape: (n,)."""
        self._rngs = [np.random.default_rng() for _ in range(self.num_envs)]
        self._all = np.ones(self.num_envs, dtype=bool)
        self._says = np.full(self.num_envs, self.says_success)  # the mask of ``is_success``

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every environment, or in those of ``options["reset_mask"]`` (n,) bool.

        Args:
            seed: Environment i is seeded with ``seed + i``, or with ``seed[i]``.
            options: ``reset_mask``, and the task's ``reset_options``, equal for every environment.
        """
        task_options = self._reset_options(options, "reset_mask")
        mask = np.asarray(task_options.pop("reset_mask", self._all), dtype=bool)
        if mask.shape != self._all.shape:
            raise InvalidValue(f"reset_mask must have shape {self._all.shape}, not {mask.shape}.")
        for i, one in enumerate(self._seeds(seed)):
            if one is not None and mask[i]:
                self._rngs[i] = seeding.np_random(one)[0]
        observation = self._reset(np.flatnonzero(mask), task_options)
        return observation, {"is_success": np.zeros(self.num_envs, dtype=bool), "_is_success": self._says.copy()}

    def _seeds(self, seed: int | list[int | None] | None) -> Sequence[int | None]:
        if seed is None:
            return []
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, (int, np.integer)) else list(seed)
        if len(seeds) != self.num_envs:
            raise InvalidValue(f"seed must be one number or {self.num_envs} of them, not {len(seeds)}.")
        return seeds

    def _reset(self, env_ids: EnvIds, options: Mapping[str, Any]) -> Any:
        self.state = self._begin(env_ids, [self._rngs[i] for i in env_ids], options)
        self.elapsed[env_ids] = 0
        return self.task.observe(self.state)

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step every environment with `actions` (n, a); those whose episode ended begin the next one."""
        before = self._running()
        actions = self._checked(actions)
        self.state = self.robot.step(self.task.command(actions, before))
        score = self.task.score(self.state, actions)
        observation = self.task.observe(self.state)
        self.elapsed += 1
        limit = self.max_episode_steps
        truncated = np.zeros(self.num_envs, dtype=bool) if limit is None else self.elapsed >= limit
        infos = {"is_success": score.success, "_is_success": self._says.copy()}
        for key, value in score.info.items():
            infos[key], infos["_" + key] = value, present(value)
        ended = score.terminated | truncated
        if ended.any():
            observation = self._next_episodes(ended, observation, infos)
        return observation, score.reward, score.terminated, truncated, infos

    def rest(self, resting: NDArray[np.bool_]) -> None:
        """Leave robots of a mask (n,) as they are in the next steps, which nobody looks at, if that saves physics."""
        robot: Any = self.robot
        if hasattr(robot, "rest"):
            robot.rest(resting)

    def _next_episodes(self, ended: NDArray[np.bool_], observation: Any, infos: dict[str, Any]) -> Any:
        """Save the last observation and info of ended episodes in `infos`, and begin the next episodes."""
        values = {key: value for key, value in infos.items() if not key.startswith("_")}
        masks = {"_" + key: infos["_" + key] for key in values}
        infos |= {name: mask & ~ended for name, mask in masks.items()}  # `reset` gives no such info
        infos |= {"is_success": values["is_success"] & ~ended, "_is_success": self._says.copy()}
        infos["final_info"] = {**values, **{name: mask & ended for name, mask in masks.items()}}
        infos["final_obs"], infos["_final_obs"], infos["_final_info"] = observation, ended, ended
        return self._reset(np.flatnonzero(ended), {})

    def _checked(self, actions: Any) -> NDArray[Any]:
        array = np.asarray(actions)
        if array.shape != self.action_space.shape:
            raise InvalidValue(f"The actions must have shape {self.action_space.shape}, not {array.shape}.")
        if not isinstance(self.single_action_space, gym.spaces.Box):
            if array.dtype.kind not in "iu" or not self.action_space.contains(array.astype(self.action_space.dtype)):
                raise InvalidValue(f"The actions must be in {self.single_action_space}, not {brief(array.tolist())}.")
            return array
        array = array.astype(np.float32, copy=False)
        finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
        if not finite.all():
            wrong = np.flatnonzero(~finite).tolist()
            raise InvalidValue(f"The actions must be finite; those of environments {wrong} are not.")
        return array

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """A tuple with one image, of the first environment; None for ``human``. The others are not drawn."""
        image = self._draw()
        return None if image is None else (image,)

    def close_extras(self, **kwargs: Any) -> None:
        """Halt and close the robots."""
        self.state = None
        self.robot.close()

    def state_dict(self) -> dict[str, Any]:
        """The complete state: physics, task memory, generators, counters; plain arrays and values."""
        robot: Any = self.robot
        return {
            "robot": robot.state_dict(),
            "task": copy.deepcopy(self.task.state_dict()),
            "elapsed": self.elapsed.copy(),
            "rngs": [rng.bit_generator.state for rng in self._rngs],
        }

    def load_state_dict(self, state: dict[str, Any]) -> Any:
        """Restore the result of `state_dict`; returns the observation."""
        robot: Any = self.robot
        restored: RobotState = robot.load_state_dict(state["robot"])
        self.state = restored
        self.task.load_state_dict(state["task"])
        self.elapsed = np.array(state["elapsed"])
        for rng, rng_state in zip(self._rngs, state["rngs"], strict=True):
            rng.bit_generator.state = rng_state
        return self.task.observe(restored)


def robot_of(env: gym.Env[Any, Any]) -> Any:
    """The robot of a `RobotEnv`, behind any wrappers; None for another environment."""
    return getattr(env.unwrapped, "robot", None)


def halt_and_close(env: gym.Env[Any, Any]) -> None:
    """Halt the robot of `env`, if it has one, then close `env`, even if the halt fails."""
    try:
        if (robot := robot_of(env)) is not None:
            robot.halt()
    except Exception:  # not a second Ctrl-C, which quits at once: closing would halt again
        env.close()  # type: ignore[no-untyped-call]
        raise
    env.close()  # type: ignore[no-untyped-call]
