import json
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.timing import Pacer
from bam_train.agent.transitions import MOST, TransitionCollector, TransitionLog, decode, encode
from bam_train.deploy.deployment import Deployment
from bam_train.deploy.journal import Journal
from bam_train.errors import FormatError
from tests.raising import raising


def three():
    log, rng = TransitionLog(), np.random.default_rng(0)
    for step in range(3):
        seen, after, action = (rng.standard_normal(n).astype(np.float32) for n in (4, 4, 2))
        ends, digest = (step == 2, False, step == 2), "" if step == 1 else "ab"
        log.add(seen, action, 0.1 * step, after, *ends, step == 1, 7, step, digest)
    return log.take()


def same(one, other):
    for name, value in vars(one).items():
        found = getattr(other, name)
        if name == "policy":
            assert found == value
        else:
            assert found.dtype == value.dtype, name
            np.testing.assert_array_equal(found, value)


def test_a_message_carries_every_bit():
    sent = three()
    same(sent, decode(json.loads(json.dumps(encode(sent)))))
    assert sent.policy == ["ab", "", "ab"]
    assert sent.intervention.tolist() == [False, True, False]
    assert sent.ends.tolist() == [False, False, True]
    log = TransitionLog(most=2)
    for step in range(5):
        log.add(np.ones((2, 3)), np.zeros(1), step, np.zeros((2, 3)), False, True, False, False, 0, step, "ab")
    assert log.lost == 3
    decoded = decode(encode(log.take()))  # of pictures, the newest
    assert (len(decoded), decoded.observation.shape, decoded.step.tolist()) == (2, (2, 2, 3), [3, 4])
    assert log.take() is None


COLUMN = {"shape": [3, 1], "data": "AAAAAAAAAAAAAAAA"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": -1}, "transitions: count: expected a whole number up to 10000, found -1"),
        ({"count": MOST + 1}, "transitions: count: expected a whole number up to 10000, found 10001"),
        ({"terminated": [0, 0, 1]}, "transitions: terminated: expected 3 values of type bool, found [0, 0, 1]"),
        ({"episode": [1, 1]}, "transitions: episode: expected 3 values of type int, found [1, 1]"),
        ({"step": [0, 1, 2**64]}, f"transitions: step: expected 3 values of type int, found [0, 1, {2**64}]"),
        ({"policy": None}, "transitions: policy: expected 3 values of type str, found None"),
        ({"action": [1.0]}, "transitions: action: expected an array of 3 rows, found [1.0]"),
        ({"reward": {"shape": [3], "data": "?"}}, "transitions: reward: expected base64, found '?'"),
        ({"reward": {"shape": [3], "data": "AAAA"}}, "transitions: reward: expected 12 bytes for shape [3], found 3"),
        ({"reward": COLUMN}, "transitions: reward: expected shape (3,), found (3, 1)"),
        ({"reward": {"shape": [3], "data": "AADAfwAAAAAAAAAA"}}, "transitions: reward: expected finite numbers"),
        ({"next_observation": COLUMN}, "transitions: next_observation: expected shape (3, 4), found (3, 1)"),
    ],
)
def test_a_bad_message_is_refused(change, message):
    with raising(FormatError, message):
        decode(encode(three()) | change)


class Counting(gym.Env):
    """Observation: the number of the step; two steps an episode."""

    observation_space = gym.spaces.Box(-9, 9, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.full(1, self.t, np.float32), float(action[0]), self.t == 2, False, {"is_success": self.t == 2}


class HalfOfIt:
    def reset(self):
        pass

    def act(self, observation):
        return (observation + 1) / 4


def two_episodes(*arguments):
    log, watcher = TransitionLog(), SimpleNamespace(ticked=lambda *tick: None, ended=lambda record: None)
    collector = TransitionCollector(log, *arguments)
    Deployment(Counting(), HalfOfIt(), Pacer(None), Journal(2), observers=[collector]).run(watcher, seed=0)
    return log.take()


def test_a_step_that_a_request_cut_short_is_left_out():
    cut = iter([False, True, True, False])
    found = two_episodes(lambda: "a", lambda: next(cut))
    assert list(zip(found.episode.tolist(), found.step.tolist(), strict=True)) == [(0, 0), (1, 1)]


def test_the_loop_collects_each_step_of_each_episode():
    digests = iter("aabbccdd")
    found = two_episodes(lambda: next(digests))
    assert found.episode.tolist() == [0, 0, 1, 1]
    assert found.step.tolist() == [0, 1, 0, 1]
    assert found.observation[:, 0].tolist() == [0, 1, 0, 1]
    assert found.next_observation[:, 0].tolist() == [1, 2, 1, 2]
    assert found.reward.tolist() == found.action[:, 0].tolist() == [0.25, 0.5, 0.25, 0.5]
    assert found.terminated.tolist() == found.success.tolist() == [False, True, False, True]
    assert not found.truncated.any()
    assert not found.intervention.any()
    assert found.policy == ["a", "a", "b", "c"]
