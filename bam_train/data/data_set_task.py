"""A data set as an environment: a recorded observation, one action, a reward; what `bam/dataset` is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.spaces import indexed
from bam_envs.core.task import Array, Label, Score
from bam_envs.core.validation import NonNegative, check
from bam_envs.core.wording import brief
from bam_envs.local.local_task import LocalTask, one_step
from bam_train.data.data_set import DataSet
from bam_train.data.recorded_episode import Transitions
from bam_train.data.selection import split as split_episodes
from bam_train.errors import BadDataSet, BamTrainError

TRAIN_SHARE = 0.8
"""Share of the episodes that are of the training split."""
_ARRAYS = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete)


class DataSetTask(LocalTask):
    """Do what was done, or labelled, in one step of a data set.

    Action:
        As in the data set.

    Start:
        The observation of one of the steps of the split, uniformly. The split of an episode follows from its digest,
        as in `bam-data split`, so that training and test never mix, also when episodes are added.

    Reward:
        The recorded reward if the action is the recorded one, else 0; with `reward="match"` 1 or 0.

    Success:
        The action is the recorded one; of numbers, none is farther from it than `tolerance`.

    End:
        Terminated after one step.

    Info:
        `recorded_reward`.

    Args:
        data: Place of the data set, here or in a bucket.
        split: ``"train"``, about 80 % of the episodes, ``"test"``, the others, or ``"all"``.
        reward: ``"logged"`` or ``"match"``.
        tolerance: Greatest distance from the recorded action, where actions are no whole numbers.
    """

    memory: Mapping[str, str] = {"drawn": "drawn"}

    def __init__(
        self,
        num_envs: int = 1,
        *,
        data: str = "",
        split: Literal["train", "test", "all"] = "train",
        reward: Literal["logged", "match"] = "logged",
        tolerance: float = 0.1,
    ) -> None:
        super().__init__(num_envs)
        if not data:
            raise InvalidValue("bam/dataset-v0 needs a data set: give its place with data=")
        self.split = check(split, Literal["train", "test", "all"], "split")
        self.reward = check(reward, Literal["logged", "match"], "reward")
        self.tolerance = check(tolerance, NonNegative, "tolerance")
        try:
            self.data = DataSet.open(str(data))
        except BamTrainError as error:
            raise InvalidValue(f"bam/dataset-v0: {error}") from error
        self.observation_space, self.action_space = self.data.info.observation_space, self.data.info.action_space
        observed = self.observation_space.spaces if isinstance(self.observation_space, spaces.Dict) else {}
        for space in (*(observed.values() or [self.observation_space]), self.action_space):
            if not isinstance(space, _ARRAYS):
                raise InvalidValue(
                    f"bam/dataset-v0: {data} has the space {brief(space)}; expected arrays, or a Dict of them"
                )
        self.observation_labels = tuple(Label(name, "as recorded", "") for name in observed or ["observation"])
        self.action_labels = (Label("action", "as recorded", ""),)
        self.drawn = np.zeros(num_envs, np.int64)
        """Which step of the split. Shape: (n,)."""

    @cached_property
    def steps(self) -> Transitions:
        """All steps of the split, in memory."""
        train, test = split_episodes(self.data, TRAIN_SHARE)
        chosen = {"train": train, "test": test, "all": None}[self.split]
        if chosen == []:
            raise InvalidValue(f"bam/dataset-v0: {self.data.place} has no episode of the split {self.split!r}")
        try:
            return self.data.transitions(chosen)
        except BadDataSet as error:
            raise InvalidValue(f"bam/dataset-v0: {error}") from error

    @property
    def num_starts(self) -> int:
        """How many steps there are; `drawn` says which is shown."""
        return len(self.steps.rewards)

    def begin(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> None:
        """Draw a step."""
        count = self.num_starts
        self.own_memory()
        self.drawn[env_ids] = [int(rng.integers(count)) for rng in rngs]

    def observe(self, state: RobotState) -> Any:
        """The recorded observations. Shape: (n, ...)."""
        return indexed(self.steps.observations, self.drawn)

    def score(self, state: RobotState, action: NDArray[Any]) -> Score:
        """Compare the actions with the recorded ones."""
        away = np.abs(action.astype(np.float64) - self.steps.actions[self.drawn]).reshape(self.num_envs, -1)
        limit = self.tolerance if isinstance(self.action_space, spaces.Box) else 0.0
        same = np.asarray((away <= limit).all(axis=1))
        recorded: Array = self.steps.rewards[self.drawn]
        return one_step(same, same * (recorded if self.reward == "logged" else 1.0), recorded_reward=recorded)
