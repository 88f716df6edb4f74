"""Episodes of our runner against the environment stepped by hand, and its filter against RLlib's."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ray")

import gymnasium as gym
from ray.rllib.connectors.env_to_module.mean_std_filter import MeanStdFilter as Theirs
from ray.rllib.utils.filter import RunningStat

from bam_train.environments import make_rows
from bam_train.trainers.rllib.sampling.filters import MeanStdFilter, push
from bam_train.trainers.rllib.sampling.rows import Rollout, Running

BOX = gym.spaces.Box(-10, 10, (2,), np.float32)


def test_rows_are_cut_into_episodes_with_their_last_observations():
    rollout, running = Rollout(2, 4, np.zeros((2, 2), np.float32)), Running(2)
    ids = list(running.ids)
    for t in range(4):
        ended = np.array([t == 1, False])
        if ended.any():
            rollout.end(np.array([0]), np.full((1, 2), 9, np.float32), np.array([True, False]))
        following = np.full((2, 2), t + 1, np.float32)
        rollout.add({"actions": np.full((2, 1), t, np.float32)}, np.array([1.0, 2.0]), ended, ~ended & False, following)
    episodes, ends = rollout.episodes(running, BOX, gym.spaces.Box(-1, 1, (1,), np.float32), {"weights_seq_no": 7})
    assert [(episode.id_, len(episode), episode.is_terminated) for episode in episodes] == [
        (ids[0], 2, True),
        (running.ids[0], 2, False),
        (ids[1], 4, False),
    ]
    assert episodes[0].get_observations()[:, 0].tolist() == [0, 1, 9]
    assert episodes[1].get_observations()[:, 0].tolist() == [2, 3, 4]
    assert episodes[1].get_actions()[:, 0].tolist() == [2, 3]
    assert episodes[2].get_extra_model_outputs("weights_seq_no").tolist() == [7] * 4
    assert [(end.length, end.total, end.success) for end in ends] == [(2, 2.0, True)]
    assert (running.lengths.tolist(), running.returns.tolist()) == ([2, 4], [2.0, 8.0])


def test_the_next_piece_goes_on_with_its_episode():
    running, action = Running(1), gym.spaces.Discrete(2)
    pieces = []
    for start in (0.0, 1.0):
        rollout = Rollout(1, 1, np.full((1, 2), start, np.float32))
        no = np.zeros(1, bool)
        rollout.add({"actions": np.zeros(1, np.int64)}, np.ones(1), no, no, np.full((1, 2), start + 1, np.float32))
        pieces += rollout.episodes(running, BOX, action, {})[0]
    pieces[0].concat_episode(pieces[1])
    assert pieces[0].get_observations()[:, 0].tolist() == [0, 1, 2]


def test_counting_many_at_once_is_counting_one_by_one():
    observations = np.random.default_rng(0).normal(3, 2, (40, 2))
    one, many = RunningStat((2,)), RunningStat((2,))
    for row in observations:
        one.push(row)
    push(many, observations[:25])
    push(many, observations[25:])
    assert many.num_pushes == one.num_pushes == 40
    assert np.allclose(many.mean, one.mean)
    assert np.allclose(many.std, one.std)


def test_merging_two_runners_is_counting_all():
    """RLlib's own filter comes out with another mean."""
    observations = np.random.default_rng(0).normal(3, 2, (2, 30, 2)).astype(np.float32)
    merged, *runners = [MeanStdFilter() for _ in range(3)]
    for one in (merged, *runners):
        one.input_observation_space = BOX
    for part in (slice(0, 10), slice(10, 30)):
        for runner, rows in zip(runners, observations, strict=True):
            runner.rows(rows[part])
        state = merged.merge_states([runner.get_state() for runner in runners])
        merged.set_state(state)
        for runner in runners:
            runner.set_state(state)
    stat = merged._filters[None].running_stats
    flat = observations.reshape(-1, 2).astype(np.float64)
    assert stat.num_pushes == 60
    assert np.allclose(stat.mean, flat.mean(0))
    assert np.allclose(stat.std, flat.std(0, ddof=1))
    assert type(merged).__name__ == Theirs.__name__


def test_rows_of_ours_restart_in_the_same_step():
    rows = make_rows("bam/reach-v0", {}, 2)
    assert rows.metadata["autoreset_mode"].value == "SameStep"
    rows.close()
