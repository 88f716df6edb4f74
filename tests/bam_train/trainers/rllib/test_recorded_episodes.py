"""A data set as batches of RLlib's learners, in bounded memory."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("ray.rllib")

from gymnasium.spaces import Box, Discrete

from bam_train.data import DataSetInfo, DataSetWriter, Episode
from bam_train.errors import SettingsError
from bam_train.trainers.rllib import recorded_episodes

SEEN, ACTED = Box(-1e3, 1e3, (2,)), Discrete(2, start=5)
CONFIG = SimpleNamespace(gamma=0.5, seed=0)


@pytest.fixture
def place(tmp_path):
    with DataSetWriter(tmp_path / "data", DataSetInfo("a/B-v0", {}, SEEN, ACTED, 0.1)) as writer:
        for k in range(6):
            seen = np.stack([np.full(4, 10 * k), np.arange(4)], 1).astype(np.float32)
            writer.add(Episode(seen, np.array([5, 6, 5]), np.array([1.0, 2, 4]), k % 2 == 0, k % 2 == 1))
    return str(tmp_path / "data")


def test_every_episode_has_its_last_observation(place):
    batch = next(recorded_episodes.Draws(place, CONFIG, 0).iter_torch_batches(batch_size=500))
    numbers = {name.removeprefix("default_policy/"): one.numpy() for name, one in batch.items()}
    assert np.array_equal(numbers["new_obs"], numbers["obs"] + [0, 1])
    assert {(tuple(row)) for row in numbers["new_obs"][numbers["terminateds"]].tolist()} == {(0, 3), (20, 3), (40, 3)}
    assert {(tuple(row)) for row in numbers["new_obs"][numbers["truncateds"]].tolist()} == {(10, 3), (30, 3), (50, 3)}
    assert set(numbers["value_targets"]) == {3.0, 4.0}
    assert np.array_equal(numbers["actions"], numbers["obs"][:, 1] % 2)


def test_learners_share_the_episodes_and_keep_few_of_them(place, monkeypatch):
    monkeypatch.setattr(recorded_episodes, "_BLOCK_STEPS", 3)
    monkeypatch.setattr(recorded_episodes, "_BLOCKS", 2)
    config = SimpleNamespace(**vars(CONFIG), input_=[place])
    learners = [
        one.iter_torch_batches(batch_size=4) for one in recorded_episodes.RecordedData(config).sample(4, num_shards=2)
    ]
    for learner, expected in zip(learners, ({0, 20, 40}, {10, 30, 50}), strict=True):
        batches = [batch["default_policy/obs"].numpy()[:, 0] for batch in itertools.islice(learner, 60)]
        assert set(np.concatenate(batches)) == expected
        assert max(len(set(batch)) for batch in batches) == 2


def test_other_spaces_are_refused(place):
    recorded_episodes.require_fit(place, SEEN, ACTED)
    with pytest.raises(SettingsError, match=r"has the action space Discrete\(2, start=5\), and the env"):
        recorded_episodes.require_fit(place, SEEN, Discrete(2))
