"""Environments for stable-baselines3: `BatchVecEnv` over a batched simulation, `DummyVecEnv` over all others."""

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from bam_envs.core.location import HERE, Location, Remote
from bam_train.env_faults import FiniteEnv, FiniteVectorEnv
from bam_train.environments import is_batched, make_env, make_vector_env
from bam_train.errors import SettingsError
from bam_train.rollout import success_of
from bam_train.trainers.zero_based_spaces import from_zero

Observations = Any
"""An array (n, …), or a mapping of them."""


def make_training_env(
    env_id: str,
    env_kwargs: Mapping[str, Any],
    num_envs: int,
    place: Location = HERE,
    *,
    coarse: bool = False,
    near: float = 0.0,
) -> VecEnv:
    """Make `num_envs` environments to train on; those of `bam_envs` can save and restore their state.

    Unless they are elsewhere, their physics is `coarse` if that is asked for, and a share of episodes begin `near` the
    goal; raises SettingsError if that cannot be.
    """
    if is_batched(env_id) or isinstance(place, Remote):
        batch = make_vector_env(env_id, env_kwargs, num_envs, place)
        robot: Any = getattr(batch.unwrapped, "robot", None)
        if hasattr(robot, "coarse"):
            robot.coarse, coarse = coarse, False
        task: Any = getattr(batch.unwrapped, "task", None)
        while "task" in getattr(task, "__dict__", ()):  # below cameras and a link
            task = task.task
        if hasattr(task, "near_starts"):
            task.near_starts, near = near, 0.0
        if not (coarse or near) or isinstance(place, Remote):
            return BatchVecEnv(batch, env_id)
    if coarse:
        raise SettingsError(f"coarse_physics: {env_id} has no arm that MuJoCo simulates; leave it out")
    if near:
        raise SettingsError(f"near_starts: {env_id} has no starts near its goal; leave it out")
    envs = (FiniteEnv(make_env(env_id, env_kwargs), env_id, index) for index in range(num_envs))
    return DummyVecEnv([functools.partial(Monitor, from_zero(env)) for env in envs])


def one_env(venv: VecEnv) -> Any:
    """The vector environment of a `BatchVecEnv`, or the first environment of a `DummyVecEnv`."""
    if isinstance(venv, BatchVecEnv):
        return venv.batch
    env = venv.envs[0]
    while not isinstance(env, FiniteEnv):
        env = env.env
    return env


class BatchVecEnv(VecEnv):  # type: ignore[misc]
    """A Gymnasium vector environment whose environments restart in the same step, as a stable-baselines3 `VecEnv`.

    `reset` and `step_wait` raise EnvironmentFailed, which names `env_id`, if an observation or a reward is not finite.
    """

    def __init__(self, batch: VectorEnv[Any, Any, Any], env_id: str | None = None) -> None:
        mode = batch.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise SettingsError(f"{batch}: expected autoreset mode SAME_STEP, found {mode}")
        start = getattr(batch.single_action_space, "start", 0)
        if np.any(start):
            raise SettingsError(f"{batch}: expected actions that count from 0, found {batch.single_action_space}")
        self.batch = FiniteVectorEnv(batch, env_id)
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)
        self._returns = np.zeros(self.num_envs)  # of the running episodes
        self._actions: NDArray[Any] = np.empty(0)
        self._interrupted: Observations = None

    @property
    def can_be_saved(self) -> bool:
        """Whether running episodes can be saved and restored; those of a robot elsewhere cannot."""
        return hasattr(self.batch, "state_dict")

    def reset(self) -> Observations:
        """Begin an episode on every environment, with the seeds of `seed`."""
        seeds: Any = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        observations, _ = self.batch.reset(seed=seeds)
        self._reset_seeds()
        self._returns[:] = 0
        self._interrupted = None
        return self._copy(observations)

    def interrupt(self, last: Observations) -> None:
        """Truncate the running episodes at the next step, with `last` observations, after an evaluation in between."""
        self._interrupted = last

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all environments. Shapes: observations (n, …), rewards (n,) float32, done (n,) bool, n infos."""
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if self._interrupted is not None:  # the actions are not sent, and no episode is counted
            last, observations = self._interrupted, self.reset()
            for row, info in enumerate(infos):
                info |= {"terminal_observation": self._copy(last, row), "TimeLimit.truncated": True}
            return observations, np.zeros(self.num_envs, np.float32), np.ones(self.num_envs, dtype=bool), infos
        lengths = self.batch.episode_steps + 1
        observations, rewards, terminated, truncated, extra = self.batch.step(self._actions)
        done = terminated | truncated
        self._returns += rewards
        for index in np.flatnonzero(done).tolist():  # with stable-baselines3's keys
            infos[index] = {
                "terminal_observation": self._copy(extra["final_obs"], index),
                "TimeLimit.truncated": not terminated[index],
                "episode": {"r": float(self._returns[index]), "l": int(lengths[index])},
            }
            if (success := success_of(extra, index)) is not None:
                infos[index]["is_success"] = success
        self._returns[done] = 0
        return self._copy(observations), np.asarray(rewards, dtype=np.float32), done, infos

    def _copy(self, observations: Observations, index: Any = ...) -> Any:
        """Copy the observations of one environment or all, because environments may reuse their arrays."""
        if isinstance(self.observation_space, spaces.Dict):
            return {key: np.array(value[index]) for key, value in observations.items()}
        return np.array(observations[index])

    def state_dict(self) -> dict[str, Any]:
        """The complete state of the environments, as arrays and plain values."""
        batch: Any = self.batch
        return {"rows": batch.state_dict(), "returns": self._returns.copy(), "lengths": self.batch.episode_steps.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        batch: Any = self.batch
        batch.reset()  # allocates the arrays that are then overwritten
        batch.load_state_dict(state["rows"])
        self._returns, self.batch.episode_steps = np.array(state["returns"]), np.array(state["lengths"])

    def close(self) -> None:
        """Close the environments."""
        self.batch.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The vector environment's attribute, repeated for each of `indices`."""
        value = getattr(self.batch, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set the vector environment's attribute, for all environments."""
        setattr(self.batch, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call the vector environment's method once; returns its result for each of `indices`."""
        value = getattr(self.batch, method_name)(*method_args, **method_kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """False for each: environments have no wrappers."""
        return [False for _ in self._get_indices(indices)]
