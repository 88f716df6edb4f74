"""A Gymnasium vector environment as an agent.

Unlike bbrl 1.0.1's `VecGymAgent`, which fails with more than one environment and never restarts cumulated_reward, it
has the variables and the seeds of `ParallelGymAgent` in every autoreset mode. Rewards are summed in float64.

With `include_last_state` the time at which an episode ends has its last observation, and the next time has the first
observation of the next episode, with reward 0:

==========  ==========================================================================================================
NEXT_STEP   behaves so itself
SAME_STEP   the last observation is in ``infos["final_obs"]``. At the next time the environment has taken a step of the
            new episode; this step is discarded: the environment is reset again, by a reset mask
DISABLED    behaves as SAME_STEP, by a reset mask, so that no ended environment is ever stepped
==========  ==========================================================================================================

Without `include_last_state`, the time at which an episode ends has the first observation of the next, which NEXT_STEP
does not support. Without auto-reset, the last values of an ended environment are repeated with reward 0 in every mode.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from bam_train.errors import LoopError, SettingsError
from bam_train.loop.gym_agent import GymAgent
from bam_train.loop.gym_spaces import Array, Arrays, batch_action, flat, kinds, pick


class VecGymAgent(GymAgent):
    """Resets a vector environment at t = 0, and at t > 0 steps it with the actions of t - 1.

    It writes the variables of `ParallelGymAgent`, with the same meaning. Vector environments that reset ended
    environments in the same step, or not at all, must obey ``reset(options={"reset_mask": (n,) bool})``, as Gymnasium's
    `SyncVectorEnv` and `AsyncVectorEnv` and ours do; they reset an environment twice at the end of its episode.

    Args:
        make_envs_fn: Makes the vector environment.
        vec_env_args: Keywords of `make_envs_fn`.
        auto_reset: False repeats the last values of an ended environment, with reward 0, until the caller stops.
        kwargs: See `GymAgent`.

    Raises:
        SettingsError: The environment's metadata has no autoreset mode, or the mode is NEXT_STEP and
            `include_last_state` is False.
    """

    def __init__(
        self,
        make_envs_fn: Callable[..., VectorEnv[Any, Any, Any]],
        vec_env_args: Mapping[str, Any] | None = None,
        *,
        auto_reset: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
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
        # Read now: Gymnasium writes it into a dict that all vector environments of one class share.
        mode = self.envs.metadata.get("autoreset_mode")
        known = [member for member in AutoresetMode if mode in (member, member.value)]
        problem = ""
        if not known:
            problem = (
                f'{self.envs}: expected metadata["autoreset_mode"] to be a gymnasium.vector.AutoresetMode, '
                f"found {mode!r}; set it to what the environment does."
            )
        elif known == [AutoresetMode.NEXT_STEP] and not self.include_last_state:
            problem = (
                f"include_last_state=False: {self.envs} resets ended environments in the next step "
                "(AutoresetMode.NEXT_STEP), so their last observation cannot be left out; "
                "make it with AutoresetMode.SAME_STEP."
            )
        if problem:
            self.envs.close()
            raise SettingsError(problem)
        self._mode = known[0]
        self.num_envs = self.envs.num_envs
        self._opened(self.envs.single_observation_space, self.envs.single_action_space)

    def _begin(self, seeds: int | Sequence[int | None]) -> Arrays:
        observations, infos = self.envs.reset(seed=seeds)
        first = {name: part if isinstance(part, tuple) else part[0] for name, part in flat(observations).items()}
        self._kinds = kinds(first, self.observation_space, self.arrays == "torch")
        no = np.zeros(self.num_envs, dtype=bool)
        self._due, self._over = no.copy(), no.copy()
        self._last: Arrays = {}  # without auto-reset
        return self._frame(
            self._packed(observations), np.zeros(self.num_envs), no, no.copy(), self._infos.of_vector(infos)
        )

    def _step(self, t: int) -> Arrays:
        actions = batch_action(self.workspace, t, self.input, self.action_space, self.num_envs)
        over = np.count_nonzero(self._over)  # any() takes ten times as long
        if over == self.num_envs:
            return {**_copies(self._last), "reward": np.zeros(self.num_envs, self._floats)}
        observations, rewards, terminated, truncated, infos = self.envs.step(actions)
        packed, recorded = self._packed(observations), self._infos.of_vector(infos)
        terminated, truncated = np.array(terminated, dtype=bool), np.array(truncated, dtype=bool)
        rewards = np.array(rewards, dtype=np.float64)
        if self._mode != AutoresetMode.NEXT_STEP and np.count_nonzero(terminated | truncated | self._due):
            self._turn(packed, rewards, terminated, truncated, infos, recorded)
        np.add(self._cumulated, rewards, out=self._cumulated)
        np.add(self._timestep, 1, out=self._timestep)
        frame = self._frame(packed, rewards, terminated, truncated, recorded)
        if not self.auto_reset:
            if over:  # repeat the last values, with reward 0
                _replace(frame, self._last, self._over)
                frame["reward"][self._over] = 0
            self._over, self._last = frame["done"].copy(), _copies(frame)
            return frame
        done = frame["done"]
        if self._mode != AutoresetMode.NEXT_STEP and self.include_last_state:
            self._due[:] = done
        if np.count_nonzero(done):
            self._cumulated[done] = 0
            self._timestep[done] = -1  # so that the reset is step 0
        return frame

    def _turn(
        self, packed: Arrays, rewards: Array, terminated: Array, truncated: Array, infos: Any, recorded: Arrays
    ) -> None:
        """Put the last observation where episodes end, and the first where they begin; changes its arguments."""
        begin = self._due.copy()  # these have taken a step of the episode whose first observation is due
        ended = terminated | truncated
        if self._mode == AutoresetMode.SAME_STEP and ended.any():
            if self.include_last_state:
                self._take_final(packed, ended, infos)
            if "final_info" in infos:
                _replace(recorded, self._infos.of_vector(infos["final_info"]), ended)
        again = begin | ended if self._mode == AutoresetMode.DISABLED else begin
        if not again.any():
            return
        observations, first_infos = self.envs.reset(options={"reset_mask": again.copy()})
        first, others = self._packed(observations), ~(again | ended)
        if any(first[name][others].tobytes() != packed[name][others].tobytes() for name in packed):
            raise LoopError(
                f'{self.envs} does not obey reset(options={{"reset_mask": ...}}): it changed other environments.'
            )
        _replace(packed, first, begin if self.include_last_state else again)
        if begin.any():
            _replace(recorded, self._infos.of_vector(first_infos), begin)
        rewards[begin], terminated[begin], truncated[begin] = 0, False, False

    def _take_final(self, packed: Arrays, ended: Array, infos: Mapping[str, Any]) -> None:
        """Put the last observation into `packed` where episodes ended."""
        if "final_obs" not in infos:
            raise LoopError(f'{self.envs} is AutoresetMode.SAME_STEP but gave no infos["final_obs"] at an end.')
        final = infos["final_obs"]
        if not (isinstance(final, np.ndarray) and final.dtype == object):
            _replace(packed, self._packed(final), ended)
            return
        for k in np.flatnonzero(ended):  # one observation for each that ended
            parts = flat(final[k])
            for name, array in packed.items():
                array[k] = pick(parts, name)

    def _packed(self, observations: Any) -> Arrays:
        """Copies of the observations' arrays (n, ...) by variable, in the dtype of the variable."""
        parts = flat(observations)
        return {name: np.array(pick(parts, name), dtype=kind.dtype) for name, kind in self._kinds.items()}

    def __getstate__(self) -> dict[str, Any]:
        """A copy makes new environments at its next t = 0: processes and simulators cannot be copied."""
        return {**super().__getstate__(), "envs": None, "_running": False}


def _copies(arrays: Arrays) -> Arrays:
    return {name: array.copy() for name, array in arrays.items()}


def _replace(new: Arrays, old: Arrays, chosen: Array) -> None:
    """Copy the environments `chosen` (n,) bool from `old` to `new`, or zeros for variables that `old` lacks."""
    for name, array in old.items():
        new.setdefault(name, np.zeros_like(array))
    for name, array in new.items():
        array[chosen] = old[name][chosen] if name in old else 0
