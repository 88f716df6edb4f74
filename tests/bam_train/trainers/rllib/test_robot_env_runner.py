"""Episodes of our runner against the environment stepped by hand, and its filter against RLlib's."""

from __future__ import annotations

import itertools
import warnings

import numpy as np
import pytest

pytest.importorskip("ray")

import gymnasium as gym
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.env_to_module.mean_std_filter import MeanStdFilter as Theirs
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.utils.filter import RunningStat

from bam_train.environments import make_vector_env
from bam_train.trainers.rllib.mean_std_filter import MeanStdFilter, forget_deltas, push
from bam_train.trainers.rllib.rllib_registration import register
from bam_train.trainers.rllib.robot_env_runner import RobotEnvRunner, Rollout, Running

NETWORK = {"fcnet_hiddens": [16]}
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
            runner.normalize(rows[part])
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


def test_rllibs_own_filter_comes_out_with_another_mean():
    """Once it does not, `MeanStdFilter.__call__` and `push` can go."""
    merged, runner = RunningStat((2,)), RunningStat((2,))
    seen = np.random.default_rng(0).normal(3, 2, (60, 2))
    for start in (0, 30):
        for row in seen[start : start + 30]:
            runner.push(row)
        merged.update(runner)
        runner = merged.copy()  # as a runner is told of the merged statistics
        forget_deltas(runner)
    assert merged.num_pushes == 60
    assert not np.allclose(merged.mean, seen.mean(0), atol=0.5)


def test_what_was_handed_in_is_not_handed_in_again():
    merged, first, second = [MeanStdFilter() for _ in range(3)]
    for one in (merged, first, second):
        one.input_observation_space = BOX
    alone = np.random.default_rng(0).normal(3, 2, (40, 2)).astype(np.float32)
    merged.normalize(alone)  # a process that collected by itself, and then goes on with two runners
    state = merged.get_state()
    merged.set_state(state)
    for runner in (first, second):
        runner.set_state(state)
        runner.normalize(alone[:5])
    merged.set_state(merged.merge_states([first.get_state(), second.get_state()]))
    stat = merged._filters[None].running_stats
    assert stat.num_pushes == 50
    assert np.allclose(stat.mean, np.concatenate([alone, alone[:5], alone[:5]]).mean(0))


@pytest.mark.parametrize("rows", [1, 3])
def test_episodes_are_those_of_rllibs_own_runner(rows):
    """Same seeds, same weights: the same observations, actions, rewards and ends, in one piece or several."""
    theirs, ours = (_collected(kind, rows) for kind in (SingleAgentEnvRunner, RobotEnvRunner))
    assert len(theirs) == len(ours) > rows
    for start, (observations, actions, rewards, ends) in theirs.items():
        mine, acted, earned, ended = ours[start]
        common = min(len(rewards), len(earned))  # RLlib's rows wait a step at the end of an episode
        assert common == len(rewards) or (not ended[0] and not ended[1])
        np.testing.assert_allclose(mine[: common + 1], observations[: common + 1], atol=1e-6)
        np.testing.assert_allclose(acted[:common], actions[:common], atol=1e-6)
        np.testing.assert_allclose(earned[:common], rewards[:common], atol=1e-6)
        assert common < len(rewards) or common < len(earned) or ended == ends


def _collected(kind, rows):
    """By their first observation: observations, actions, rewards, and how each episode ended."""
    torch.manual_seed(0)
    register()  # another test may have shut Ray down, and RLlib's registry with it
    config = PPOConfig().environment("bam/mir100-avoidance").debugging(seed=5).rl_module(model_config=NETWORK)
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=rows, env_runner_cls=kind)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*Overriding environment", UserWarning)
        runner = kind(config=config.copy(), worker_index=0, spaces={})
    pieces = {}
    for _ in range(5):
        for episode in runner.sample(num_timesteps=64 * rows, explore=False):
            pieces.setdefault(episode.id_, []).append(episode.to_numpy() if not episode.is_numpy else episode)
    runner.stop()
    found = {}
    for own in pieces.values():
        columns = [np.concatenate([getattr(one, name)() for one in own]) for name in ("get_actions", "get_rewards")]
        seen = np.concatenate([own[0].get_observations()[:1], *[one.get_observations()[1:] for one in own]])
        for before, after in itertools.pairwise(own):
            np.testing.assert_array_equal(before.get_observations(-1), after.get_observations(0))
        found[tuple(seen[0])] = (seen, *columns, (bool(own[-1].is_terminated), bool(own[-1].is_truncated)))
    return found


def test_rows_of_ours_restart_in_the_same_step():
    rows = make_vector_env("bam/reach-v0", {}, 2)
    assert rows.metadata["autoreset_mode"].value == "SameStep"
    rows.close()
