"""A Gymnasium vector environment as rows with BBRL's meaning, whatever its autoreset mode.

With `include_last_state` the row at which an episode ends has the last observation, and the next one is a first
observation with reward 0:

==========  ==========================================================================================================
NEXT_STEP   does just this
SAME_STEP   the last observation is in ``infos["final_obs"]``. At the next time the environment is a step into the new
            episode; that step is thrown away: the row is reset again, by a reset mask
DISABLED    made SAME_STEP here, by a reset mask, so that no ended row is ever stepped
==========  ==========================================================================================================

Without it the row at which an episode ends has the first observation of the next: NEXT_STEP cannot do this. Without
auto-reset an ended row is repeated with reward 0, whatever the environment does underneath.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from bam_train.errors import LoopError, SettingsError
from bam_train.loop.gym.infos import InfoRecorder
from bam_train.loop.gym.observations import Entry, entries, pick

Array = NDArray[Any]
Frame = dict[str, Array]


def autoreset_mode(envs: Any) -> AutoresetMode:
    """What `envs` does with an ended row; to be asked before another vector environment is made.

    Gymnasium's own write their mode into a dict that all environments of one class share, so it may change later.

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


class VectorRows:
    """A vector environment, with the sums and counts of its episodes.

    Args:
        envs: The environment.
        mode: What it does with an ended row.
        auto_reset: Whether an ended episode is followed by a new one.
        include_last_state: See above.
        infos: Takes entries of the infos; None for none.
        for_torch: Observations of floats become float32 and of integers int64; else they have the space's dtype.
            Other floats are float64.
    """

    def __init__(
        self,
        envs: VectorEnv[Any, Any, Any],
        mode: AutoresetMode,
        auto_reset: bool,
        include_last_state: bool,
        infos: InfoRecorder | None,
        for_torch: bool,
    ) -> None:
        self._envs, self._mode, self._auto_reset, self._include_last = envs, mode, auto_reset, include_last_state
        self._infos, self._for_torch = infos, for_torch
        self._entries: list[Entry] = []
        n = envs.num_envs
        self._cumulated, self._timestep = np.zeros(n), np.zeros(n, dtype=np.int64)
        self._begin, self._over = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        self._advance: Any = 1
        self._last: Frame = {}
        self._turns = mode != AutoresetMode.NEXT_STEP
        # Whether a row is one step into its next episode when we want to see the first observation.
        self._ahead = self._turns and auto_reset and include_last_state

    def reset(self, seed: int | Sequence[int | None] | None) -> Frame:
        """Begin an episode on every row."""
        envs: Any = self._envs  # Any: several take a list of seeds
        observations, infos = envs.reset(seed=seed)
        zeros, no = np.zeros(len(self._begin)), np.zeros(len(self._begin), dtype=bool)
        self._entries = entries(_row(observations, 0), self._envs.single_observation_space, self._for_torch)
        return self._frame(self._packed(observations), zeros, no, no.copy(), self._recorded(infos))

    def step(self, actions: Any) -> Frame:
        """Step every row."""
        if np.count_nonzero(self._over) == len(self._over):
            return {**{name: array.copy() for name, array in self._last.items()}, "reward": self._last["reward"] * 0}
        observations, rewards, terminated, truncated, infos = self._envs.step(actions)
        frame = self._packed(observations)
        terminated, truncated = np.array(terminated, dtype=bool), np.array(truncated, dtype=bool)
        rewards, recorded = np.array(rewards, dtype=np.float64), self._recorded(infos)
        ended = terminated | truncated
        # count_nonzero: any() takes ten times as long.
        if self._turns and (np.count_nonzero(ended) or np.count_nonzero(self._begin)):
            self._turn(frame, rewards, terminated, truncated, infos, recorded)
        if not self._auto_reset:
            self._hold(frame, rewards, terminated, truncated, recorded)
        self._cumulated += rewards
        self._timestep += self._advance
        frame = self._frame(frame, rewards, terminated, truncated, recorded)
        self._after(frame)
        return frame

    # -- the row at which an episode ends, and the next ------------------------------------------------------------

    def _turn(
        self, frame: Frame, rewards: Array, terminated: Array, truncated: Array, infos: Any, recorded: Frame
    ) -> None:
        """Put the last observation where episodes end, and the first where they begin; changes what it is given."""
        begin = self._begin & self._ahead
        ended = terminated | truncated
        if self._mode == AutoresetMode.SAME_STEP:
            self._take_final(frame, ended, infos, recorded)
        again = begin | ended if self._mode == AutoresetMode.DISABLED else begin
        if not again.any():
            return
        first, first_infos = self._reset_rows(again, ~(again | ended), frame)
        shown = begin if self._include_last else again
        for name, array in first.items():
            frame[name][shown] = array[shown]
        if self._infos is not None and begin.any():
            self._infos.replaced(recorded, self._recorded(first_infos), begin)
        rewards[begin], terminated[begin], truncated[begin] = 0, False, False

    def _take_final(self, frame: Frame, ended: Array, infos: Mapping[str, Any], recorded: Frame) -> None:
        """Where rows ended: the last observation, if it is to be shown, and the last info.

        Raises:
            LoopError: The environment did not keep the last observation.
        """
        if not ended.any():
            return
        if self._include_last:
            if "final_obs" not in infos:
                raise LoopError(f'{self._envs} is AutoresetMode.SAME_STEP but gave no infos["final_obs"] at an end.')
            final = infos["final_obs"]
            each = isinstance(final, np.ndarray) and final.dtype == object
            for entry in self._entries:
                if each:
                    for row in np.flatnonzero(ended):
                        frame[entry.name][row] = pick(entry, final[row])
                else:
                    frame[entry.name][ended] = pick(entry, final)[ended]
        if self._infos is not None and "final_info" in infos:
            self._infos.replaced(recorded, self._recorded(infos["final_info"]), ended)

    def _reset_rows(self, rows: Array, others: Array, frame: Frame) -> tuple[Frame, Any]:
        """Reset these rows (n,) bool, and see that no other row was.

        Raises:
            LoopError: Another was.
        """
        observations, infos = self._envs.reset(options={"reset_mask": rows.copy()})
        first = self._packed(observations)
        if any(first[name][others].tobytes() != frame[name][others].tobytes() for name in frame):
            raise LoopError(f'{self._envs} does not obey reset(options={{"reset_mask": ...}}): it changed other rows.')
        return first, infos

    def _hold(self, frame: Frame, rewards: Array, terminated: Array, truncated: Array, recorded: Frame) -> None:
        """Repeat the last frame where episodes are over for good, with reward 0; changes what it is given."""
        over = self._over
        if not over.any():
            return
        for name in frame:
            frame[name][over] = self._last[name][over]
        terminated[over], truncated[over] = self._last["terminated"][over], self._last["truncated"][over]
        rewards[over] = 0
        if self._infos is not None:
            self._infos.replaced(recorded, self._last, over)

    def _after(self, frame: Frame) -> None:
        """Remember which rows ended."""
        done = frame["done"]
        if not self._auto_reset:
            self._over, self._advance = done.copy(), ~done
            self._last = {name: array.copy() for name, array in frame.items()}  # what is given away may change
            return
        if self._turns:
            self._begin = done.copy()
        if np.count_nonzero(done):
            self._cumulated[done] = 0
            self._timestep[done] = -1  # so that the reset is step 0

    # -- one frame -------------------------------------------------------------------------------------------------

    def _packed(self, observations: Any) -> Frame:
        """Copies of the observations' arrays by variable, in the dtype they are written as."""
        return {entry.name: np.array(pick(entry, observations), dtype=entry.dtype) for entry in self._entries}

    def _recorded(self, infos: Mapping[str, Any]) -> Frame:
        return {} if self._infos is None else self._infos.of_vector(infos)

    def _frame(self, frame: Frame, rewards: Array, terminated: Array, truncated: Array, recorded: Frame) -> Frame:
        frame["terminated"], frame["truncated"], frame["done"] = terminated, truncated, terminated | truncated
        frame["reward"], frame["cumulated_reward"] = rewards, self._cumulated.copy()
        frame["timestep"] = self._timestep.copy()
        frame.update(recorded)
        return frame


def _row(observations: Any, k: int) -> Any:
    """Row k of a batch of observations; dicts stay dicts."""
    if isinstance(observations, Mapping):
        return {key: _row(one, k) for key, one in observations.items()}
    if isinstance(observations, tuple):
        return observations
    return observations[k]
