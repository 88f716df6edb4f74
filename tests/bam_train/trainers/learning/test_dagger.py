"""Policies that imitate a teacher: from numbers, from images, with whole numbers as actions; resumed; refused."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from bam_envs.robots.physics.rendering import RenderingUnavailable, find_backend
from bam_train.checkpoint import Checkpoint
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy
from bam_train.trainers.learning.dagger import DaggerTrainer
from bam_train.trainers.resolve_settings import resolve

PICK_PPO = Path(__file__).parents[4] / "checkpoints" / "pick-ppo.zip"
TINY = ("width=16", "channels=2", "batch_size=16", "env_kwargs.image_size=16", "env_kwargs.action_delay=1")


pytestmark = pytest.mark.usefixtures("here")


def test_a_scripted_teacher_is_imitated(bam_train):
    options = ("width=64", "passes=8", "learning_rate=3e-3")
    status, *_ = bam_train(
        env="bam/reach", algo="dagger", teacher="scripted", steps=2048, num_envs=64, eval_episodes=20, set=options
    )
    assert status == 0
    manifest = Checkpoint.open("checkpoints/reach-dagger.zip").manifest
    assert (manifest.trainer, manifest.algorithm, manifest.steps) == ("imitation", "dagger", 2048)
    assert manifest.scores["success_rate"] > 0.8


def test_a_teacher_that_sees_the_state_teaches_one_that_sees_images(bam_train):
    try:
        find_backend()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    given = {"env": "bam/pick", "algo": "dagger", "num_envs": 4, "eval_episodes": 2, "set": TINY}
    assert bam_train(teacher=str(PICK_PPO), steps=64, **given)[0] == 0
    made = Checkpoint.open("checkpoints/pick-dagger.zip")
    assert sorted(made.manifest.observation_space["spaces"]) == ["front", "robot", "wrist"]
    assert len(made.manifest.signals["observation"]) == 16 + 2
    policy = FrozenPolicy.from_checkpoint(made)  # its actions are those of the trainer
    assert evaluate(policy, "bam/pick-v0", made.manifest.env_kwargs, episodes=2).episodes == 2
    status, _, err = bam_train(resume=made.path, steps=128, out="more.zip")
    assert status == 0
    assert "the steps that were learnt from are not saved" in err
    assert Checkpoint.open("more.zip").manifest.steps == 128


class Upright:
    """Pushes a cart to the side to which its pole falls."""

    state_size = 0

    def __call__(self, observation):
        return (observation[:, 2] + 0.5 * observation[:, 3] > 0).astype(np.int64), None

    def reset(self, env_ids=None):
        pass


def test_whole_numbers_are_learnt_as_choices(monkeypatch):
    monkeypatch.setattr("bam_train.trainers.learning.dagger.Teacher", lambda settings, envs: Upright())
    options = {"width": 32, "batch_size": 32, "passes": 4}
    asked = {"env": "CartPole-v1", "algo": "dagger", "teacher": "scripted", "steps": 2000, "num_envs": 8}
    trainer = DaggerTrainer.create(resolve({**asked, "hyperparameters": options}))
    trainer.train(2000, lambda progress: True)
    seen = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 4)).astype(np.float32)
    agreed = trainer.freeze().act_batch(seen) == Upright()(seen)[0]
    assert agreed.mean() > 0.9
    trainer.close()


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        ({"algo": "dagger"}, "teacher: dagger imitates a teacher, found none. Give --teacher CHECKPOINT or"),
        ({"algo": "ppo", "teacher": "scripted"}, "teacher: ppo has none; leave it out, or give --algo dagger"),
        (
            {"algo": "dagger", "teacher": str(PICK_PPO.with_name("reach-ppo.zip"))},
            "was trained on bam/reach-v0, not on bam/pick-v0.",
        ),
        ({"algo": "dagger", "teacher": "nowhere.zip"}, "nowhere.zip: no such file."),
    ],
)
def test_teachers_that_cannot_teach_are_refused(bam_train, flags, text):
    status, _, err = bam_train(env="bam/pick", set=("env_kwargs.camera=null", "env_kwargs.looks=fixed"), **flags)
    assert status != 0
    assert text in err
