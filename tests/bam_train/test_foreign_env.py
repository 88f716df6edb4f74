"""Environments that fail: one line with their name, the step and the place in their code."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from bam_envs.core.errors import LinkLost
from bam_train.environments import make_env, make_vector_env
from bam_train.errors import EnvironmentFailed, SettingsError

BOX = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
SEEN = np.zeros(3, np.float32)


class Fails(gym.Env):
    """Raises `error` or, if there is none, observes `seen`: at its construction, in reset, or at a step `at`."""

    action_space = gym.spaces.Discrete(2)

    def __init__(self, at, error=None, seen=None, space=BOX):
        self.observation_space, self.at, self.error = space, at, error
        self.seen = SEEN if seen is None else seen
        self.ordinary = {"a": SEEN} if isinstance(space, gym.spaces.Dict) else SEEN
        self.look("made")

    def look(self, now):
        if now == self.at and self.error is not None:
            raise self.error
        return self.seen if now == self.at else self.ordinary

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self.look("reset"), {}

    def step(self, action):
        self.steps += 1
        return self.look(self.steps), 0.0, self.steps == 2, False, {}


LOOK = Fails.look.__code__.co_firstlineno + 2
PLACE = f"(test_foreign_env.py, line {LOOK}, in look)"
CASES = [
    ({"at": 2, "error": KeyError("gripper")}, f"failed at step 2 of an episode: KeyError: 'gripper' {PLACE}"),
    ({"at": "reset", "error": OSError("two\nlines")}, f"failed in reset: OSError: two lines {PLACE}"),
    ({"at": "reset", "error": RuntimeError()}, f"failed in reset: RuntimeError {PLACE}"),
    (
        {"at": "reset", "seen": np.zeros(4)},
        ": the observation has shape (4,), and its space (3,): correct the environment",
    ),
    (
        {"at": 1, "seen": {"a": [1.0]}, "space": gym.spaces.Dict({"a": BOX})},
        ": the observation 'a' has shape (1,), and its space (3,): correct the environment",
    ),
    (
        {"at": 1, "seen": {"b": SEEN}, "space": gym.spaces.Dict({"a": BOX})},
        ": the observation has no 'a', which its space has: correct the environment",
    ),
]


@pytest.fixture
def fails():
    gym.register("test/Fails-v0", entry_point=Fails)
    yield "test/Fails-v0"
    del gym.registry["test/Fails-v0"]


@pytest.mark.parametrize(("kwargs", "text"), CASES)
@pytest.mark.parametrize("num_envs", [None, 2])
def test_what_fails_is_named(fails, kwargs, text, num_envs):
    env = make_env(fails, kwargs) if num_envs is None else make_vector_env(fails, kwargs, num_envs)
    actions = 0 if num_envs is None else [0] * num_envs
    with pytest.raises(EnvironmentFailed) as caught:  # noqa: PT012 - in reset or a step
        env.reset(seed=0)
        for _ in range(2):
            env.step(actions)
    assert str(caught.value) == f"test/Fails-v0 {text}".replace(" :", ":")
    assert kwargs.get("error") in (None, caught.value.__cause__)


def test_what_cannot_be_made_is_named(fails):
    with pytest.raises(SettingsError) as caught:
        make_env(fails, {"at": "made", "error": OSError("no such device")})
    assert str(caught.value) == f"test/Fails-v0 cannot be made: OSError: no such device {PLACE}"


def test_faults_of_a_robot_stay_what_they_are(fails):
    lost = LinkLost("the link dropped")
    env = make_env(fails, {"at": "reset", "error": lost})
    with pytest.raises(LinkLost) as caught:
        env.reset()
    assert caught.value is lost


def test_vector_environments_of_one_class_keep_their_own_automatic_resets():
    theirs = gym.make_vec("CartPole-v1", 1, vectorization_mode="sync")
    ours = make_vector_env("CartPole-v1", None, 1)
    modes = [envs.metadata["autoreset_mode"] for envs in (theirs, ours)]
    gym.make_vec("CartPole-v1", 1, vectorization_mode="sync").close()
    assert [*modes, ours.metadata["autoreset_mode"]] == [AutoresetMode.NEXT_STEP, *2 * [AutoresetMode.SAME_STEP]]
