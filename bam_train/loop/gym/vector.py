"""A Gymnasium vector environment as an agent.

Differences from bbrl 1.0.1's `VecGymAgent`, which fails with more than one environment and never restarts
cumulated_reward: any number of environments, timestep, dict observations and actions, rows that mean what
`ParallelGymAgent`'s do in every autoreset mode, and its seeds: row k is reset with num_envs * r * seed + k + 1 (BBRL's
VecGymAgent: r * seed + k). Rewards are summed in float64.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from gymnasium.vector import AutoresetMode, VectorEnv

from bam_train.errors import SettingsError
from bam_train.loop.gym.actions import ActionReader
from bam_train.loop.gym.gym_agent import GymAgent
from bam_train.loop.gym.infos import InfoRecorder
from bam_train.loop.gym.vector_rows import VectorRows, autoreset_mode


class VecGymAgent(GymAgent):
    """Resets a vector environment at t = 0, and at t > 0 steps it with the actions of t - 1.

    It writes the variables of `ParallelGymAgent`, with the same meaning: see there. Vector environments that reset
    ended rows in the same step, or not at all, must obey ``reset(options={"reset_mask": (n,) bool})``, as Gymnasium's
    `SyncVectorEnv` and `AsyncVectorEnv` and ours do; at the end of an episode their row is reset twice.

    Args:
        make_envs_fn: Makes the vector environment.
        vec_env_args: Keywords of `make_envs_fn`.
        args: For classes that are inherited beside this one.
        auto_reset: False repeats the last frame of an ended row, with reward 0, until the caller stops.
        kwargs: See `GymAgent`.

    Raises:
        SettingsError: The environment does not say in its metadata what it does with ended rows, or resets them in
            the next step and `include_last_state` is False.
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
        self._rows: VectorRows | None = None
        self._open()

    def _open(self) -> None:
        """Make the environment and look at its spaces."""
        self.envs: Any = self.make_envs_fn(**self._vec_env_args)
        if not isinstance(self.envs, VectorEnv):
            raise SettingsError(
                f"make_envs_fn: expected it to return a gymnasium.vector.VectorEnv, found {type(self.envs).__name__}; "
                f"single environments are ParallelGymAgent's."
            )
        self.num_envs = self.envs.num_envs
        self.observation_space = self.envs.single_observation_space
        self.action_space = self.envs.single_action_space
        try:
            self._mode = autoreset_mode(self.envs)
            if self._mode == AutoresetMode.NEXT_STEP and not self.include_last_state:
                raise SettingsError(
                    f"include_last_state=False: {self.envs} resets ended rows in the next step "
                    "(AutoresetMode.NEXT_STEP), so their last "
                    "observation cannot be left out; make it with AutoresetMode.SAME_STEP."
                )
        except SettingsError:
            self.envs.close()
            raise
        self._actions = ActionReader(self.input, self.envs.single_action_space, self.num_envs)
        if self.info_keys:
            self._infos = InfoRecorder(self.info_keys, self.num_envs, self.arrays == "torch")
        self._declare(VecGymAgent, reads=None, writes=self._written())

    def close(self) -> None:
        """Close the environment; it is made anew at the next t = 0."""
        self._rows = None
        if self.envs is not None:
            self.envs.close()
            self.envs = None

    def __getstate__(self) -> dict[str, Any]:
        """A copy makes its own environment at its next t = 0: processes and simulators cannot be copied."""
        return {**super().__getstate__(), "envs": None, "_rows": None}

    def forward(self, t: int = 0, **kwargs: Any) -> None:
        """One step of every row with the actions of t - 1; at t = 0 all are reset.

        Args:
            t: The time.
            kwargs: ``seed``: at t = 0, what the environment is reset with: a number s for s + k in row k, or a list
                of one for each, where the environment takes lists. Without it, num_envs * r * seed + k + 1, r
                counting the resets from 2. Other keywords are not looked at.

        Raises:
            LoopError: t > 0 and the environment was never reset, or closed since.
            UnknownVariable: t > 0 and nobody wrote an action.
            ValueMismatch: The action does not fit the action space.
        """
        if t == 0:
            super().forward(t, **kwargs)
            frame = self._reset(kwargs.get("seed"))
        elif self._rows is None:
            raise self._not_open()
        else:
            frame = self._rows.step(self._actions.batch(self.workspace, t - 1))
        self._write(frame, t)

    def _write(self, frame: dict[str, Any], t: int) -> None:
        """The variables in the order of `ParallelGymAgent`'s: observation, numbers, infos."""
        numbers = {name: frame.pop(name) for name in self._dtypes}
        infos = {name: frame.pop(name) for name in list(frame) if name.startswith("info/")}
        self.set_obs({name: self._to_array(array) for name, array in frame.items()}, t)
        self.set_numbers(numbers, t)
        if infos:
            self.set_obs({name: self._to_array(array) for name, array in infos.items()}, t)

    def _reset(self, seed: Any) -> dict[str, Any]:
        if self.envs is None:
            self._open()
        self._rows = VectorRows(
            self.envs, self._mode, self.auto_reset, self.include_last_state, self._infos, self.arrays == "torch"
        )
        return self._rows.reset(self._row_seeds(seed))
