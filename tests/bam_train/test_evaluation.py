import contextlib
import json

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.tasks.scripted import scripted_policy
from bam_train.environments import make_vector_env
from bam_train.errors import PolicyError, SettingsError
from bam_train.evaluation import (
    default_num_envs,
    evaluate,
    summarise,
    waves,
    wilson_interval,
)
from bam_train.rollout import PlayedEpisode
from tests.bam_envs.making import EACH


class Always:
    """The same action in every environment; remembers which were told to forget."""

    def __init__(self, action=1):
        self.action, self.forgotten, self.batches = action, [], []

    def reset(self, env_ids=None):
        self.forgotten.append(None if env_ids is None else list(env_ids))

    def act_batch(self, observations):
        self.batches.append(len(observations))
        return np.stack([self.action] * len(observations))


@pytest.mark.parametrize(
    ("successes", "episodes", "low", "high"),
    [  # Newcombe 1998, table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (29, 29, 0.8830, 1.0),
    ],
)
def test_wilson_interval_is_the_published_one(successes, episodes, low, high):
    assert wilson_interval(successes, episodes) == pytest.approx((low, high), abs=5e-5)


def test_episode_k_has_seed_plus_k_and_exact_figures(corridor, starting_cell):
    starts = [starting_cell(seed) for seed in range(7, 17)]
    report = evaluate(Always(1), corridor, episodes=10, seed=7, num_envs=4)
    lengths = [4 - start for start in starts]
    assert set(starts) == {1, 2, 3}
    assert report.seed == 7
    assert report.successes == report.episodes == 10
    assert report.success_rate == 1.0
    assert report.success_interval == pytest.approx((0.722467, 1.0), abs=1e-6)
    assert report.length_mean == np.mean(lengths)
    assert report.return_mean == 1 - 0.25 * np.mean(lengths)
    assert report.return_std == pytest.approx(0.25 * np.std(lengths))
    assert (report.return_min, report.return_max) == (0.25, 0.75)


@pytest.mark.parametrize("num_envs", [1, 3, 10, 16, None])
def test_numbers_do_not_depend_on_how_many_run_side_by_side(corridor, num_envs):
    assert evaluate(Always(0), corridor, episodes=10, seed=3, num_envs=num_envs) == evaluate(
        Always(0), corridor, episodes=10, seed=3, num_envs=2
    )


@pytest.mark.parametrize(
    ("episodes", "most", "num_envs", "played"),
    [(12, 1, 2, 4), (12, 5, 2, 6), (12, 12, 2, 12), (32, 1, 2, 8), (80, 1, 2, 16), (80, 1, 40, 16), (80, 20, 40, 40)],
)
def test_more_failures_than_wanted_end_it_after_a_wave(corridor, episodes, most, num_envs, played):
    slow = {"slow": True}  # nobody succeeds
    report = evaluate(Always(), corridor, slow, episodes=episodes, num_envs=num_envs, most_failures=most)
    assert (report.episodes, report.successes) == (played, 0)


def test_time_limit_and_no_success_where_the_environment_has_none(corridor):
    report = evaluate(Always(), corridor, {"slow": True}, episodes=2, seed=0)
    assert (report.length_mean, report.return_mean, report.success_rate) == (10.0, -2.5, 0.0)
    report = evaluate(Always(), corridor, {"says_success": False}, episodes=3, seed=0)
    assert (report.success_rate, report.success_interval, report.successes) == (None, None, None)
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["success_rate"] is None


def test_recurrent_state_is_forgotten_at_the_start_of_every_episode(corridor, starting_cell):
    policy = Always(1)
    rows = make_vector_env(corridor, None, 2)
    seed = next(seed for seed in range(100) if starting_cell(seed) == 3 and starting_cell(seed + 1) == 2)
    played = [wave for _ in range(2) for wave in waves(rows, policy, episodes=2, seed=seed)]
    rows.close()
    assert [[episode.length for episode in wave] for wave in played] == [[1, 2], [1, 2]]
    assert policy.forgotten == [None, [0], None, [0]]
    assert len(policy.batches) == 4


def test_arms_whose_episode_has_ended_rest_until_the_next_wave():
    envs = make_vector_env("bam/pick-v0", None, 4)
    envs.reset()
    inner, policy = envs.unwrapped, scripted_policy("bam/pick-v0")
    resting, step = [], inner.robot.step
    inner.robot.step = lambda command: (resting.append(int(inner.robot.physics.resting.sum())), step(command))[1]
    together = evaluate(policy, "bam/pick-v0", episodes=4, env=envs)
    assert resting == sorted(resting)
    assert (resting[0], resting[-1]) == (0, 3)
    assert not inner.robot.physics.resting.any()
    envs.close()
    assert evaluate(policy, "bam/pick-v0", episodes=4, num_envs=1) == together


def test_a_given_environment_is_used_again_and_left_open(corridor):
    envs = make_vector_env(corridor, None, 4)
    policy, seen = Always(1), []
    given = {"episodes": 6, "seed": 1, "env": envs}
    first = evaluate(policy, corridor, **given, on_wave=lambda wave, count: seen.append((len(wave), count)))
    assert first == evaluate(policy, corridor, **given)
    assert set(policy.batches) == {4}
    assert seen == [(4, 6), (2, 6)]
    assert not envs.closed
    envs.close()
    envs = gym.make_vec(corridor, 2, vectorization_mode="sync")
    with pytest.raises(SettingsError, match=r"^env: expected autoreset mode SAME_STEP, found AutoresetMode.NEXT_STEP$"):
        evaluate(Always(), corridor, episodes=2, env=envs)
    envs.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": 0}, "episodes: expected a whole number of at least 1, found 0"),
        ({"seed": -1}, "seed: expected a whole number of at least 0, found -1"),
        ({"num_envs": 0}, "num_envs: expected a whole number of at least 1, found 0"),
    ],
)
def test_out_of_range(corridor, arguments, message):
    with pytest.raises(SettingsError) as caught:
        evaluate(Always(), corridor, **arguments)
    assert str(caught.value) == message


def test_an_action_that_is_not_finite_is_refused_and_a_given_environment_left_open():
    envs = make_vector_env("Pendulum-v1", None, 2)
    with pytest.raises(PolicyError) as caught:
        evaluate(Always(np.full(1, np.nan, np.float32)), "Pendulum-v1", episodes=2, seed=4, env=envs)
    assert str(caught.value) == (
        "action[0, 0] is nan at step 0 of the episodes from seed 4 on; expected finite numbers: the policy is broken"
    )
    assert not envs.closed
    envs.close()


def test_returns_that_are_not_finite_are_none():
    report = summarise("e", [PlayedEpisode(0, float("nan"), 1, None), PlayedEpisode(1, 1.0, 3, None)], 0)
    assert (report.return_mean, report.return_std, report.return_min, report.return_max) == (None, None, None, None)
    assert (report.length_mean, report.length_std) == (2.0, 1.0)
    json.dumps(report.to_json(), allow_nan=False)


@pytest.mark.parametrize(
    ("env_id", "episodes", "rows"),
    [("bam/pick-v0", 100, 50), ("bam/pick-v0", 64, 64), ("bam/pick-v0", 3, 3), ("CartPole-v1", 100, 15)],
)
def test_rows_share_the_episodes_evenly(env_id, episodes, rows):
    assert default_num_envs(env_id, episodes) == rows


class Steady:
    """Acts on what it sees, and the same in any number of rows."""

    def __init__(self, size):
        self.size = size

    def reset(self, env_ids=None):
        pass

    def act_batch(self, observations):
        return np.tile(np.tanh(observations[:, :1]), (1, self.size)).astype(np.float32)


@pytest.mark.parametrize("env_id", EACH)
def test_an_episode_depends_on_its_seed_and_on_no_other_episode(env_id):
    options = {"max_episode_steps": 40}
    rows = make_vector_env(env_id, options, 4)
    policy = Steady(rows.single_action_space.shape[0])
    together = evaluate(policy, env_id, episodes=4, seed=3, env=rows)
    one_first = [one for wave in waves(rows, policy, episodes=4, seed=3, first=1) for one in wave]
    rows.close()
    assert summarise(env_id, one_first, 3) == together
    assert together.length_mean > 1
    assert together == evaluate(policy, env_id, options, episodes=4, seed=3, num_envs=1)
    assert together == evaluate(policy, env_id, options, episodes=4, seed=3, num_envs=3)


@pytest.mark.parametrize("episodes", [50, 1000])
def test_a_picture_counts_once(episodes):
    """Of 359 pictures of the test split; more draws say no more."""

    class Always:
        recurrent = False

        def reset(self, env_ids=None):
            pass

        def act_batch(self, observations):
            return np.full(len(observations), 3)

    with contextlib.closing(make_vector_env("bam/digits-v0", {"split": "test"}, 50)) as envs:
        report = evaluate(Always(), "bam/digits-v0", env=envs, episodes=episodes)
        labels = envs.unwrapped.task.pictures()[1]
    assert (report.episodes, report.starts) == (min(episodes, 359), 359)
    if episodes > 359:
        assert report.successes == (labels == 3).sum()
        assert report.success_interval == wilson_interval(report.successes, 359)
