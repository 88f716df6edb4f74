"""A Robot and a Task joined as a Gymnasium environment: `RobotEnv` for one, `RobotVectorEnv` for n stepped together.

Longer than most files here: the two stand side by side because they must agree row by row.
"""

from __future__ import annotations

import copy
import math
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, ResetNeeded, UnknownName
from bam_envs.core.robot import Robot, RobotState, Rows
from bam_envs.core.task import Label, Score, Task

RENDER_MODES = ["rgb_array", "human"]


def render_modes() -> list[str]:
    """The render modes of this machine: a window needs a display."""
    headless = sys.platform.startswith("linux") and not os.environ.keys() & {"DISPLAY", "WAYLAND_DISPLAY"}
    return ["rgb_array"] if headless else list(RENDER_MODES)


def start_rows(
    robot: Robot,
    task: Task,
    rows: Rows,
    rngs: Sequence[np.random.Generator],
    options: Mapping[str, Any] | None = None,
) -> RobotState:
    """Begin a new episode on `rows`; the state of all rows."""
    sample: Any = task.sample_initial
    initial = sample(rows, rngs, options) if options else sample(rows, rngs)
    robot.connect()
    state = robot.reset(rows, initial)
    task.on_reset(rows, state)
    return state


def require_table(options: object) -> None:
    """Refuse options of `reset` that are no dict.

    Raises:
        InvalidValue: They are not.
    """
    if options is not None and not isinstance(options, Mapping):
        raise InvalidValue(f"options= of reset must be a dict of names and values, not {options!r}.")


def task_options(task: Task, options: Mapping[str, Any] | None) -> dict[str, Any]:
    """What `reset` was given for the task.

    Raises:
        UnknownName: The task has no such option; it carries the closest match.
        InvalidValue: It was given no table of options.
    """
    require_table(options)
    known: Sequence[str] = getattr(task, "reset_options", ())
    for name in options or {}:
        if name not in known:
            raise UnknownName("reset option", name, known)
    return dict(options or {})


def describe(robot: Robot, task: Task) -> dict[str, list[dict[str, Any]]]:
    """What every number of observation, action, state and command means: name, unit, limits; plain values.

    No limit is ``"inf"`` or ``"-inf"``, as in `bam_envs.core.spaces`: JSON has no infinities.
    """
    labels = {"observation": task.observation_labels, "action": task.action_labels}
    rows = {kind: [_described(label) for label in group] for kind, group in labels.items()}
    return {**rows, **robot.spec.describe()}


def _described(label: Label) -> dict[str, Any]:
    row = asdict(label)
    return row | {side: str(row[side]) for side in ("low", "high") if math.isinf(row[side])}


def render(robot: Robot, task: Task, mode: str | None) -> NDArray[np.uint8] | None:
    """Picture of row 0, by robots that have one."""
    if mode is None:
        gym.logger.warn('render() without a render_mode shows nothing. Make it with render_mode="rgb_array".')
        return None
    draw = getattr(robot, "render", None)
    if draw is None:
        raise InvalidValue(f"The robot {robot.spec.name!r} has no picture; use render_mode=None.")
    image: NDArray[np.uint8] | None = draw(mode, task.marks())
    return image


def check_render_mode(mode: str | None) -> None:
    """Refuse a render mode that does not exist."""
    if mode is not None and mode not in RENDER_MODES:
        raise InvalidValue(f"render_mode must be one of {RENDER_MODES} or None, not {mode!r}.")


class RobotEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One robot and one task. The robot is connected at the first `reset`.

    Args:
        robot: A robot with ``num_robots == 1``.
        task: A task with ``num_rows == 1``.
        render_mode: ``"rgb_array"``, ``"human"`` or None.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 20}  # noqa: RUF012 - Gymnasium's attribute

    def __init__(self, robot: Robot, task: Task, render_mode: str | None = None) -> None:
        check_render_mode(render_mode)
        self.robot, self.task, self.render_mode = robot, task, render_mode
        self.observation_space, self.action_space = task.observation_space, task.action_space
        self.metadata = {"render_modes": render_modes(), "render_fps": round(1 / robot.spec.period)}
        self.state: RobotState | None = None
        """The last state, or None when no episode runs."""
        self.last_state: RobotState | None = None
        """The newest state there was, also when the episode that it ended is over."""
        self._first = np.zeros(1, dtype=np.int64)

    @property
    def period(self) -> float:
        """Time between two actions [s]."""
        return self.robot.spec.period

    def describe(self) -> dict[str, list[dict[str, Any]]]:
        """What every number of observation, action, state and command means."""
        return describe(self.robot, self.task)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; a live robot goes to its start pose slowly."""
        super().reset(seed=seed)
        given = task_options(self.task, options)
        self.state = self.last_state = start_rows(self.robot, self.task, self._first, [self.np_random], given)
        if self.render_mode == "human":
            self.render()
        return self.task.observe(self.state)[0], {"is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Send the command of `action`; one period later, observe and score."""
        if self.state is None:
            raise ResetNeeded("No episode is running: it ended, or never began. Call reset() first.")
        batch = self._checked(action)[None]
        state = self.robot.step(self.task.command(batch, self.state))
        score = self.task.score(state, batch)
        observation = self.task.observe(state)[0]
        terminated = bool(score.terminated[0])
        self.state, self.last_state = None if terminated else state, state
        if self.render_mode == "human":
            self.render()
        return observation, float(score.reward[0]), terminated, False, plain_info(score)

    def _checked(self, action: Any) -> NDArray[np.float32]:
        array = np.asarray(action, dtype=np.float32)
        if array.shape != self.action_space.shape:
            raise InvalidValue(f"The action must have shape {self.action_space.shape}, not {array.shape}.")
        if not np.isfinite(array).all():
            raise InvalidValue(f"The action must be finite numbers, not {array.tolist()}.")
        return array

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """An image (480, 640, 3) for ``rgb_array``, None for ``human``."""
        return render(self.robot, self.task, self.render_mode)

    def close(self) -> None:
        """Halt the robot and drop the link."""
        self.state = None
        self.robot.close()


def plain_info(score: Score) -> dict[str, Any]:
    """The info of row 0 in plain Python values."""
    said = {key: _plain(value[0]) for key, value in score.info.items()}
    return {"is_success": bool(score.success[0]), **{key: value for key, value in said.items() if not _is_empty(value)}}


def _is_empty(value: Any) -> bool:
    return isinstance(value, str) and value == ""


def _said(value: NDArray[Any]) -> NDArray[np.bool_]:
    """Of which rows an info says something: an empty text says nothing. Shape: (n,)."""
    if value.dtype.kind in "US":
        said: NDArray[np.bool_] = value != ""
        return said
    return np.array([not _is_empty(one) for one in value]) if value.dtype.kind == "O" else np.ones(len(value), bool)


def _plain(value: Any) -> Any:
    """Text as str, one number as float, several as an array of their own, objects as they are."""
    if isinstance(value, str):
        return str(value)
    if isinstance(value, np.ndarray):
        return value.tolist() if value.dtype.kind in "US" else value.copy()
    return float(value) if isinstance(value, np.generic) else value


class RobotVectorEnv(gym.vector.VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """n simulated robots stepped together; row i equals a `RobotEnv` with the same seed, bit for bit.

    A row whose episode ends starts the next one in the same step (`AutoresetMode.SAME_STEP`): its last observation
    and info are in ``infos["final_obs"]`` and ``infos["final_info"]``; the other infos of that row are the new
    episode's.

    Args:
        robot: A robot with n rows.
        task: A task with n rows.
        max_episode_steps: Steps after which an episode is truncated; None for never.
        render_mode: ``"rgb_array"``, ``"human"`` or None; shows row 0.
    """

    def __init__(
        self, robot: Robot, task: Task, max_episode_steps: int | None = None, render_mode: str | None = None
    ) -> None:
        check_render_mode(render_mode)
        self.robot, self.task, self.render_mode = robot, task, render_mode
        self.num_envs = robot.num_robots
        self.max_episode_steps = max_episode_steps
        self.metadata = {
            "render_modes": render_modes(),
            "render_fps": round(1 / robot.spec.period),
            "autoreset_mode": AutoresetMode.SAME_STEP,
        }
        self.single_observation_space, self.single_action_space = task.observation_space, task.action_space
        self.observation_space = batch_space(task.observation_space, self.num_envs)
        self.action_space = batch_space(task.action_space, self.num_envs)
        self.state: RobotState | None = None
        self.elapsed = np.zeros(self.num_envs, dtype=np.int64)
        """Steps since each row's episode began. Shape: (n,)."""
        self._rngs = [np.random.default_rng() for _ in range(self.num_envs)]
        self._all = np.ones(self.num_envs, dtype=bool)

    @property
    def period(self) -> float:
        """Time between two actions [s]."""
        return self.robot.spec.period

    def describe(self) -> dict[str, list[dict[str, Any]]]:
        """What every number of observation, action, state and command means."""
        return describe(self.robot, self.task)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode on every row, or on those of ``options["reset_mask"]`` (n,) bool.

        Args:
            seed: Row i is seeded with ``seed + i``, or with ``seed[i]``.
            options: ``reset_mask``, and what the task's ``reset_options`` names, for every row alike.
        """
        require_table(options)
        given = dict(options or {})
        mask = np.asarray(given.pop("reset_mask", self._all), dtype=bool)
        given = task_options(self.task, given)
        if mask.shape != self._all.shape:
            raise InvalidValue(f"reset_mask must have shape {self._all.shape}, not {mask.shape}.")
        rows = np.flatnonzero(mask)
        for row, one in self._row_seeds(seed):
            if one is not None and mask[row]:
                self._rngs[row] = seeding.np_random(one)[0]
        self._begin(rows, given)
        return self._observe(), {"is_success": np.zeros(self.num_envs, dtype=bool), "_is_success": self._all.copy()}

    def _row_seeds(self, seed: int | list[int | None] | None) -> list[tuple[int, int | None]]:
        if seed is None:
            return []
        seeds = [seed + row for row in range(self.num_envs)] if isinstance(seed, (int, np.integer)) else list(seed)
        if len(seeds) != self.num_envs:
            raise InvalidValue(f"seed must be one number or {self.num_envs} of them, not {len(seeds)}.")
        return list(enumerate(seeds))

    def _begin(self, rows: Rows, options: Mapping[str, Any] | None = None) -> None:
        self.state = start_rows(self.robot, self.task, rows, [self._rngs[row] for row in rows], options)
        self.elapsed[rows] = 0

    def _observe(self) -> NDArray[np.float32]:
        if self.state is None:
            raise ResetNeeded("No episode is running. Call reset() first.")
        return self.task.observe(self.state)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step every row; rows whose episode ended begin the next one."""
        if self.state is None:
            raise ResetNeeded("No episode is running. Call reset() first.")
        actions = self._checked(actions)
        self.state = self.robot.step(self.task.command(actions, self.state))
        score = self.task.score(self.state, actions)
        observation = self.task.observe(self.state)
        self.elapsed += 1
        truncated = self._truncated(score)
        infos = {"is_success": score.success, "_is_success": self._all.copy()}
        for key, value in score.info.items():
            infos[key], infos["_" + key] = value, _said(value)
        ended = score.terminated | truncated
        if ended.any():
            observation = self._next_episodes(ended, observation, infos)
        return observation, score.reward, score.terminated, truncated, infos

    def _truncated(self, score: Score) -> NDArray[np.bool_]:
        if self.max_episode_steps is None:
            return np.zeros(self.num_envs, dtype=bool)
        truncated: NDArray[np.bool_] = self.elapsed >= self.max_episode_steps
        return truncated

    def _next_episodes(
        self, ended: NDArray[np.bool_], observation: NDArray[np.float32], infos: dict[str, Any]
    ) -> NDArray[np.float32]:
        """Move the last observation and info of ended rows aside and begin their next episodes."""
        values = {key: value for key, value in infos.items() if not key.startswith("_")}
        masks = {"_" + key: infos["_" + key] for key in values}
        infos |= {name: mask & ~ended for name, mask in masks.items()}  # what `reset` says nothing of
        infos |= {"is_success": values["is_success"] & ~ended, "_is_success": self._all.copy()}
        infos["final_info"] = {**values, **{name: mask & ended for name, mask in masks.items()}}
        infos["final_obs"], infos["_final_obs"], infos["_final_info"] = observation, ended, ended
        self._begin(np.flatnonzero(ended))
        return self._observe()

    def _checked(self, actions: Any) -> NDArray[np.float32]:
        array = np.asarray(actions, dtype=np.float32)
        if array.shape != self.action_space.shape:
            raise InvalidValue(f"The actions must have shape {self.action_space.shape}, not {array.shape}.")
        if not np.isfinite(array).all():
            raise InvalidValue(f"The actions must be finite; rows {bad_rows(array)} are not.")
        return array

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """A tuple with one image, of row 0; None for ``human``. The other rows are not drawn."""
        image = render(self.robot, self.task, self.render_mode)
        return None if image is None else (image,)

    def close_extras(self, **kwargs: Any) -> None:
        """Halt the robots and drop the physics."""
        self.state = None
        self.robot.close()

    def state_dict(self) -> dict[str, Any]:
        """Everything the future depends on: physics, task memory, generators, counters; plain arrays and values."""
        robot: Any = self.robot
        return {
            "robot": robot.state_dict(),
            "task": copy.deepcopy(self.task.state_dict()),
            "elapsed": self.elapsed.copy(),
            "rngs": [rng.bit_generator.state for rng in self._rngs],
        }

    def load_state_dict(self, state: dict[str, Any]) -> NDArray[np.float32]:
        """Go to what `state_dict` returned; the observation there."""
        robot: Any = self.robot
        self.state = robot.load_state_dict(state["robot"])
        self.task.load_state_dict(state["task"])
        self.elapsed = np.array(state["elapsed"])
        for rng, rng_state in zip(self._rngs, state["rngs"], strict=True):
            rng.bit_generator.state = rng_state
        return self._observe()


def bad_rows(array: NDArray[np.float32]) -> list[int]:
    """Rows that hold a number that is not finite."""
    rows: list[int] = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1)).tolist()
    return rows
