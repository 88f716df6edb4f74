"""RLlib's `MeanStdFilter`, for a batch at once, and right where several runners are merged.

A runner sends what it saw since the last merge as "deltas", which `RunningStat.update` takes for the count, mean and
sum of squares of those observations alone. RLlib's own `RunningStat.push` writes into them how far the overall mean
moved, so that with remote runners its merged mean goes towards 0. Here they are what the merge expects.
"""

from typing import Any

import numpy as np
import tree  # of dm-tree, which RLlib needs
from numpy.typing import NDArray
from ray.rllib.connectors.env_to_module.mean_std_filter import MeanStdFilter as _MeanStdFilter
from ray.rllib.utils.filter import RunningStat
from ray.rllib.utils.numpy import SMALL_NUMBER

from bam_train.trainers.rllib.state_pickles import unpacked_array

Array = NDArray[Any]


class MeanStdFilter(_MeanStdFilter):  # type: ignore[misc]
    """RLlib's filter, which `normalize` runs over n observations of one array at once. Same name, state and files."""

    def normalize(self, observations: Array, update: bool = True) -> NDArray[np.float32]:
        """Normalise observations, (n, ...), and count them in first unless `update` is False."""
        if self._filters is None:
            self._init_new_filters()
        own = self._filters[None]
        stat: RunningStat = own.running_stats
        if update and self._update_stats and len(observations):
            push(stat, observations)
        value = observations - stat.mean if own.demean else observations
        if own.destd:
            value = value / (stat.std + SMALL_NUMBER)
        return np.asarray(np.clip(value, -own.clip, own.clip) if own.clip else value, np.float32)

    def __call__(self, *, episodes: list[Any], **kwargs: Any) -> Any:
        """As RLlib's, one observation after the other, with the deltas that a merge expects."""
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
        """As RLlib's, but for the deltas of the sender, which would be counted twice.

        Raises:
            FormatError: A packed array holds more than numbers, which RLlib would unpickle.
        """
        for text in tree.flatten(state):
            if isinstance(text, str):
                unpacked_array(text)
        super().set_state(state)
        for own in self._filters.values():
            for stat in tree.flatten(own.running_stats):
                forget_deltas(stat)


def forget_deltas(stat: RunningStat) -> None:
    """The next merge is sent what comes from here on."""
    stat.num_pushes_delta = 0
    stat.mean_delta_array = np.zeros_like(stat.mean_delta_array)
    stat.sum_sq_diff_delta_array = np.zeros_like(stat.sum_sq_diff_delta_array)


def push(stat: RunningStat, observations: Array) -> None:
    """Count observations (n, ...) into the statistics and into what the next merge is sent.

    Counts, means and sums of squares of two sets combine exactly (Chan, Golub and LeVeque 1979).
    """
    new = observations.astype(np.float64)
    n, new_mean = len(new), new.mean(axis=0)
    new_squares = np.square(new - new_mean).sum(axis=0)

    def combine(count: int, mean: Array, squares: Array) -> int:
        both, delta = count + n, new_mean - mean
        mean += delta * (n / both)
        squares += new_squares + np.square(delta) * (count * n / both)
        return both

    stat.num_pushes = combine(stat.num_pushes, stat.mean_array, stat.sum_sq_diff_array)
    stat.num_pushes_delta = combine(stat.num_pushes_delta, stat.mean_delta_array, stat.sum_sq_diff_delta_array)
