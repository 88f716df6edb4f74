"""Single Gymnasium environments as one agent: BBRL's `ParallelGymAgent`, bit for bit, several times as fast.

Differences from bbrl 1.0.1:

- A missing action, one for another number of environments, of another shape than the action space or out of a Discrete
  space's range, and an observation that is no array, number or dict of them, are exceptions that name the variable.
- What environments give is written in the dtype of the table below, whatever its Python type: NumPy integers as int64
  (BBRL: float32), float16 as float32 (BBRL: int64), flags as bool (BBRL: int64 where an environment gives 0 and 1).
- `seed` in the call, `info_keys`, `arrays="numpy"`, `close`.
- With `reward_at_t` the cumulated reward at two times is two tensors, not one.

Kept though odd: with ``include_last_state=False`` timestep is one short from the second episode on; the seeds of the
environments depend on the number of resets; rewards that are NumPy float32 are summed in float32.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.safety.gate import SafeRobot
from bam_train.errors import SettingsError, ValueMismatch
from bam_train.loop.gym.actions import ActionReader
from bam_train.loop.gym.env_rows import EnvRows, Rows, has_autoreset
from bam_train.loop.gym.gym_agent import GymAgent
from bam_train.loop.gym.infos import InfoRecorder
from bam_train.loop.gym.observations import Entry, entries, pack
from bam_train.loop.gym.peeling import Env


class ParallelGymAgent(GymAgent):
    """Resets n environments at t = 0, and at t > 0 steps each with its action of t - 1.

    It is auto-resetting if a Gymnasium `Autoreset` wrapper is in the first environment's chain. Then the row after the
    one at which an episode ends is the first of the next, with reward 0; the action at the ended row is not used.
    Otherwise an ended row is repeated with reward 0 until the caller stops.

    ========================  ===============================  ======================================================
    variable                  dtype and shape (B = num_envs)   value
    ========================  ===============================  ======================================================
    env/env_obs               float32 or int64, B x ...        the observation after the step
    env/env_obs/<key>/<key>   float32 or int64, B x ...        instead of it, for dict observations
    env/terminated            bool, B                          the task's end
    env/truncated             bool, B                          the time limit's
    env/done                  bool, B                          either
    env/reward                float32, B                       of action[t - 1]; 0 at a reset
    env/cumulated_reward      float32, B                       sum of the episode's rewards, this one included
    env/timestep              int64, B                         steps since the reset
    ========================  ===============================  ======================================================

    Args:
        make_env_fn: Called `num_envs` times with `make_env_args`.
        num_envs: How many environments.
        make_env_args: Keywords of `make_env_fn`.
        args: For classes that are inherited beside this one.
        kwargs: See `GymAgent`.

    Raises:
        SettingsError: `num_envs` is not at least 1.
    """

    def __init__(
        self,
        make_env_fn: Callable[..., Env],
        num_envs: int,
        make_env_args: Mapping[str, Any] | None = None,
        *args: Any,
        **kwargs: Any,
    ) -> None:
        if "autoreset" in kwargs or "auto_reset" in kwargs:
            raise SettingsError(
                "ParallelGymAgent begins new episodes where the environment has Gymnasium's Autoreset wrapper: "
                "give autoreset=True to make_env, not to it."
            )
        super().__init__(*args, **kwargs)
        if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise SettingsError(f"num_envs: expected a whole number of at least 1, found {num_envs!r}.")
        self.num_envs = int(num_envs)
        self.make_env_fn, self._make_env_args = make_env_fn, dict(make_env_args or {})
        self._rows: EnvRows | None = None
        self._entries: list[Entry] = []
        self._infos = InfoRecorder(self.info_keys, self.num_envs, self.arrays == "torch") if self.info_keys else None
        self._open()

    def _open(self) -> None:
        """Make the environments and look at their spaces."""
        self._closed = False
        self.envs: list[Env] = [self._make() for _ in range(self.num_envs)]
        _require_envs(self.envs)
        self.observation_space = self.envs[0].observation_space
        self.action_space = self.envs[0].action_space
        self._is_autoreset = has_autoreset(self.envs[0])
        if not self._is_autoreset:
            self.include_last_state = True
        self._actions = ActionReader(self.input, self.action_space, self.num_envs)
        self._declare(ParallelGymAgent, reads=None, writes=self._written())

    def _make(self) -> Env:
        if not callable(self.make_env_fn):
            raise SettingsError(
                f"make_env_fn: expected a function that makes an environment, found {self.make_env_fn!r}; "
                f'write partial(make_env, "CartPole-v1") or a lambda.'
            )
        return self.make_env_fn(**self._make_env_args)

    def close(self) -> None:
        """Close the environments; they are made anew at the next t = 0."""
        self._rows = None
        if self._closed:
            return
        self._closed = True
        with ExitStack() as stack:  # all of them, also when one fails
            for env in self.envs:
                stack.callback(env.close)

    def forward(self, t: int = 0, **kwargs: Any) -> None:
        """One step of every environment with the action of t - 1; at t = 0 all are reset.

        Args:
            t: The time.
            kwargs: ``seed``: at t = 0, what environment k is reset with: a number s for s + k, or one number for
                each. Without it BBRL's rule holds: num_envs * r * seed + k + 1, r counting the resets from 2. Other
                keywords are not looked at.

        Raises:
            LoopError: t > 0 and the environments were never reset, or closed since.
            UnknownVariable: t > 0 and nobody wrote an action.
            ValueMismatch: The action does not fit the action space.
        """
        if t == 0:
            super().forward(t, **kwargs)
            rows = self._reset(kwargs.get("seed"))
        elif self._rows is None:
            raise self._not_open()
        else:
            rows = self._rows.step(self._actions.rows(self.workspace, t - 1))
        to_array = self._to_array
        observations = {entry.name: to_array(pack(entry, rows.observations)) for entry in self._entries}
        numbers = self._numbers(rows)
        infos = {} if self._infos is None else self._infos.of_rows(rows.infos)
        self.set_obs(observations, t)  # once all is known to be right
        self.set_numbers(numbers, t)
        if infos:
            self.set_obs({name: to_array(one) for name, one in infos.items()}, t)

    def _reset(self, seed: Any) -> Rows:
        if self._closed:
            self._open()
        seeds = self._row_seeds(seed)
        each = [seeds + k for k in range(self.num_envs)] if isinstance(seeds, int) else seeds
        self._rows = EnvRows(self.envs, self._is_autoreset, self.include_last_state)
        rows = self._rows.reset(each)
        self._entries = entries(rows.observations[0], self.observation_space, self.arrays == "torch")
        return rows

    def _numbers(self, rows: Rows) -> dict[str, Any]:
        """One number for each environment, in the order in which the variables are written first.

        Raises:
            ValueMismatch: A reward is no number.
        """
        terminated, truncated, rewards = rows.terminated, rows.truncated, rows.rewards
        done = [a or b for a, b in zip(terminated, truncated, strict=True)] if any(truncated) else terminated
        if type(rewards[0]) is not float and np.ndim(rewards) != 1:
            raise ValueMismatch(f"'reward': expected one number from each environment, found {rewards[0]!r}.")
        return {
            "terminated": terminated,
            "truncated": truncated,
            "done": done,
            "reward": rewards,
            "cumulated_reward": rows.cumulated,
            "timestep": rows.timestep,
        }

    @staticmethod
    def _format_frame(frame: Any) -> dict[str, Any]:
        """One observation as tensors with a batch dimension of 1, by the names of its variables without prefix."""
        import torch

        found = entries(frame, None, for_torch=True)
        return {entry.name: torch.from_numpy(pack(entry, [frame])) for entry in found}


def _require_envs(envs: Sequence[Any]) -> None:
    """Refuse what cannot be stepped one by one.

    Raises:
        SettingsError: Not an environment, a vector environment, one environment several times, or a live robot, whose
            chain has to be checked before it moves.
    """
    for env in envs:
        if isinstance(env, gym.vector.VectorEnv):
            raise SettingsError("make_env_fn: expected single environments, found a vector one: use VecGymAgent.")
        if not all(hasattr(env, name) for name in ("reset", "step", "observation_space", "action_space")):
            raise SettingsError(f"make_env_fn: expected it to return a gymnasium.Env, found {type(env).__name__}.")
        if isinstance(getattr(getattr(env, "unwrapped", env), "robot", None), SafeRobot):
            raise SettingsError("make_env_fn: expected a simulation, found a live robot: use RobotAgent.")
    if len({id(env) for env in envs}) < len(envs):
        raise SettingsError("make_env_fn: expected a new environment at every call, found the same one again.")
