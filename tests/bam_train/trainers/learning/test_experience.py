import itertools
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.spaces import Box

from bam_train.agent.transitions import LiveTransitions
from bam_train.trainers.learning.experience import Experience
from bam_train.trainers.learning.replay_memory import ActionCode


def episode(number, rewards, *, first=0, person=False, success=False, terminated=True):
    """Observations 0, 1, 2, …; actions 0.1, 0.2, …"""
    n = len(rewards)
    time = np.arange(first, first + n, dtype=np.float32)[:, None]
    last, no = np.arange(n) == n - 1, np.zeros(n, bool)
    return LiveTransitions(
        observation=time,
        action=(time + 1) / 10,
        reward=np.array(rewards, np.float32),
        next_observation=time + 1,
        terminated=last & terminated,
        truncated=last & (not terminated),
        success=last & success,
        intervention=no | person,
        episode=np.full(n, number),
        step=np.arange(first, first + n),
        policy=["ab"] * n,
    )


def pieces(whole, *cuts):
    """The transitions in several messages."""
    edges = [0, *cuts, len(whole)]
    for start, end in itertools.pairwise(edges):
        yield replace(whole, **{name: column[start:end] for name, column in vars(whole).items()})


@pytest.fixture
def new():
    def make(size=100, **changes):
        code = ActionCode(Box(-1, 1, (1,), np.float32))
        return Experience(size, code, **{"history": 2, "gamma": 0.5, "ahead": 2, **changes})

    return make


def test_rows_have_the_last_actions_and_the_rewards_ahead(new):
    experience = new()
    assert experience.add(episode(0, [1, 2, 4])) == 3
    state = experience.state_dict()
    np.testing.assert_allclose(state["seen"], [[0, 0, 0], [1, 0.1, 0], [2, 0.2, 0.1]], atol=1e-6)
    np.testing.assert_allclose(state["after"], [[2, 0.2, 0.1], [3, 0.3, 0.2], [3, 0.3, 0.2]], atol=1e-6)
    np.testing.assert_allclose(state["reward"][:, 0], [1 + 0.5 * 2, 2 + 0.5 * 4, 4])
    np.testing.assert_allclose(state["discount"][:, 0], [0.25, 0, 0])


def test_a_time_limit_does_not_end_the_value(new):
    experience = new()
    experience.add(episode(0, [1, 2, 4], terminated=False))
    np.testing.assert_allclose(experience.state_dict()["discount"][:, 0], [0.25, 0.25, 0.5])


def test_messages_may_cut_an_episode_anywhere(new):
    cut, whole = new(), new()
    whole.add(episode(0, [1, 2, 4]))
    assert [cut.add(piece) for piece in pieces(episode(0, [1, 2, 4]), 1, 2)] == [0, 0, 3]
    np.testing.assert_equal(cut.state_dict(), whole.state_dict())


def test_an_episode_without_its_beginning_is_left_out(new):
    experience = new()
    assert experience.add(episode(0, [1, 2], first=5)) == 0
    missing = [piece for k, piece in enumerate(pieces(episode(1, [1, 2, 4]), 1, 2)) if k != 1]
    assert [experience.add(piece) for piece in missing] == [0, 0]
    assert experience.add(episode(2, [1])) == 1


def test_an_episode_that_was_interrupted_counts_without_an_end(new):
    experience = new()
    first, _ = pieces(episode(0, [1, 2, 4], success=True), 2)
    assert experience.add(first) == 0
    assert experience.add(episode(1, [1], success=True)) == 3
    assert experience.outcomes == [(False, False, "ab"), (True, False, "ab")]
    assert experience.state_dict()["discount"][:2, 0].tolist() == [0.25, 0.5]


def test_an_agent_that_reconnects_counts_from_0_again(new):
    experience = new()
    first, _ = pieces(episode(0, [1, 2, 4]), 2)
    experience.add(first)
    assert experience.add(episode(0, [1])) == 3
    assert len(experience.outcomes) == 2


def test_demonstrations_are_a_persons_and_successes(new):
    experience, rng = new(), np.random.default_rng(0)
    experience.add(episode(0, [0] * 4))
    assert experience.sample(10, 0.5, rng).demonstrations == 0
    experience.add(episode(0, [1] * 4, person=True))
    experience.add(episode(1, [2] * 4, success=True))
    batch = experience.sample(20, 0.5, rng)
    assert (batch.demonstrations, experience.interventions) == (10, 4)
    shown = batch.reward[-10:].tolist()
    assert [sum(value in kind for value in shown) for kind in ((1.0, 1.5), (2.0, 3.0))] == [5, 5]


def test_a_full_buffer_drops_the_oldest(new):
    experience = new(size=5)
    for k in range(3):
        experience.add(episode(k, [k] * 3))
    assert (len(experience), experience.added) == (5, 9)
    assert sorted(set(experience.state_dict()["reward"][:, 0].tolist())) == [1.0, 1.5, 2.0, 3.0]


def test_it_goes_on_from_its_state(new):
    one, other = new(), new()
    one.add(episode(0, [1, 2, 4], success=True))
    other.load_state_dict(one.state_dict())
    for experience in (one, other):
        experience.add(episode(1, [1], person=True))
    np.testing.assert_equal(one.state_dict(), other.state_dict())
