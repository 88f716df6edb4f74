"""A Gymnasium vector environment as an agent.

Differences from bbrl 1.0.1's `VecGymAgent`, which fails with more than one environment and never restarts
cumulated_reward: any number of environments, timestep, dict observations and actions, variables that mean what
`ParallelGymAgent`'s do in every autoreset mode, and its seeds: environment k is reset with
num_envs * r * seed + k + 1 (BBRL's VecGymAgent: r * seed + k). Rewards are summed in float64.

With `include_last_state` the time at which an episode ends has the last observation, and the next time is a first
observation with reward 0:

==========  ==========================================================================================================
NEXT_STEP   does just this
SAME_STEP   the last observation is in ``infos["final_obs"]``. At the next time the environment is a step into the new
            episode; that step is thrown away: the environment is reset again, by a reset mask
DISABLED    made SAME_STEP here, by a reset mask, so that no ended environment is ever stepped
==========  ==========================================================================================================

Without it the time at which an episode ends has the first observation of the next: NEXT_STEP cannot do this. Without
auto-reset the frame of an ended environment is repeated with reward 0, whatever it does underneath.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from bam_train.errors import LoopError, SettingsError
from bam_train.loop.gym.gym_actions import ActionReader
from bam_train.loop.gym.gym_agent import Frame, GymAgent
from bam_train.loop.gym.gym_observations import Array, Entry, InfoRecorder, entries, pick

_Arrays = dict[str, Array]


class VecGymAgent(GymAgent):
    """Resets a vector environment at t = 0, and at t > 0 steps it with the actions of t - 1.

    It writes the variables of `ParallelGymAgent`, with the same meaning: see there. Vector environments that reset
    ended environments in the same step, or not at all, must obey ``reset(options={"reset_mask": (n,) bool})``, as
    Gymnasium's `SyncVectorEnv` and `AsyncVectorEnv` and ours do; they reset an environment twice at the end of its
    episode.

    Args:
        make_envs_fn: Makes the vector environment.
        vec_env_args: Keywords of `make_envs_fn`.
        args: For classes that are inherited beside this one.
        auto_reset: False repeats the last frame of an ended environment, with reward 0, until the caller stops.
        kwargs: See `GymAgent`.

    Raises:
        SettingsError: The environment does not say in its metadata what it does with ended environments, or resets
            them in the next step and `include_last_state` is False.
    """

    def __init__(
        self,
        make_envs_fn: Callable[..., VectorEnv[Any, Any, Any]],
        vec_env_args: Mapping[str, Any] | None = None,
        *args: Any,
        auto_reset: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.make_envs_fn, self._vec_env_args = make_envs_fn, dict(vec_env_args or {})
        self.auto_reset = auto_reset
        self.include_last_state = self.include_last_state or not auto_reset
        self._open()

    def _open(self) -> None:
        self.envs = self.make_envs_fn(**self._vec_env_args)
        if not isinstance(self.envs, VectorEnv):
            raise SettingsError(
                f"make_envs_fn: expected it to return a gymnasium.vector.VectorEnv, found {type(self.envs).__name__}; "
                f"single environments are ParallelGymAgent's."
            )
        try:
            self._mode = autoreset_mode(self.envs)
            if self._mode == AutoresetMode.NEXT_STEP and not self.include_last_state:
                raise SettingsError(
                    f"include_last_state=False: {self.envs} resets ended environments in the next step "
                    "(AutoresetMode.NEXT_STEP), so their last observation cannot be left out; "
                    "make it with AutoresetMode.SAME_STEP."
                )
        except SettingsError:
            self.envs.close()
            raise
        self.num_envs = self.envs.num_envs
        self._opened(self.envs.single_observation_space, self.envs.single_action_space)

    def _make_stepper(self, infos: InfoRecorder) -> _VectorEnvs:
        return _VectorEnvs(self.envs, self._mode, self.auto_reset, self.include_last_state, infos, self._floats)

    def _read_actions(self, actions: ActionReader, t: int) -> Any:
        return actions.batch(self.workspace, t)

    def close(self) -> None:
        """Close the environment; it is made anew at the next t = 0."""
        envs, self.envs, self._stepper = self.envs, None, None
        if envs is not None:
            envs.close()

    def __getstate__(self) -> dict[str, Any]:
        """A copy makes its own environment at its next t = 0: processes and simulators cannot be copied."""
        return {**super().__getstate__(), "envs": None, "_stepper": None}


def autoreset_mode(envs: Any) -> AutoresetMode:
    """What `envs` does with ended environments; to be asked before another vector environment is made.

    Gymnasium's own write it into a dict that all vector environments of one class share, so it may change later.

    Raises:
        SettingsError: It does not say.
    """
    mode = envs.metadata.get("autoreset_mode")
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise SettingsError(
            f'{envs}: expected metadata["autoreset_mode"] to be a gymnasium.vector.AutoresetMode, found {mode!r}; '
            "set it to what the environment does."
        ) from None


class _VectorEnvs:
    """A vector environment, with the sums and counts of its episodes.

    Args:
        envs: The environment.
        mode: What it does with ended environments.
        auto_reset: Whether an ended episode is followed by a new one.
        include_last_state: See above.
        infos: Takes entries of the infos.
        floats: The dtype of rewards. With float32 observations have the dtypes that torch learns on.
    """

    def __init__(
        self,
        envs: VectorEnv[Any, Any, Any],
        mode: AutoresetMode,
        auto_reset: bool,
        include_last_state: bool,
        infos: InfoRecorder,
        floats: np.dtype[Any],
    ) -> None:
        self._envs, self._mode, self._auto_reset, self._include_last = envs, mode, auto_reset, include_last_state
        self._infos, self._floats = infos, floats
        self._entries: list[Entry] = []
        n = envs.num_envs
        self._cumulated, self._timestep = np.zeros(n), np.zeros(n, dtype=np.int64)
        self._begin, self._over = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        self._advance: Any = 1
        self._last = Frame({}, {}, {})  # without auto-reset
        self._turns = mode != AutoresetMode.NEXT_STEP
        # Whether an environment is one step into its next episode when its first observation is due.
        self._ahead = self._turns and auto_reset and include_last_state

    def reset(self, seeds: int | Sequence[int | None]) -> Frame:
        """Begin an episode in every environment."""
        envs: Any = self._envs  # Any: several take a list of seeds
        observations, infos = envs.reset(seed=seeds)
        self._entries = entries(_first(observations), envs.single_observation_space, self._floats == np.float32)
        zeros, no = np.zeros(len(self._begin)), np.zeros(len(self._begin), dtype=bool)
        return self._frame(self._packed(observations), zeros, no, no.copy(), self._infos.of_vector(infos))

    def step(self, actions: Any) -> Frame:
        """Step every environment."""
        if np.count_nonzero(self._over) == len(self._over):
            last = Frame(*({name: array.copy() for name, array in part.items()} for part in self._last))
            last.numbers["reward"][:] = 0
            return last
        observations, rewards, terminated, truncated, infos = self._envs.step(actions)
        packed, recorded = self._packed(observations), self._infos.of_vector(infos)
        terminated, truncated = np.array(terminated, dtype=bool), np.array(truncated, dtype=bool)
        rewards = np.array(rewards, dtype=np.float64)
        # count_nonzero: any() takes ten times as long.
        if self._turns and (np.count_nonzero(terminated | truncated) or np.count_nonzero(self._begin)):
            self._turn(packed, rewards, terminated, truncated, infos, recorded)
        if self._over.any():
            self._hold(packed, rewards, terminated, truncated, recorded)
        self._cumulated += rewards
        self._timestep += self._advance
        frame = self._frame(packed, rewards, terminated, truncated, recorded)
        self._after(frame)
        return frame

    # -- the time at which an episode ends, and the next -----------------------------------------------------------

    def _turn(
        self, packed: _Arrays, rewards: Array, terminated: Array, truncated: Array, infos: Any, recorded: _Arrays
    ) -> None:
        """Put the last observation where episodes end, and the first where they begin; changes what it is given."""
        begin = self._begin & self._ahead
        ended = terminated | truncated
        if self._mode == AutoresetMode.SAME_STEP and ended.any():
            self._take_final(packed, ended, infos, recorded)
        again = begin | ended if self._mode == AutoresetMode.DISABLED else begin
        if not again.any():
            return
        first, first_infos = self._reset_some(again, ~(again | ended), packed)
        shown = begin if self._include_last else again
        for name, array in first.items():
            packed[name][shown] = array[shown]
        if begin.any():
            self._infos.replaced(recorded, self._infos.of_vector(first_infos), begin)
        rewards[begin], terminated[begin], truncated[begin] = 0, False, False

    def _take_final(self, packed: _Arrays, ended: Array, infos: Mapping[str, Any], recorded: _Arrays) -> None:
        """Where episodes ended: the last observation, if it is to be shown, and the last info.

        Raises:
            LoopError: The environment did not keep the last observation.
        """
        if self._include_last:
            if "final_obs" not in infos:
                raise LoopError(f'{self._envs} is AutoresetMode.SAME_STEP but gave no infos["final_obs"] at an end.')
            final = infos["final_obs"]
            each = isinstance(final, np.ndarray) and final.dtype == object
            for entry in self._entries:
                if each:
                    for k in np.flatnonzero(ended):
                        packed[entry.name][k] = pick(entry, final[k])
                else:
                    packed[entry.name][ended] = pick(entry, final)[ended]
        if "final_info" in infos:
            self._infos.replaced(recorded, self._infos.of_vector(infos["final_info"]), ended)

    def _reset_some(self, chosen: Array, others: Array, packed: _Arrays) -> tuple[_Arrays, Any]:
        """Reset the environments `chosen` (n,) bool, and see that no other one was.

        Raises:
            LoopError: Another was.
        """
        observations, infos = self._envs.reset(options={"reset_mask": chosen.copy()})
        first = self._packed(observations)
        if any(first[name][others].tobytes() != packed[name][others].tobytes() for name in packed):
            raise LoopError(
                f'{self._envs} does not obey reset(options={{"reset_mask": ...}}): it changed other environments.'
            )
        return first, infos

    def _hold(self, packed: _Arrays, rewards: Array, terminated: Array, truncated: Array, recorded: _Arrays) -> None:
        """Repeat the last frame where episodes are over for good, with reward 0; changes what it is given."""
        over, last = self._over, self._last
        for name in packed:
            packed[name][over] = last.observations[name][over]
        terminated[over], truncated[over] = last.numbers["terminated"][over], last.numbers["truncated"][over]
        rewards[over] = 0
        self._infos.replaced(recorded, last.infos, over)

    def _after(self, frame: Frame) -> None:
        """Remember which episodes ended."""
        done = frame.numbers["done"]
        if not self._auto_reset:
            self._over, self._advance = done.copy(), ~done
            self._last = Frame(*({name: array.copy() for name, array in part.items()} for part in frame))
            return
        if self._turns:
            self._begin = done.copy()
        if np.count_nonzero(done):
            self._cumulated[done] = 0
            self._timestep[done] = -1  # so that the reset is step 0

    # -- one frame -------------------------------------------------------------------------------------------------

    def _packed(self, observations: Any) -> _Arrays:
        """Copies of the observations' arrays by variable, in the dtype they are written as."""
        return {entry.name: np.array(pick(entry, observations), dtype=entry.dtype) for entry in self._entries}

    def _frame(self, packed: _Arrays, rewards: Array, terminated: Array, truncated: Array, recorded: _Arrays) -> Frame:
        numbers = {
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
            "reward": rewards.astype(self._floats),
            "cumulated_reward": self._cumulated.astype(self._floats),
            "timestep": self._timestep.copy(),
        }
        return Frame(packed, numbers, recorded)


def _first(observations: Any) -> Any:
    """The first environment's part of a batch of observations; dicts stay dicts."""
    if isinstance(observations, Mapping):
        return {key: _first(one) for key, one in observations.items()}
    return observations if isinstance(observations, tuple) else observations[0]
