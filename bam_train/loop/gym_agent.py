"""The base class of agents of Gymnasium environments: variables, spaces, seeds, stepping."""

from __future__ import annotations

import sys
import warnings
from abc import abstractmethod
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import Space, spaces

from bam_train.errors import LoopError, SettingsError
from bam_train.loop.agent import agent_name, import_torch
from bam_train.loop.agents import SeedableAgent
from bam_train.loop.gym_spaces import Array, Arrays, InfoRecorder, Kind, names

if TYPE_CHECKING:
    from typing_extensions import Self

NUMBERS = ("terminated", "truncated", "done", "reward", "cumulated_reward", "timestep")
"""Variables of one number for each environment, in the order in which they are written."""


class GymAgent(SeedableAgent):
    """Base of `ParallelGymAgent` and `VecGymAgent`.

    Args:
        input_string: The variable with the action; for dict actions, the prefix of the variables' names.
        output_string: Prefix of the names of all variables that it writes.
        reward_at_t: Write the reward and the cumulated reward of action[t] at t, not at t + 1. The reward at the
            newest time is 0 until the next step overwrites it.
        include_last_state: Whether the time at which an episode ends has its last observation, or else the first
            observation of the next episode. Without auto-reset it is always True.
        arrays: ``"torch"`` for tensors, float32 and int64; ``"numpy"`` for arrays, with observations of the space's
            dtype and rewards of float64, without torch.
        info_keys: Keys k of the environments' infos to write too, as ``info/k`` with the mask ``info/_k``.
        kwargs: ``seed``, ``name``, ``verbose``.

    Attributes:
        ghost_params: An empty parameter; its device is where observations are put. None with NumPy.
        default_seed: The seed of an agent that has no other seed when it first runs.

    Raises:
        SettingsError: `arrays` is neither ``"torch"`` nor ``"numpy"``.
    """

    default_seed = 42
    envs: Any
    num_envs: int
    observation_space: Space[Any]
    action_space: Space[Any]
    _SEED_AGAIN = "give a run another seed with agent(workspace, t=0, seed={seed})."

    def __new__(cls, *args: Any, arrays: str = "torch", **kwargs: Any) -> Self:
        """Make an agent, which with tensors is always an `nn.Module`: torch is imported for it."""
        if arrays == "torch":
            import_torch(f'{cls.__name__} (unless arrays="numpy" is given)')
        return super().__new__(cls)

    def __init__(
        self,
        *,
        input_string: str = "action",
        output_string: str = "env/",
        reward_at_t: bool = False,
        include_last_state: bool = True,
        arrays: str = "torch",
        info_keys: Sequence[str] = (),
        **kwargs: Any,
    ) -> None:
        if arrays not in ("torch", "numpy"):
            raise SettingsError(f'arrays: expected "torch" or "numpy", found {arrays!r}.')
        if isinstance(info_keys, str):
            raise SettingsError(f"info_keys: expected several names, found {info_keys!r}; write ({info_keys!r},).")
        super().__init__(**kwargs)
        self.input, self.output = input_string, output_string
        self.reward_at_t, self.include_last_state = reward_at_t, include_last_state
        self.arrays, self.info_keys = arrays, tuple(info_keys)
        self._nb_reset = 1
        self._running = False
        self._floats = np.dtype(np.float32 if arrays == "torch" else np.float64)
        self.ghost_params: Any = None
        if arrays == "torch":
            torch = sys.modules["torch"]
            self.ghost_params = torch.nn.Parameter(torch.empty(0))

    # -- running ---------------------------------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> None:
        """Make the environments `envs`, and call `_opened` with their spaces."""

    def _opened(self, observation_space: Space[Any], action_space: Space[Any]) -> None:
        """Store the spaces of one environment, and declare the variables that are written."""
        self.observation_space, self.action_space = observation_space, action_space
        self._declare(GymAgent, reads=None, writes=self._written())

    @abstractmethod
    def _begin(self, seeds: Any) -> Arrays:
        """Begin an episode in every environment; `seeds` is the seed of the first, or one for each environment."""

    @abstractmethod
    def _step(self, t: int) -> Arrays:
        """Step every environment with its action of time t."""

    def forward(self, t: int = 0, **kwargs: Any) -> None:
        """Reset all environments at t = 0; at t > 0 step each with the action of t - 1.

        Args:
            t: The time.
            kwargs: ``seed``, used at t = 0: a number s, so that environment k gets s + k, or a list with one seed for
                each. By default BBRL's rule: num_envs * r * seed + k + 1, where r counts the resets from 2.

        Raises:
            LoopError: t > 0, and the environments were never reset or have been closed; or the action is missing or
                does not fit the action space.
        """
        if t == 0:
            seed = kwargs.get("seed")
            if self._seed is None and seed is None:
                self.seed(self.default_seed)
            self._nb_reset += 1
            self._running = False  # until the reset has worked
            if self.envs is None:
                self._open()
            self._infos = InfoRecorder(self.info_keys, self.num_envs, self._floats)
            self._kinds: dict[str, Kind] = {}
            self._cumulated: Any = np.zeros(self.num_envs)
            self._timestep = np.zeros(self.num_envs, dtype=np.int64)
            frame = self._begin(self._reset_seeds(seed))
            self._running = True
        elif not self._running:
            raise LoopError(f"{agent_name(self)} has no episode running; its environments are (re)started at t=0.")
        else:
            frame = self._step(t - 1)
        if self.reward_at_t:
            shifted = {key: frame[key] for key in ("reward", "cumulated_reward")}
            if t > 0:
                self._put(shifted, t - 1)
            frame["reward"] = np.zeros_like(frame["reward"])  # new arrays: no two times share memory
            frame["cumulated_reward"] = frame["cumulated_reward"].copy()
        self._put(frame, t)

    def _frame(self, observations: Arrays, rewards: Any, terminated: Array, truncated: Array, infos: Arrays) -> Arrays:
        """The variables of n environments at one time: new arrays (n, ...) by name, without the output prefix."""
        reward = np.array(rewards, dtype=self._floats)
        if reward.ndim != 1:
            raise LoopError(f"'reward': expected one number from each environment, found {rewards[0]!r}.")
        numbers = {
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
            "reward": reward,
            "cumulated_reward": np.array(self._cumulated, dtype=self._floats),
            "timestep": self._timestep.copy(),
        }
        return {**observations, **numbers, **infos}

    def _put(self, arrays: Arrays, t: int) -> None:
        """Write arrays (B x ...) at t, by name without the output prefix, on the device of `ghost_params`."""
        workspace, prefix = self.workspace, self.output
        if self.arrays == "numpy":
            for name, array in arrays.items():
                workspace.set(prefix + name, t, array)
            return
        from_numpy = sys.modules["torch"].from_numpy
        ghost = self.__dict__["_parameters"]["ghost_params"]  # without nn.Module's slow __getattr__
        for name, array in arrays.items():
            value = from_numpy(array)
            workspace.set(prefix + name, t, value if ghost.is_cpu else value.to(ghost.device))

    def _written(self) -> tuple[str, ...]:
        """The names of all variables that it writes."""
        infos = [name for key in self.info_keys for name in (f"info/{key}", f"info/_{key}")]
        return tuple(self.output + name for name in (*names(self.observation_space), *NUMBERS, *infos))

    def _reset_seeds(self, seed: Any) -> int | list[int | None]:
        """Seeds for a reset: that of the first environment, or one for each (None: its own rule)."""
        if seed is None:
            return self.num_envs * self._nb_reset * int(self._seed or 0) + 1
        if isinstance(seed, (int, np.integer)):
            return int(seed)
        try:
            seeds = [None if entry is None else int(entry) for entry in seed]
        except (TypeError, ValueError):
            raise SettingsError(f"seed: expected a whole number or a list of them, found {seed!r}.") from None
        if len(seeds) != self.num_envs:
            raise SettingsError(f"seed: expected a number or {self.num_envs} of them, found {len(seeds)}.")
        return seeds

    def close(self) -> None:
        """Close the environments; the next t = 0 makes new ones."""
        envs, self.envs, self._running = self.envs, None, False
        with ExitStack() as stack:  # all of them, also when one fails
            for env in envs if isinstance(envs, list) else [envs]:
                if env is not None:
                    stack.callback(env.close)

    # -- spaces ----------------------------------------------------------------------------------------------------

    def get_observation_space(self) -> Space[Any]:
        """The observation space of one environment."""
        return self.observation_space

    def get_action_space(self) -> Space[Any]:
        """The action space of one environment."""
        return self.action_space

    def get_obs_and_actions_sizes(self) -> tuple[Any, Any]:
        """Sizes of observation and action: the length, or the number of choices.

        More than one dimension gives the shape, with a warning; a space without a size, such as a dict, a `LoopError`.
        """
        return _size(self.observation_space), _size(self.action_space)

    def is_continuous_action(self) -> bool:
        """Whether the action space is a Box."""
        return isinstance(self.action_space, spaces.Box)

    def is_discrete_action(self) -> bool:
        """Whether the action space is Discrete."""
        return isinstance(self.action_space, spaces.Discrete)

    def is_continuous_state(self) -> bool:
        """Whether the observation space is a Box."""
        return isinstance(self.observation_space, spaces.Box)

    def is_discrete_state(self) -> bool:
        """Whether the observation space is Discrete."""
        return isinstance(self.observation_space, spaces.Discrete)


def _size(space: Space[Any]) -> Any:
    if not space.shape:
        if not hasattr(space, "n"):
            raise LoopError(f"{space} has no single size; ask its parts: get_observation_space(), get_action_space().")
        return space.n
    if len(space.shape) == 1:
        return space.shape[0]
    warnings.warn(
        f"The space has shape {space.shape}, which is returned as it is; flatten observations to get one length.",
        stacklevel=3,
    )
    return space.shape
