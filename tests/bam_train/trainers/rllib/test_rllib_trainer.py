"""One run of RLlib: what it saves, what it freezes, how it goes on and how it is refused."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Tuple

pytest.importorskip("ray")

import ray

from bam_train.checkpoint import Checkpoint
from bam_train.compat.rllib_export import export
from bam_train.data import DataSetInfo, DataSetWriter, Episode
from bam_train.errors import BadDataSet, BamTrainError, CheckpointMismatch, EnvironmentFailed, SettingsError
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy
from bam_train.settings import TrainSettings
from bam_train.trainers.resolve_settings import resolve, resolve_resumed
from bam_train.trainers.rllib import own_ids
from bam_train.trainers.rllib.rllib_trainer import RLlibTrainer

pytestmark = [
    pytest.mark.usefixtures("one_ray"),
    pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:ray"),  # Ray's own, of its data library
]

SMALL = {"fcnet_hiddens": [16, 16]}
PPO = {"train_batch_size_per_learner": 64, "minibatch_size": 64, "num_epochs": 1, "model_config": SMALL}


def made(algo="ppo", env="bam/reach", hyper=PPO, **given):
    """A trainer, closed at the end of its block."""
    settings = {"env": env, "algo": algo, "trainer": "rllib", "steps": 128, "num_envs": 4, "hyperparameters": hyper}
    return contextlib.closing(RLlibTrainer.create(resolve({**settings, **given})))


def train(trainer, steps):
    """Statistics after these steps."""
    seen = []
    trainer.train(steps, lambda progress: seen.append(progress.statistics()) or True)
    assert trainer.steps >= steps
    return seen[-1]


@pytest.fixture(scope="module")
def trained(shared_ray, tmp_path_factory):
    shared_ray.start()
    with made(normalize=True, seed=3) as trainer:
        seen = []
        trainer.train(128, lambda progress: seen.append((progress.steps, progress.total)) or True)
        assert seen == [(64, 128), (128, 128)]
        path = tmp_path_factory.mktemp("trained") / "a.zip"
        yield trainer, trainer.save(path, {"success_rate": 0.5}, {"best": None})


def test_a_run_saves_what_it_is(trained):
    trainer, checkpoint = trained
    manifest = checkpoint.manifest
    assert (manifest.env, manifest.algorithm, manifest.trainer, manifest.steps) == ("bam/reach-v0", "ppo", "rllib", 128)
    assert manifest.versions["ray"] == ray.__version__
    assert manifest.period == pytest.approx(0.05)
    assert checkpoint.has("bam/resume/rllib/learner_group/learner/rl_module/default_policy/module_state.pkl")
    assert TrainSettings.from_mapping(manifest.settings) == trainer.settings
    env = gym.make("bam/reach-v0")
    observations = np.stack([env.observation_space.sample() for _ in range(50)])
    frozen = FrozenPolicy.load(checkpoint.path).act_batch(observations)
    assert np.abs(frozen - trainer.freeze().act_batch(observations)).max() <= 1e-6


def test_it_goes_on_where_it_stopped(trained):
    trainer, checkpoint = trained
    again = RLlibTrainer.load(Checkpoint.open(checkpoint.path))
    with contextlib.closing(again):
        assert again.steps == 128
        assert "running episodes" in again.notices[0]
        ours, theirs = (one.algorithm.learner_group.get_state()["learner"] for one in (trainer, again))
        for part in ("rl_module", "optimizer"):  # weights and moments
            _require_equal(ours[part], theirs[part])
        train(again, 192)
        assert (again.steps, again.algorithm.iteration) == (192, 3)


def _require_equal(one, other):
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            _require_equal(one[key], other[key])
    else:
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("name", "hyper"),
    [("ppo", {"train_batch_size_per_learner": 100, "num_epochs": 1}), ("dqn", {"epsilon": [[0, 1.0], [10000, 0.05]]})],
)
def test_training_goes_on_from_a_directory_of_rllib(name, hyper, rllib_directories, tmp_path):
    """Of its present API: settings, weights, filter and counters are the directory's."""
    saved = Checkpoint.open(export(rllib_directories / name, trust=True).write(tmp_path / "a.zip").path)
    settings = resolve_resumed({"steps": saved.manifest.steps + 100}, saved)
    assert settings.hyperparameters["model_config"]["fcnet_hiddens"] == [16, 16]
    assert {key: settings.hyperparameters[key] for key in hyper} == hyper
    with contextlib.closing(RLlibTrainer.load(saved, settings)) as trainer:
        observations = gym.make(settings.env).observation_space.sample()[None].repeat(9, 0)
        np.testing.assert_array_equal(
            trainer.freeze().act_batch(observations), FrozenPolicy.load(saved.path).act_batch(observations)
        )
        assert trainer.steps == saved.manifest.steps == (100 if name == "ppo" else 0)
        train(trainer, settings.steps)
        assert trainer.steps <= settings.steps + 200
        again = trainer.save(tmp_path / "b.zip", {}, {})
    assert Checkpoint.open(again.path).manifest.settings == settings.to_mapping()


@pytest.mark.parametrize(
    ("algo", "env", "hyper"),
    [
        ("appo", "bam/reach", {"train_batch_size_per_learner": 100, "model_config": SMALL}),
        ("impala", "bam/reach", {"train_batch_size_per_learner": 100, "model_config": SMALL}),
        ("dqn", "CartPole-v1", {"num_steps_sampled_before_learning_starts": 100, "model_config": SMALL}),
        (
            "sac",
            "bam/reach",
            {
                "num_steps_sampled_before_learning_starts": 190,
                "train_batch_size_per_learner": 16,
                "model_config": SMALL,
            },
        ),
    ],
)
def test_other_algorithms_train_and_freeze(algo, env, hyper, tmp_path):
    with made(algo, env, hyper, steps=200) as trainer:
        train(trainer, 200)
        trainer.save(tmp_path / "a.zip", {}, {"best": None})
    FrozenPolicy.load(tmp_path / "a.zip")


def test_numbers_of_the_environment_that_are_not_finite_end_the_run(spoilt):
    text = r"^test/Spoilt-v0: observation\[1\] is nan at step 3 of an episode"
    with made(env=spoilt) as trainer, pytest.raises(EnvironmentFailed, match=text):
        train(trainer, 64)


def test_a_foreign_environment_of_this_process_reaches_the_runners(corridor):
    with made(env=corridor, normalize=True) as trainer:
        statistics = train(trainer, 64)
    assert statistics.episodes > 5
    assert 0 <= statistics.success_rate <= 1
    assert statistics.length_mean >= 1


@pytest.mark.parametrize("env", ["CartPole-v1", "bam/reach"], ids=["RLlib's runner", "ours"])
def test_an_episode_that_ends_alone_in_an_iteration_counts(env):
    """RLlib makes a number of a list of one; with a time limit of 20 steps, few of these iterations see two ends."""
    hyper = {**PPO, "train_batch_size_per_learner": 8, "minibatch_size": 8}
    counts = [0]
    with made(env=env, num_envs=1, steps=80, hyper=hyper, env_kwargs={"max_episode_steps": 20}) as trainer:
        trainer.train(80, lambda progress: counts.append(progress.statistics().episodes) or True)
        statistics = train(trainer, 88)
    assert 1 in np.diff(counts)
    assert statistics.episodes >= 4
    assert statistics.length_mean <= 20
    assert (statistics.success_rate is None) == (env == "CartPole-v1")
    if env == "CartPole-v1":
        assert statistics.return_mean == statistics.length_mean


class Sampled(gym.Env):
    """Draws observations of any space, and takes any action."""

    def __init__(self, observed, acted=None):
        self.observation_space, self.action_space = observed, acted or Discrete(2, start=-1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), 1.0, bool(self.np_random.random() < 0.1), False, {}


@pytest.fixture
def sampled():
    """Registers an environment of these spaces for one test; its id."""

    def make(*spaces):
        gym.register("test/Sampled-v0", entry_point=lambda: Sampled(*spaces))
        return "test/Sampled-v0"

    yield make
    gym.registry.pop("test/Sampled-v0", None)


@pytest.mark.parametrize(
    ("space", "normalize"),
    [
        (Box(0, 9, (3,), np.int32), True),
        (Box(-1, 1, (3, 2)), False),
        (Box(-1, 1, (), np.float64), True),
        (Discrete(3, start=5), False),
    ],
    ids=["whole numbers", "two axes", "one number", "start"],
)
def test_observations_that_rllib_takes_as_a_vector_alone(space, normalize, sampled, tmp_path):
    with made(env=sampled(space), normalize=normalize) as trainer:
        train(trainer, 64)
        trainer.save(tmp_path / "a.zip", {}, {"best": None})
        assert FrozenPolicy.load(tmp_path / "a.zip").act(space.sample()) in (-1, 0)
        assert trainer.exploring().act(space.sample()) in (-1, 0)


@pytest.mark.parametrize("env_id", ["bam/context-bandit-v0", "bam/grid-world-v0"])
def test_environments_without_a_robot(env_id, tmp_path):
    env = gym.make(env_id)
    with made(env=env_id) as trainer:
        train(trainer, 64)
        trainer.save(tmp_path / "a.zip", {}, {"best": None})
    assert env.action_space.contains(FrozenPolicy.load(tmp_path / "a.zip").act(env.observation_space.sample()))


@pytest.mark.parametrize(
    ("spaces", "hyper", "text"),
    [
        ([Box(0, 255, (42, 42, 3), np.uint8)], {}, "the rllib trainer takes images of floats, found uint8"),
        ([Dict(a=Dict(b=Discrete(2)))], {}, "observation 'a': a Dict cannot be frozen"),
        ([Tuple((Discrete(2),))], {}, "a Tuple cannot be frozen"),
        ([Discrete(2), Box(-1, 1, (2, 2))], {}, "cannot be set up: Action space has multiple dimensions"),
        ([Discrete(2)], {"use_lstm": True}, "a recurrent network of RLlib cannot be frozen; train without use_lstm"),
    ],
)
def test_what_cannot_be_frozen_is_refused_before_training(spaces, hyper, text, sampled):
    with pytest.raises(BamTrainError) as caught:
        made(env=sampled(*spaces), hyper={**PPO, "model_config": {**SMALL, **hyper}})
    assert text in str(caught.value)


@pytest.mark.filterwarnings("ignore:.*Overriding environment rllib-single-agent-env-v0")  # by RLlib's own runner
def test_a_script_needs_one_import():
    from ray.rllib.algorithms.ppo import PPOConfig

    config = (
        PPOConfig()
        .environment("bam/reach", env_config={"randomize": True})
        .env_runners(num_env_runners=1, num_envs_per_env_runner=2)
        .training(train_batch_size_per_learner=64, minibatch_size=32, num_epochs=1)
    )
    algorithm = config.build_algo()
    assert algorithm.train()["env_runners"]["num_env_steps_sampled_lifetime"] >= 64
    algorithm.stop()
    Path(algorithm.logdir).rmdir()


def test_every_environment_of_ours_is_registered():
    from ray.tune.registry import ENV_CREATOR, _global_registry

    for env_id in own_ids():
        assert _global_registry.contains(ENV_CREATOR, env_id)
        assert _global_registry.contains(ENV_CREATOR, env_id.rpartition("-v")[0])


def test_recorded_episodes_teach(trained, tmp_path):
    from bam_train.data.collect import collect

    _, checkpoint = trained
    place, moved = str(tmp_path / "recorded"), str(tmp_path / "moved")
    collect(place, str(checkpoint.path), episodes=3, num_envs=2)
    shutil.copytree(place, moved)
    collect(other := str(tmp_path / "other"), str(checkpoint.path), episodes=1, seed=7)
    hyper = {"train_batch_size_per_learner": 64, "model_config": SMALL}
    zeros = np.zeros(FrozenPolicy.load(checkpoint.path).observation_space["shape"], np.float32)
    for algo in ("bc", "marwil"):
        with made(algo, hyper=hyper, data=place, steps=640) as trainer:
            train(trainer, 640)
            assert trainer.steps == 640
            saved = Checkpoint.open(trainer.save(tmp_path / f"{algo}.zip", {}, {"best": None}).path)
        with contextlib.closing(
            RLlibTrainer.load(saved, resolve_resumed({"steps": 641, "data": moved}, saved))
        ) as again:
            np.testing.assert_allclose(again.freeze().act(zeros), FrozenPolicy.load(saved.path).act(zeros), atol=1e-6)
            train(again, 641)
            again.save(tmp_path / f"{algo}-2.zip", {}, {"best": None})
    with pytest.raises(CheckpointMismatch, match=r"was trained on an episode \(\w{12}\) that .*other does not have"):
        RLlibTrainer.load(saved, resolve_resumed({"steps": 641, "data": other}, saved))


@pytest.mark.training
def test_fifty_scripted_episodes_are_cloned(shared_ray, tmp_path):
    from bam_train.data.collect import collect

    shared_ray.start()
    place = str(tmp_path / "scripted")
    collect(place, "scripted", "bam/pick-v0", episodes=50)
    with made("bc", "bam/pick", {}, data=place, steps=300_000) as trainer:
        train(trainer, 300_000)
        result = evaluate(trainer.freeze(), "bam/pick-v0", episodes=100)
    assert result.successes >= 90  # 100 were measured


def test_plain_rows_are_refused_with_the_remedy(tmp_path):
    (tmp_path / "a.parquet").touch()
    with pytest.raises(BadDataSet) as caught:
        made("bc", hyper={}, data=str(tmp_path))
    assert str(caught.value) == (
        f"{tmp_path}: is no data set: it has no meta/info.json; give a folder that bam-data wrote, "
        f"or make one of recordings or Parquet rows: bam-data import PLACE {tmp_path}"
    )


def test_what_a_learner_elsewhere_says_of_recorded_actions(sampled, tmp_path):
    seen = Box(-1, 1, (2,))
    with DataSetWriter(
        tmp_path / "data", DataSetInfo("test/Sampled-v0", {}, seen, Discrete(2, start=-1), 1.0)
    ) as writer:
        writer.add(Episode(np.zeros((3, 2), np.float32), np.array([-1, 7]), np.ones(2), True, False))
    hyper, env = {"train_batch_size_per_learner": 8, "model_config": SMALL}, sampled(seen)
    with (
        made("bc", env, hyper, data=str(tmp_path / "data"), steps=64, num_learners=1) as trainer,
        pytest.raises(SettingsError, match="actions: expected -1 to 0, found 7"),
    ):
        train(trainer, 64)
