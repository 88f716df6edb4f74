"""Episodes and filter of our runner against those of RLlib's own; Ray is not started."""

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

from bam_train.trainers.rllib import register
from bam_train.trainers.rllib.mean_std_filter import MeanStdFilter, forget_deltas, push
from bam_train.trainers.rllib.robot_env_runner import RobotEnvRunner

BOX = gym.spaces.Box(-10, 10, (2,), np.float32)


def test_counting_many_at_once_is_counting_one_by_one():
    observations = np.random.default_rng(0).normal(3, 2, (40, 2))
    one, many = RunningStat((2,)), RunningStat((2,))
    for observation in observations:
        one.push(observation)
    push(many, observations[:25])
    push(many, observations[25:])
    assert many.num_pushes == one.num_pushes == 40
    assert np.allclose(many.mean, one.mean)
    assert np.allclose(many.std, one.std)


@pytest.mark.parametrize("alone", [0, 40])
def test_merging_two_runners_is_counting_all(alone):
    """Also after a process that collected by itself before: what was handed in is not handed in again."""
    rng = np.random.default_rng(0)
    merged, *runners = filters = [MeanStdFilter() for _ in range(3)]
    for one in filters:
        one.input_observation_space = BOX
    first, observations = (rng.normal(3, 2, shape).astype(np.float32) for shape in ((alone, 2), (2, 30, 2)))
    merged.normalize(first)
    for one in filters:
        one.set_state(merged.get_state())
    for part in (slice(0, 10), slice(10, 30)):
        for runner, seen in zip(runners, observations, strict=True):
            runner.normalize(seen[part])
        state = merged.merge_states([runner.get_state() for runner in runners])
        for one in filters:
            one.set_state(state)
    (own,) = merged.get_state().values()
    assert own["running_stats"][0]["num_pushes"] == alone + 60
    everything = np.concatenate([first, observations.reshape(-1, 2)]).astype(np.float64)
    point = np.float32([[1, 5]])
    expected = (point - everything.mean(0)) / everything.std(0, ddof=1)
    np.testing.assert_allclose(merged.normalize(point, update=False), expected, rtol=1e-4)
    assert type(merged).__name__ == Theirs.__name__


def test_rllibs_own_filter_comes_out_with_another_mean():
    """Once it does not, `MeanStdFilter.__call__` and `push` can go."""
    merged, runner = RunningStat((2,)), RunningStat((2,))
    seen = np.random.default_rng(0).normal(3, 2, (60, 2))
    for start in (0, 30):
        for observation in seen[start : start + 30]:
            runner.push(observation)
        merged.update(runner)
        runner = merged.copy()  # as a runner is told of the merged statistics
        forget_deltas(runner)
    assert merged.num_pushes == 60
    assert not np.allclose(merged.mean, seen.mean(0), atol=0.5)


@pytest.mark.parametrize("number", [1, 3])
def test_episodes_are_those_of_rllibs_own_runner(number):
    """Same seeds, same weights: the same observations, actions, rewards and ends, in one piece or several."""
    theirs, ours = (_collected(kind, number) for kind in (SingleAgentEnvRunner, RobotEnvRunner))
    assert len(theirs) == len(ours) > number
    for start, (observations, actions, rewards, ends) in theirs.items():
        mine, acted, earned, ended = ours[start]
        common = min(len(rewards), len(earned))  # RLlib's environments wait a step at the end of an episode
        assert common == len(rewards) or (not ended[0] and not ended[1])
        np.testing.assert_allclose(mine[: common + 1], observations[: common + 1], atol=1e-6)
        np.testing.assert_allclose(acted[:common], actions[:common], atol=1e-6)
        np.testing.assert_allclose(earned[:common], rewards[:common], atol=1e-6)
        assert common < len(rewards) or common < len(earned) or ended == ends


def _collected(kind, number):
    """By their first observation: observations, actions, rewards, and how each episode ended."""
    torch.manual_seed(0)
    register()  # another test may have shut Ray down, and RLlib's registry with it
    config = PPOConfig().environment("bam/avoidance").debugging(seed=5)
    config.rl_module(model_config={"fcnet_hiddens": [16]})
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=number, env_runner_cls=kind)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*Overriding environment", UserWarning)
        runner = kind(config=config.copy(), worker_index=0, spaces={})
    pieces = {}
    for _ in range(3):
        for episode in runner.sample(num_timesteps=64 * number, explore=False):
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


def test_whole_episodes_come_in_one_piece():
    config = PPOConfig().environment("bam/reach", env_config={"max_episode_steps": 40}).debugging(seed=5)
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=2, env_runner_cls=RobotEnvRunner)
    runner = RobotEnvRunner(config=config.copy(), worker_index=0, spaces={})
    episodes = runner.sample(num_episodes=3, random_actions=True)
    runner.stop()
    assert len(episodes) == 3
    assert all(episode.is_done and episode.t_started == 0 and len(episode) <= 40 for episode in episodes)
    assert max(map(len, episodes)) > 32  # joined from two rollouts


def test_noise_of_actions_is_kept_for_some_steps():
    """Each action is as likely as one drawn by itself."""
    torch.manual_seed(0)
    config = PPOConfig().environment("bam/reach").debugging(seed=5).rl_module(model_config={"free_log_std": True})
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=2, env_runner_cls=RobotEnvRunner)
    config.noise_steps = 5
    runner = RobotEnvRunner(config=config.copy(), worker_index=0, spaces={})
    pieces = runner.sample(num_timesteps=20, explore=True)
    runner.stop()
    noises = []
    for piece in pieces:
        outputs, actions = piece.extra_model_outputs, piece.get_actions()
        mean, log_std = np.split(np.asarray(outputs["action_dist_inputs"]), 2, axis=-1)
        noises.append((actions - mean) / np.exp(log_std))
        likely = torch.distributions.Normal(torch.tensor(mean), torch.tensor(log_std).exp()).log_prob(
            torch.tensor(actions)
        )
        np.testing.assert_allclose(outputs["action_logp"], likely.sum(-1), rtol=1e-4)
    for noise in noises:
        assert noise.shape[0] == 10
        np.testing.assert_allclose(noise[:5], np.tile(noise[0], (5, 1)), atol=1e-4)
        np.testing.assert_allclose(noise[5:], np.tile(noise[5], (5, 1)), atol=1e-4)
        assert (noise[0] != noise[5]).all()
