"""The gym agents of BBRL up to 0.3 (``bbrl.agents.gyma``), with their arguments and variables.

Differences from bbrl 0.3: the environments are Gymnasium's, whose time limit is a separate flag; ``truncated`` is the
former ``info["TimeLimit.truncated"]``: the time limit, unless the task ended in the same step. ``env/rendering`` is a
uint8 tensor B x height x width x 3. At every t > 0 an action is required that fits the action space.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium.wrappers import Autoreset

from bam_train.errors import SettingsError
from bam_train.loop.gym_spaces import Arrays
from bam_train.loop.parallel_gym_agent import Env, ParallelGymAgent, has_autoreset


class _OldGymAgent(ParallelGymAgent):
    """Writes env_obs, done, truncated, reward, timestep and cumulated_reward as `ParallelGymAgent` does.

    Environment k is seeded with ``seed + k`` at its first reset only. `seed` and `n_envs` are required, in spite of
    their defaults.
    """

    _autoreset: bool

    def __init__(
        self,
        make_env_fn: Callable[..., Env],
        make_env_args: Mapping[str, Any] | None = None,
        n_envs: int | None = None,
        seed: int | None = None,
        action_string: str = "action",
        output: str = "env/",
        *,
        arrays: str = "torch",
    ) -> None:
        if seed is None:
            raise SettingsError(f"{type(self).__name__}: expected a seed, found None.")
        if n_envs is None:
            raise SettingsError(f"{type(self).__name__}: expected n_envs, the number of environments, found None.")
        strings = {"input_string": action_string, "output_string": output}
        super().__init__(make_env_fn, n_envs, make_env_args, seed=seed, arrays=arrays, **strings)
        self._declare(_OldGymAgent, reads=None, writes=self._written())

    @property
    def n_envs(self) -> int:
        """The number of environments."""
        return self.num_envs

    def seed(self, seed: int) -> None:
        """Do nothing, as in bbrl 0.3: the seed is an argument of the constructor."""

    def get_obs_and_actions_sizes(self) -> tuple[Any, Any]:
        """Length of observation and action, or number of choices of the action; 1 for a Discrete observation."""
        observation, action = super().get_obs_and_actions_sizes()
        return (1 if self.is_discrete_state() else observation), action

    def _open(self) -> None:
        self._seeded = False
        super()._open()
        self._is_autoreset = self._autoreset

    def _make(self) -> Env:
        env = super()._make()
        return Autoreset(env) if self._autoreset and not has_autoreset(env) else env

    def _reset_seeds(self, seed: Any) -> int | list[int | None]:
        if seed is not None:
            return super()._reset_seeds(seed)
        return [None if self._seeded else int(self._seed or 0) + k for k in range(self.num_envs)]

    def forward(self, t: int = 0, save_render: bool = False, render: bool = False, **kwargs: Any) -> None:
        """As `GymAgent`; then render all environments, and write the pictures if `save_render` is true."""
        super().forward(t, **kwargs)
        self._seeded = True
        if save_render or render:
            pictures: list[Any] = [env.render() for env in self.envs]
            if save_render:
                self._put({"rendering": np.array(pictures)}, t)

    def _frame(self, *parts: Any) -> Arrays:
        frame = super()._frame(*parts)
        frame["truncated"] &= ~frame.pop("terminated")
        numbers = {name: frame.pop(name) for name in ("done", "truncated", "reward", "timestep", "cumulated_reward")}
        return {**frame, **numbers}

    def _written(self) -> tuple[str, ...]:
        return tuple(name for name in super()._written() if name != f"{self.output}terminated")


class AutoResetGymAgent(_OldGymAgent):
    """Environments that begin the next episode at the time after the end of an episode."""

    _autoreset = True


class NoAutoResetGymAgent(_OldGymAgent):
    """Environments whose last values are repeated, with reward 0, once an episode has ended."""

    _autoreset = False
