"""The running statistics of observations: RLlib's filter, for a batch of observations and with exact merges."""

from typing import Any

import numpy as np
import tree  # of dm-tree, which RLlib needs
from numpy.typing import NDArray
from ray.rllib.connectors.env_to_module.mean_std_filter import MeanStdFilter as _MeanStdFilter
from ray.rllib.utils.filter import RunningStat
from ray.rllib.utils.numpy import SMALL_NUMBER

from bam_train.trainers.rllib.rllib_state import unpacked_array

Array = NDArray[Any]


class MeanStdFilter(_MeanStdFilter):  # type: ignore[misc]
    """RLlib's filter with `normalize` for an array of n observations; same name, state and files.

    A runner sends its observations since the last merge as "deltas", which `RunningStat.update` expects to be the
    count, mean and sum of squares of those observations alone. RLlib's `RunningStat.push` instead stores the change of
    the overall mean in them, so that with remote runners the merged mean approaches 0. Here the deltas are as the merge
    expects.
    """

    def normalize(self, observations: Array, update: bool = True) -> NDArray[np.float32]:
        """Normalise observations, (n, ...), after adding them to the statistics unless `update` is False."""
        if self._filters is None:
            self._init_new_filters()
        options = self._filters[None]
        stat: RunningStat = options.running_stats
        if update and self._update_stats and len(observations):
            push(stat, observations)
        value = observations - stat.mean if options.demean else observations
        if options.destd:
            value = value / (stat.std + SMALL_NUMBER)
        return np.asarray(np.clip(value, -options.clip, options.clip) if options.clip else value, np.float32)

    def __call__(self, *, episodes: list[Any], **kwargs: Any) -> Any:
        """As RLlib's, for one observation at a time, with the deltas that a merge expects."""
        if self._filters is None:
            self._init_new_filters()
        if None not in self._filters or not isinstance(self._filters[None].running_stats, RunningStat):
            return super().__call__(episodes=episodes, **kwargs)
        for episode in self.single_agent_episode_iterator(episodes):
            observation = np.asarray(episode.get_observations(indices=-1))
            filtered = self.normalize(observation[None])[0].astype(observation.dtype)
            episode.set_observations(at_indices=-1, new_data=filtered)
            episode.observation_space = self.observation_space
        return kwargs["batch"]

    def set_state(self, state: Any) -> None:
        """As RLlib's, without the deltas of the sender, which would be counted twice.

        Raises:
            FormatError: A packed array holds more than numbers, which RLlib would unpickle.
        """
        for text in tree.flatten(state):
            if isinstance(text, str):
                unpacked_array(text)
        super().set_state(state)
        for filter_ in self._filters.values():
            for stat in tree.flatten(filter_.running_stats):
                forget_deltas(stat)


def forget_deltas(stat: RunningStat) -> None:
    """Reset the deltas: the next merge gets only later observations."""
    stat.num_pushes_delta = 0
    stat.mean_delta_array = np.zeros_like(stat.mean_delta_array)
    stat.sum_sq_diff_delta_array = np.zeros_like(stat.sum_sq_diff_delta_array)


def push(stat: RunningStat, observations: Array) -> None:
    """Add observations (n, ...) to the statistics and to the deltas of the next merge.

    Counts, means and sums of squares of two sets combine exactly (Chan, Golub and LeVeque 1979).
    """
    new = observations.astype(np.float64)
    n, new_mean = len(new), new.mean(axis=0)
    new_squares = np.square(new - new_mean).sum(axis=0)

    def combine(count: int, mean: Array, squares: Array) -> int:
        total, delta = count + n, new_mean - mean
        mean += delta * (n / total)
        squares += new_squares + np.square(delta) * (count * n / total)
        return total

    stat.num_pushes = combine(stat.num_pushes, stat.mean_array, stat.sum_sq_diff_array)
    stat.num_pushes_delta = combine(stat.num_pushes_delta, stat.mean_delta_array, stat.sum_sq_diff_delta_array)
