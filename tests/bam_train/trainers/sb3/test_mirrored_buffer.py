"""Rollouts with their mirror images, and starts near the goal: what is learnt from, and what goes on bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bam_train.checkpoint import Checkpoint
from bam_train.environments import make_vector_env
from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.sb3.sb3_trainer import SB3Trainer

SMALL = {"n_steps": 8, "batch_size": 8, "n_epochs": 2}


def created(env="bam/pick-v0", algo="ppo", **given):
    given = {"steps": 48, "num_envs": 2, "hyperparameters": SMALL if algo == "ppo" else {}, **given}
    return SB3Trainer.create(SB3Trainer.complete(TrainSettings.from_mapping({"env": env, "algo": algo, **given})))


@pytest.mark.parametrize("sde", [False, True])
def test_an_update_learns_from_images_with_the_return_of_their_samples(sde):
    given = {"mirror": True, "hyperparameters": {**SMALL, "use_sde": sde}}
    trainer, before = created(**given), created(**given).model.policy
    trainer.train(16, lambda progress: True)
    buffer, task = trainer.model.rollout_buffer, trainer.venv.batch.unwrapped.task
    for name, labels in (("observations", task.observation_labels), ("actions", task.action_labels)):
        signs = [-1 if label.name in task.mirrored else 1 for label in labels]
        samples, images = np.split(getattr(buffer, name), 2)
        assert samples.shape == (16, len(labels))
        np.testing.assert_array_equal(images, samples * np.array(signs, np.float32))
    for name in ("returns", "advantages", "values"):
        np.testing.assert_array_equal(*np.split(getattr(buffer, name), 2))
    with torch.no_grad():
        seen, acted = torch.from_numpy(buffer.observations), torch.from_numpy(buffer.actions)
        density = before.evaluate_actions(seen, acted)[1].numpy()
    np.testing.assert_allclose(buffer.log_probs[:, 0], density, atol=1e-4)
    batches = list(buffer.get(8))
    assert [len(one.actions) for one in batches] == [8, 8, 8, 8]
    drawn = np.sort(torch.cat([one.old_log_prob for one in batches]).numpy())
    np.testing.assert_array_equal(drawn, np.sort(buffer.log_probs[:, 0]))


def test_a_run_with_images_and_near_starts_goes_on_bit_for_bit_and_evaluates_the_usual_starts(tmp_path):
    trainer = created(mirror=True, near_starts=1.0)
    assert trainer.venv.batch.unwrapped.task.near_starts == 1.0
    trainer.train(16, lambda progress: True)
    trainer.save(tmp_path / "a.zip", {}, {"best": None})
    trainer.train(48, lambda progress: True)
    saved = Checkpoint.open(tmp_path / "a.zip")
    assert {name: saved.manifest.settings[name] for name in ("mirror", "near_starts")} == {
        "mirror": True,
        "near_starts": 1.0,
    }
    again = SB3Trainer.load(saved)
    again.train(48, lambda progress: True)
    for ours, theirs in zip(again.model.policy.parameters(), trainer.model.policy.parameters(), strict=True):
        assert torch.equal(ours, theirs)
    np.testing.assert_array_equal(again.model._last_obs, trainer.model._last_obs)
    with trainer.evaluation_envs() as envs:
        assert envs is None  # `evaluate` makes its own
    assert make_vector_env("bam/pick-v0", {}, 1).unwrapped.task.near_starts == 0.0


@pytest.mark.parametrize(
    ("env", "given", "why"),
    [
        ("CartPole-v1", {"mirror": True}, "mirror: no mirror image of CartPole-v1 is known, with these settings"),
        ("bam/reach-v0", {"mirror": True}, "mirror: no mirror image of bam/reach-v0 is known, with these settings"),
        (
            "bam/pick-v0",
            {"mirror": True, "normalize": True},
            "mirror: no mirror image of bam/pick-v0 is known, with these settings",
        ),
        (
            "bam/pick-v0",
            {"mirror": True, "algo": "sac"},
            "mirror: the algorithm learns from no rollouts, as ppo and a2c do",
        ),
        ("bam/reach-v0", {"near_starts": 0.5}, "near_starts: bam/reach-v0 has no starts near its goal"),
        ("CartPole-v1", {"near_starts": 0.5}, "near_starts: CartPole-v1 has no starts near its goal"),
    ],
)
def test_what_has_no_images_or_near_starts(env, given, why):
    with pytest.raises(SettingsError) as caught:
        created(env, **given)
    assert str(caught.value) == f"{why}; leave it out"
