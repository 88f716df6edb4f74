import contextlib

import numpy as np
import pytest
import torch

from bam_train.checkpoint import Checkpoint
from bam_train.environments import make_vector_env
from bam_train.errors import CheckpointMismatch, SettingsError, TrainingFailed
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy
from bam_train.trainers.learning.live_learner import LiveLearner, require_spaces

from .conftest import ENV, play


def test_it_learns_from_a_persons_steps(settings):
    fast = {"learning_rate": 3e-3, "advantage_weight": 0.0, "update_ratio": 10.0}
    learner = LiveLearner.create(settings(hyperparameters=fast))
    learner.add(play(20, person=True))
    assert learner.due == 800
    assert (learner.learn(300), learner.learn(10**6), learner.due) == (300, 500, 0)
    assert evaluate(learner.freeze(), ENV, episodes=20).success_rate == 1.0


@pytest.mark.parametrize("weights", [{"advantage_weight": 1.0}, {"advantage_weight": 0.0, "value_weight": 0.1}])
def test_what_the_critics_value_changes_the_actor(settings, weights):
    learner = LiveLearner.create(settings(hyperparameters={"imitation_weight": 0.0, **weights}))
    learner.add(play(10))
    before = learner.freeze().act(np.zeros(2, np.float32))
    learner.learn(4)  # the warm-up
    assert learner.freeze().act(np.zeros(2, np.float32)) == before
    learner.learn(40)
    assert learner.freeze().act(np.zeros(2, np.float32)) != before
    assert all(np.isfinite(value) for value in learner.statistics().values())


def test_the_average_of_the_weights_drives(settings):
    seen, moved = np.zeros(2, np.float32), []
    for average in (1e-6, 1.0):
        values = {"average": average, "advantage_weight": 0.0, "learning_rate": 1e-2}
        learner = LiveLearner.create(settings(hyperparameters=values))
        before = learner.freeze().act(seen)
        learner.add(play(10, person=True))
        learner.learn(40)
        moved.append(abs(learner.freeze().act(seen) - before).item())
        assert {"loss/imitation"} == {name for name in learner.statistics() if name.startswith("loss")}  # no critics
    assert moved[0] < 1e-4 < 1e-2 < moved[1]


def test_a_run_goes_on_as_if_it_had_not_been_interrupted(settings, tmp_path):
    through, first = (LiveLearner.create(settings()) for _ in range(2))
    actions = []
    for learner in (through, first):
        torch.manual_seed(1)
        learner.add(play(5, person=True))
        learner.learn(7)
        if learner is first:
            saved = learner.save(tmp_path / "last.zip", {}, {})
            learner = LiveLearner.load(Checkpoint.open(saved.path), settings())
        learner.add(play(5, first=5))
        learner.learn(20)
        actions.append(learner.freeze().act(np.ones(2, np.float32)).tolist())
        assert (learner.steps, learner.rlpd.updates) == (40, 27)
    assert actions[0] == actions[1]


def _first(policy, seen):
    policy.reset()
    return policy.act(seen).item()


def test_candidates_explore_and_the_result_does_not(settings, tmp_path):
    learner, seen = LiveLearner.create(settings()), np.zeros(2, np.float32)
    policies = [
        FrozenPolicy.load(learner.save_candidate(tmp_path / f"{k}.zip", explores=explores).path)
        for k, explores in enumerate((True, True, False))
    ]
    actions = [[policy.act(seen).item() for _ in range(4)] for policy in policies]
    assert len({tuple(each) for each in actions}) == 3
    for policy, before in zip(policies, actions, strict=True):
        policy.reset()
        assert [policy.act(seen).item() for _ in range(4)] == before
    first = [
        _first(policies[0], np.full(2, place, np.float32)) - _first(policies[2], np.full(2, place, np.float32))
        for place in (0.1, 0.2, 0.3)
    ]  # the noise, which is another one in each episode
    assert len({round(noise, 4) for noise in first}) == 3
    manifest = Checkpoint.open(tmp_path / "0.zip").manifest
    assert (manifest.trainer, manifest.algorithm, manifest.env) == ("live", "rlpd", ENV)


def test_weights_that_are_not_finite_are_neither_pushed_nor_saved(settings, tmp_path):
    learner = LiveLearner.create(settings())
    learner.rlpd.average.mean.bias.fill_(float("nan"))
    for write in (learner.save_candidate, lambda path: learner.save(path, {}, {})):
        with pytest.raises(TrainingFailed) as error:
            write(tmp_path / "broken.zip")
        text = "the network's weights are NaN or infinite at step 0; expected finite numbers: try a smaller"
        assert str(error.value) == f"{text} learning_rate"
    assert not (tmp_path / "broken.zip").exists()


def test_the_first_policy_is_a_copy(settings, monkeypatch):
    for name, fewer in (("_STEPS", 50), ("_FITS", 600)):
        monkeypatch.setattr(f"bam_train.trainers.learning.live_learner.{name}", fewer)
    learner = LiveLearner.create(settings())

    class Difference:
        def reset(self, env_ids=None):
            pass

        def act_batch(self, observations):
            return observations[:, :1] - observations[:, 1:]

    learner.imitate(Difference())
    assert evaluate(learner.freeze(), ENV, episodes=20).success_rate == 1.0


def test_what_does_not_fit_is_refused(settings, tmp_path):
    learner = LiveLearner.create(settings())
    with contextlib.closing(make_vector_env("CartPole-v1", {}, 1)) as envs, pytest.raises(SettingsError) as error:
        require_spaces(envs.single_observation_space, envs.single_action_space)
    expected = "expected an action space Box of one axis with bounds, found Discrete(2)"
    assert str(error.value) == f"--learner: {expected}"
    with pytest.raises(SettingsError) as error:
        LiveLearner.create(settings(hyperparameters={"gama": 0.9}))
    assert str(error.value) == "hyperparameters: unknown key 'gama'. Did you mean 'gamma'?"
    candidate = learner.save_candidate(tmp_path / "candidate.zip")
    with pytest.raises(CheckpointMismatch) as error:
        LiveLearner.load(candidate, settings())
    text = "was made by rlpd of live, and not by a run with --learner: a new run can begin with it by --start"
    assert str(error.value) == f"{candidate.path}: {text}"
    other = play(1)
    object.__setattr__(other, "action", np.zeros((4, 3), np.float32))
    with pytest.raises(TrainingFailed) as error:
        learner.add(other)
    found = "observations and actions of the agent have shapes (2,) and (3,)"
    assert str(error.value) == f"{found}, expected those of {ENV}, (2,) and (1,)"
