"""What the agents of Gymnasium environments have in common: names of variables, spaces, seeds, writing."""

from __future__ import annotations

import warnings
from abc import ABC
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import Space, spaces

from bam_train.errors import LoopError, SettingsError, ValueMismatch
from bam_train.loop.agent import agent_name, import_torch
from bam_train.loop.conventions import SeedableAgent, SerializableAgent, TimeAgent
from bam_train.loop.gym.infos import InfoRecorder
from bam_train.loop.gym.observations import names

_ARRAYS = ("torch", "numpy")
_NUMBERS = {
    "terminated": bool,
    "truncated": bool,
    "done": bool,
    "reward": float,
    "cumulated_reward": float,
    "timestep": np.int64,
}
"""Variables of one number for each environment, in the order in which they are written."""
_NOTHING: tuple[Any, ...] = ("", None, None, None)
_EMPTY: dict[str, Any] = {}


class GymAgent(TimeAgent, SeedableAgent, SerializableAgent, ABC):
    """Base of `ParallelGymAgent` and `VecGymAgent`.

    Args:
        args: For classes that are inherited beside this one.
        input_string: The variable with the action; or, where actions are dicts, the first part of their names.
        output_string: Put before the names of all variables that it writes.
        reward_at_t: Write the reward and the cumulated reward of action[t] at t, not at t + 1. The reward at the
            newest time is 0 until the next step overwrites it.
        include_last_state: Whether the row at which an episode ends has its last observation; without it that row has
            the first observation of the next episode. Without auto-reset it is always True.
        arrays: ``"torch"``: tensors, float32 and int64. ``"numpy"``: arrays, observations of the space's dtype,
            rewards float64; torch is not needed.
        info_keys: Entries k of the environments' infos to write too: ``info/k`` beside the mask ``info/_k``.
        kwargs: ``seed``, ``name``, ``verbose``.

    Attributes:
        ghost_params: An empty parameter; its device is where observations are put. None with NumPy.
        default_seed: The seed of an agent that was given none when it first runs.

    Raises:
        SettingsError: `arrays` is neither of the two.
    """

    default_seed = 42
    envs: Any
    num_envs: int

    def __init__(
        self,
        *args: Any,
        input_string: str = "action",
        output_string: str = "env/",
        reward_at_t: bool = False,
        include_last_state: bool = True,
        arrays: str = "torch",
        info_keys: Sequence[str] = (),
        **kwargs: Any,
    ) -> None:
        if arrays not in _ARRAYS:
            raise SettingsError(f'arrays: expected "torch" or "numpy", found {arrays!r}.')
        if isinstance(info_keys, str):
            raise SettingsError(f"info_keys: expected several names, found {info_keys!r}; write ({info_keys!r},).")
        if arrays == "torch":  # before Agent.__init__, which then makes this a module
            torch = import_torch(f'{type(self).__name__} (unless arrays="numpy" is given)')
        super().__init__(*args, **kwargs)
        self.input, self.output = input_string, output_string
        self.reward_at_t, self.include_last_state = reward_at_t, include_last_state
        self.arrays, self.info_keys = arrays, tuple(info_keys)
        self.ghost_params = torch.nn.Parameter(torch.Tensor()) if arrays == "torch" else None
        self.observation_space: Space[Any] | None = None
        self.action_space: Space[Any] | None = None
        self._nb_reset = 1
        floats = np.float32 if arrays == "torch" else np.float64
        self._dtypes = {name: np.dtype(floats if kind is float else kind) for name, kind in _NUMBERS.items()}
        self._deferring: dict[str, tuple[Any, ...]] = {}
        self._to_array: Callable[[Any], Any] = torch.from_numpy if arrays == "torch" else _same
        self._infos: InfoRecorder | None = None

    # -- running ---------------------------------------------------------------------------------------------------

    def forward(self, t: int, *args: Any, **kwargs: Any) -> None:
        """Take the default seed if there is none, and count the resets; subclasses do the rest."""
        if self._seed is None and kwargs.get("seed") is None:
            self.seed(self.default_seed)
        if t == 0:
            self._nb_reset += 1

    def set_obs(self, observations: Mapping[str, Any], t: int) -> None:
        """Write tensors or arrays (B x ...) at t, moved to the device of `ghost_params`.

        Args:
            observations: By name without the output prefix.
            t: The time.
        """
        device = self._device()
        if device is not None:
            observations = {key: value.to(device) for key, value in observations.items()}
        write = self.workspace.set if self._trace is None else self._traced_set
        if self.reward_at_t:
            observations = self._rewards_at_t(observations, t, write)
        prefix = self.output
        for key, value in observations.items():
            write(prefix + key, t, value)

    def set_numbers(self, numbers: Mapping[str, Any], t: int) -> None:
        """Write one number for each environment (B,) at t, for several variables.

        With tensors most are written as they are, and become tensors when somebody reads them.

        Args:
            numbers: By name without the output prefix; sequences that nobody changes any more.
            t: The time.
        """
        rest = numbers
        if self.arrays == "torch" and self._trace is None and not self.reward_at_t and self._device() is None:
            rest = self._defer(numbers, t)
        if rest:
            self.set_obs({key: self._to_array(_numbers(key, values, self._dtypes)) for key, values in rest.items()}, t)
            self._remember(rest)

    def _defer(self, numbers: Mapping[str, Any], t: int) -> dict[str, Any]:
        """Write numbers without making tensors, where the variable is the one that was written before; the others."""
        held, known, rest = self.workspace.variables, self._deferring, {}
        for key, values in numbers.items():
            name, variable, shape, dtype = known.get(key, _NOTHING)
            same = variable is not None and held.get(name) is variable and variable._shape is shape
            if not same or not variable.defer(t, values, dtype):
                rest[key] = values
        return rest

    def _remember(self, keys: Iterable[str]) -> None:
        """The variables that have just been written, so that the next times of them may be deferred."""
        for key in keys:
            variable = self.workspace.variables[self.output + key]
            if hasattr(variable, "defer"):
                self._deferring[key] = (self.output + key, variable, variable._shape, self._dtypes[key])

    def _device(self) -> Any:
        """Where tensors have to go; None if they are there already."""
        # Past nn.Module's __getattr__, which costs as much as storing a tensor.
        ghost = self.__dict__.get("_parameters", _EMPTY).get("ghost_params")
        return None if ghost is None or ghost.is_cpu else ghost.device

    def _rewards_at_t(self, observations: Mapping[str, Any], t: int, write: Any) -> dict[str, Any]:
        """Write the rewards of action[t - 1] at t - 1; what is left to write at t."""
        left = dict(observations)
        for key in ("reward", "cumulated_reward"):
            if key in left:
                if t > 0:
                    write(self.output + key, t - 1, left[key])
                left[key] = left[key] * 0 if key == "reward" else left[key] + 0  # new: no two times share memory
        return left

    def _traced_set(self, name: str, t: int, value: Any) -> None:
        self.set((name, t), value)

    def _written(self) -> tuple[str, ...]:
        """The names of all variables that it writes."""
        infos = [name for key in self.info_keys for name in (f"info/{key}", f"info/_{key}")]
        return tuple(self.output + name for name in (*names(self.get_observation_space()), *_NUMBERS, *infos))

    def _row_seeds(self, seed: Any) -> int | list[int | None]:
        """What the environments are reset with at t = 0: one seed to count from, or one for each.

        Args:
            seed: What the call was given: None for the agent's own rule.

        Raises:
            SettingsError: Neither a whole number nor as many as there are environments.
        """
        if seed is None:
            # Row k gets num_envs * (number of the reset, from 2) * seed + k + 1, as BBRL's ParallelGymAgent does.
            return self.num_envs * self._nb_reset * int(self._seed or 0) + 1
        if isinstance(seed, (int, np.integer)):
            return int(seed)
        try:
            seeds = [None if one is None else int(one) for one in seed]
        except (TypeError, ValueError):
            raise SettingsError(f"seed: expected a whole number or a list of them, found {seed!r}.") from None
        if len(seeds) != self.num_envs:
            raise SettingsError(f"seed: expected a number or {self.num_envs} of them, found {len(seeds)}.")
        return seeds

    def _not_open(self) -> LoopError:
        return LoopError(f"{agent_name(self)} has no episode running; its environments are (re)started at t=0.")

    def __getstate__(self) -> dict[str, Any]:
        """A copy writes into another workspace."""
        return {**super().__getstate__(), "_deferring": {}}

    # -- spaces ----------------------------------------------------------------------------------------------------

    def get_observation_space(self) -> Space[Any]:
        """The observation space of one environment.

        Raises:
            LoopError: It has none yet.
        """
        if self.observation_space is None:
            raise LoopError(f"{agent_name(self)} has no observation space.")
        return self.observation_space

    def get_action_space(self) -> Space[Any]:
        """The action space of one environment.

        Raises:
            LoopError: It has none yet.
        """
        if self.action_space is None:
            raise LoopError(f"{agent_name(self)} has no action space.")
        return self.action_space

    def get_obs_and_actions_sizes(self) -> tuple[Any, Any]:
        """Sizes of observation and action: length, or number of choices; with a warning, the shape of more dimensions.

        Raises:
            LoopError: A space has no size, such as a dict.
        """
        return _size(self.get_observation_space()), _size(self.get_action_space())

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


def _numbers(name: str, values: Any, dtypes: Mapping[str, np.dtype[Any]]) -> Any:
    """One number from each environment as an array (B,)."""
    array = np.array(values, dtypes[name])
    if array.ndim != 1:
        raise ValueMismatch(f"{name!r}: expected one number from each environment, found {values[0]!r}.")
    return array


def _same(array: Any) -> Any:
    return array


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
