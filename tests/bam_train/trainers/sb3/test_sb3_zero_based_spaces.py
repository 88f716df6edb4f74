"""Choices that do not count from 0: stable-baselines3 does, the environment and the frozen policy do not."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO

from bam_train.compat.plain_sb3_zip import export_trusted
from bam_train.errors import CheckpointMismatch
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy
from bam_train.settings import TrainSettings
from bam_train.trainers.sb3.sb3_trainer import SB3Trainer
from bam_train.trainers.zero_based_spaces import from_zero

ID = "test/Shifted-v0"


class Shifted(gym.Env):
    """Rewards the action that is one less than the observation; both count from 2."""

    observation_space = spaces.Discrete(3, start=3)
    action_space = spaces.Discrete(3, start=2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.seen = 0, int(self.np_random.integers(3)) + 3
        return np.int64(self.seen), {}

    def step(self, action):
        if not self.action_space.contains(action):
            raise AssertionError(f"{action!r} is not in {self.action_space}")
        reward = float(int(action) == self.seen - 1)
        self.steps, self.seen = self.steps + 1, int(self.np_random.integers(3)) + 3
        return np.int64(self.seen), reward, False, self.steps >= 10, {}


@pytest.fixture
def shifted():
    gym.register(ID, entry_point=Shifted)
    yield ID
    del gym.registry[ID]


@pytest.mark.parametrize(
    ("algo", "hyperparameters"),
    [("ppo", {"n_steps": 32, "batch_size": 32}), ("dqn", {"learning_starts": 16, "buffer_size": 100})],
)
def test_what_is_trained_is_what_is_deployed(shifted, tmp_path, algo, hyperparameters):
    given = {"env": shifted, "algo": algo, "steps": 64, "hyperparameters": hyperparameters}
    trainer = SB3Trainer.create(SB3Trainer.complete(TrainSettings.from_mapping(given)))
    trainer.train(64, lambda progress: True)
    trainer.save(tmp_path / "shifted.zip", {}, {})
    expected = trainer.model.predict(np.array([0, 1, 2]), deterministic=True)[0] + 2
    trainer.close()
    policy = FrozenPolicy.load(tmp_path / "shifted.zip")
    assert [int(policy.act(np.int64(seen))) for seen in (3, 4, 5)] == expected.tolist()
    assert evaluate(policy, shifted, episodes=2).length_mean == 10


def test_a_plain_file_is_trusted_only_if_it_counted_from_zero(shifted, tmp_path):
    settings = {"n_steps": 8, "batch_size": 8, "device": "cpu"}
    PPO("MlpPolicy", from_zero(Shifted()), **settings).save(tmp_path / "zero.zip")
    policy = export_trusted(tmp_path / "zero.zip", "ppo", shifted).policy
    assert all(Shifted.action_space.contains(policy.act(np.int64(seen))) for seen in (3, 4, 5))
    PPO("MlpPolicy", Shifted(), **settings).save(tmp_path / "start.zip")
    with pytest.raises(CheckpointMismatch, match="spaces do not match: "):
        export_trusted(tmp_path / "start.zip", "ppo", shifted)
