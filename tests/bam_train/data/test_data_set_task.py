"""`bam/dataset`: steps of a data set as a contextual bandit."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import resolve_id
from bam_envs.testing.assertions import assert_same_value
from bam_train.data import DataSet, DataSetInfo, DataSetWriter, Episode
from bam_train.environments import make_env, make_vector_env

DISCRETE = (spaces.Box(0, 1, (3,), np.float32), spaces.Discrete(5))
BOX = (
    spaces.Dict(at=spaces.Box(-9, 9, (2,), np.float32), mode=spaces.Discrete(200)),
    spaces.Box(-1, 1, (2,), np.float32),
)


@pytest.fixture
def write(tmp_path):
    """A function: a data set of 200 episodes of two steps, and what it holds."""

    def write(kind):
        place, rng = tmp_path / "data", np.random.default_rng(0)
        with DataSetWriter(place, DataSetInfo("my/env-v0", {}, *kind, 0.1)) as writer:
            for number in range(200):
                rewards = rng.normal(size=2)
                if kind is DISCRETE:
                    episode = Episode(rng.random((3, 3), np.float32), rng.integers(5, size=2), rewards, True, False)
                else:
                    seen = {"at": rng.random((3, 2), np.float32), "mode": np.full(3, number)}
                    episode = Episode(seen, rng.uniform(-1, 1, (2, 2)).astype(np.float32), rewards, True, False)
                writer.add(episode)
        return str(place)

    return write


def recorded(envs):
    """The recorded actions and rewards of the episodes that run."""
    task = envs.unwrapped.task
    return task.steps.actions[task.drawn], task.steps.rewards[task.drawn]


@pytest.mark.parametrize("kind", [DISCRETE, BOX], ids=["discrete", "box"])
def test_one_environment(write, kind):
    place = write(kind)
    assert resolve_id("bam/dataset") == "bam/dataset-v0"
    env = make_env("bam/dataset-v0", {"data": place})
    assert (env.observation_space, env.action_space) == kind
    check_env(env.unwrapped, skip_render_check=True)
    rows = make_vector_env("bam/dataset-v0", {"data": place}, 2)
    first, _ = rows.reset(seed=4)
    alone, _ = env.reset(seed=5)
    assert_same_value(first["mode"][1] if kind is BOX else first[1], alone["mode"] if kind is BOX else alone)
    *_, terminated, truncated, info = env.step(env.action_space.sample())
    assert (terminated, truncated) == (True, False)
    assert set(info) == {"is_success", "recorded_reward"}


def test_the_recorded_action_gives_the_recorded_reward(write):
    place = write(DISCRETE)
    for reward, expected in (("logged", lambda logged: logged), ("match", np.ones_like)):
        envs = gym.make_vec("bam/dataset-v0", num_envs=100, data=place, reward=reward)
        envs.reset(seed=0)
        actions, rewards = recorded(envs)
        actions = np.where(np.arange(100) < 50, actions, (actions + 1) % 5)
        _, got, _, _, infos = envs.step(actions)
        np.testing.assert_array_equal(got, np.where(np.arange(100) < 50, expected(rewards), 0))
        np.testing.assert_array_equal(infos["final_info"]["is_success"], np.arange(100) < 50)
        np.testing.assert_array_equal(infos["final_info"]["recorded_reward"], rewards)


def test_numbers_are_the_same_within_the_tolerance(write):
    envs = gym.make_vec("bam/dataset-v0", num_envs=50, data=write(BOX), tolerance=0.02)
    envs.reset(seed=0)
    actions, rewards = recorded(envs)
    off = np.where(np.arange(50)[:, None] < 25, 0.019, [0.0, 0.021])
    np.testing.assert_array_equal(envs.step(actions + off)[1], np.where(np.arange(50) < 25, rewards, 0))


def test_the_splits_never_mix(write):
    place = write(BOX)
    numbers = [
        set(gym.make("bam/dataset-v0", data=place, split=split).unwrapped.task.steps.observations["mode"].tolist())
        for split in ("train", "test", "all")
    ]
    assert not numbers[0] & numbers[1]
    assert numbers[0] | numbers[1] == numbers[2] == set(range(200))
    assert 20 < len(numbers[1]) < 60


def refused(**options):
    with pytest.raises((InvalidValue, UnknownName)) as caught:
        gym.make("bam/dataset-v0", **options).reset()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_is_refused(write, tmp_path):
    assert refused() == "bam/dataset-v0 needs a data set: give its place with data="
    nowhere = str(tmp_path / "nowhere")
    assert refused(data=nowhere).startswith(f"bam/dataset-v0: {nowhere}: no such file or folder. Check the name")
    assert refused(dat="x") == "Unknown argument of bam/dataset-v0 'dat'. Did you mean 'data'?"
    place = write(DISCRETE)
    assert refused(data=place, split="half").startswith("split: expected ")
    assert refused(data=place, tolerance=-1.0) == "tolerance: expected a number of at least 0, found -1.0"
    assert refused(data=place, robot="ws://a:1").startswith("bam/dataset-v0 has no robot")
    pair = spaces.Tuple([DISCRETE[0], DISCRETE[0]])
    with DataSetWriter(tmp_path / "tuple", DataSetInfo("my/env-v0", {}, pair, DISCRETE[1], 0.1)):
        pass
    assert " has the space Tuple(" in refused(data=str(tmp_path / "tuple"))
    one = next(iter(DataSet.open(place)))
    with DataSetWriter(tmp_path / "one", DataSetInfo("my/env-v0", {}, *DISCRETE, 0.1)) as writer:
        writer.add(one)
    messages = {split: f"bam/dataset-v0: {tmp_path / 'one'} has no episode of the split '{split}'"
                for split in ("train", "test")}  # fmt: skip
    part = "test" if int(one.digest[:13], 16) < 0.8 * 16**13 else "train"
    assert refused(data=str(tmp_path / "one"), split=part) == messages[part]
