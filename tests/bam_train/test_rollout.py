"""One way to play a policy: whole episodes, their numbers, what is kept of them, and how environments restart."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from bam_train.environments import make_vector_env
from bam_train.rollout import PlayedEpisode, last_observations, play, rollout, success_of


class Right:
    """Goes right; remembers what it saw and which environments it was told to forget."""

    def __init__(self):
        self.seen, self.forgotten = [], []

    def reset(self, env_ids=None):
        self.forgotten.append(None if env_ids is None else env_ids.tolist())

    def act_batch(self, observations):
        self.seen.append(np.array(observations))
        return np.ones(len(observations), np.int64)


@pytest.fixture
def three(corridor):
    envs = make_vector_env(corridor, None, 3)
    yield envs
    envs.close()


def test_the_episodes_that_begin_first_are_yielded_as_they_end(three, starting_cell):
    """Episode k of the first three has seed 7 + k; the fourth began where the first of them ended."""
    lengths = [4 - starting_cell(seed) for seed in (7, 8, 9)]
    ended = list(rollout(three, Right(), seed=7, keep=lambda number: number < 4))
    assert len(ended) == 4
    first = sorted((one for one in ended if one.seed is not None), key=lambda one: one.seed)
    assert first == [PlayedEpisode(7 + k, 1 - 0.25 * n, n, True, k) for k, n in enumerate(lengths)]
    (fourth,) = (one for one in ended if one.seed is None)
    assert fourth.env_id == int(np.argmin(lengths))


def test_what_is_kept_of_each_step(three):
    """Observations, and a number for each environment; nothing by default."""
    policy, clock = Right(), iter(range(100))

    def parts(observations, actions):
        return observations, np.full(3, next(clock)) + 10 * actions

    for episode in rollout(three, policy, seed=0, keep=lambda number: number < 6, parts=parts):
        seen, times = episode.parts
        assert len(seen) == len(times) == episode.length
        begun = int(times[0]) - 10
        assert times.tolist() == list(range(begun + 10, begun + 10 + episode.length))
        np.testing.assert_array_equal(seen, [policy.seen[begun + k][episode.env_id] for k in range(episode.length)])
    assert next(rollout(three, policy, seed=0)).parts == ()


def test_an_end_may_depend_on_the_episodes_before(three):
    steps, ended = 0, []
    played = rollout(three, Right(), seed=0, keep=lambda _: steps < 10)
    for episode in played:
        steps += episode.length
        ended.append(episode)
    assert steps >= 10
    assert steps - sum(one.length for one in ended[-3:]) < 10
    assert list(rollout(three, Right(), seed=0, limit=0)) == []


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_both_ways_to_restart_are_the_same_to_a_policy(corridor, mode):
    envs = SyncVectorEnv([lambda: gym.make(corridor)] * 2, autoreset_mode=mode)
    policy, steps = Right(), []
    for step in play(envs, policy, seed=7):
        steps.append(step)
        if len(steps) == 8:
            break
    twin = Right()
    expected = make_vector_env(corridor, None, 2)
    for one, step in zip(steps, play(expected, twin, seed=7), strict=False):
        np.testing.assert_array_equal(one.following, step.following)
        np.testing.assert_array_equal(one.rewards, step.rewards)
        assert one.ended == step.ended
    np.testing.assert_array_equal(policy.seen, twin.seen[:8])
    assert policy.forgotten == twin.forgotten[: len(policy.forgotten)]
    envs.close()
    expected.close()


def test_success_is_that_of_the_last_info():
    ended = {"is_success": np.array([True, True]), "_is_success": np.array([True, False])}
    infos = {"is_success": np.array([False, False]), "final_info": ended}
    assert [success_of(infos, i) for i in (0, 1)] == [True, None]
    assert success_of({"is_success": np.array([True])}, 0) is True
    assert success_of({}, 0) is None


def test_last_observations_are_nested_as_the_others():
    """Gymnasium gives an array of one observation for each environment; ours gives arrays of all."""
    seen = {"a": np.zeros((2, 1)), "b": (np.zeros(2), np.ones(2))}
    last = {"a": np.full((2, 1), 5.0), "b": (np.full(2, 6.0), np.full(2, 7.0))}
    each = np.array([None, {"a": np.array([5.0]), "b": (6.0, 7.0)}], object)
    for final in (last, each):
        found = last_observations(seen, {"final_obs": final}, np.array([False, True]))
        assert (found["a"].tolist(), [one.tolist() for one in found["b"]]) == ([[0.0], [5.0]], [[0.0, 6.0], [1.0, 7.0]])
    assert last_observations(seen, {}, np.array([False, False])) is seen
