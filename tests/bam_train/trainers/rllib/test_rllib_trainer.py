"""One run of RLlib: what it saves, what it freezes, how it goes on and how it is refused."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Tuple

pytest.importorskip("ray")

import ray

from bam_train.checkpoint import Checkpoint
from bam_train.compat.rllib_export import export
from bam_train.errors import BamTrainError, CheckpointMismatch, EnvironmentFailed, SettingsError
from bam_train.policy import FrozenPolicy
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import RLLIB_ALGORITHMS
from bam_train.trainers.resolve_settings import resolve, resolve_resumed
from bam_train.trainers.rllib import rllib_hyperparameters as hyperparameters
from bam_train.trainers.rllib import rllib_state as state
from bam_train.trainers.rllib.algorithm_config import envs_each
from bam_train.trainers.rllib.recorded_episodes import load
from bam_train.trainers.rllib.rllib_registration import own_ids
from bam_train.trainers.rllib.rllib_trainer import RLlibTrainer

pytestmark = [
    pytest.mark.usefixtures("one_ray"),
    pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:ray"),  # Ray's own, of its data library
]

SMALL = {"fcnet_hiddens": [16, 16]}
PPO = {"train_batch_size_per_learner": 128, "minibatch_size": 64, "num_epochs": 2, "model_config": SMALL}


def settled(algo="ppo", env="bam/reach", hyper=PPO, **given):
    return resolve(
        {"env": env, "algo": algo, "trainer": "rllib", "steps": 256, "num_envs": 4, "hyperparameters": hyper, **given}
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    trainer = RLlibTrainer.create(settled(normalize=True, seed=3))
    seen = []
    trainer.train(256, lambda progress: seen.append((progress.steps, progress.total)) or True)
    assert seen == [(128, 256), (256, 256)]
    path = tmp_path_factory.mktemp("trained") / "a.zip"
    yield trainer, trainer.save(path, {"success_rate": 0.5}, {"best": None})
    trainer.close()


def test_a_run_saves_what_it_is(trained):
    trainer, checkpoint = trained
    manifest = checkpoint.manifest
    assert (manifest.env, manifest.algorithm, manifest.trainer, manifest.steps) == ("bam/reach-v0", "ppo", "rllib", 256)
    assert manifest.versions["ray"] == ray.__version__
    assert manifest.period == pytest.approx(0.05)
    assert checkpoint.has("bam/resume/rllib/learner_group/learner/rl_module/default_policy/module_state.pkl")
    assert TrainSettings.from_mapping(manifest.settings) == trainer.settings


def test_the_frozen_policy_is_the_policy(trained):
    trainer, checkpoint = trained
    observations = np.random.default_rng(0).uniform(-1, 1, (50, *trainer._seen.observation_space.shape))
    observations = observations.astype(np.float32)
    frozen = FrozenPolicy.load(checkpoint.path).act_batch(observations)
    assert np.abs(frozen - trainer.freeze().act_batch(observations)).max() <= 1e-6
    runner = trainer.algorithm.env_runner
    runner._seen = runner._filter.normalize(observations, update=False)
    _, actions = runner._act(0, explore=False)
    assert np.abs(frozen - actions).max() <= 1e-5


def test_it_goes_on_where_it_stopped(trained):
    trainer, checkpoint = trained
    again = RLlibTrainer.load(Checkpoint.open(checkpoint.path))
    assert again.steps == 256
    mine, theirs = trainer._module().state_dict(), again._module().state_dict()
    assert all(np.array_equal(mine[name], theirs[name]) for name in mine)
    ours, its = (one.algorithm.env_runner._filter._filters[None].running_stats for one in (trainer, again))
    assert (ours.num_pushes, ours.mean_array.tolist()) == (its.num_pushes, its.mean_array.tolist())
    first, second = (one.algorithm.learner_group._learner._optimizer_parameters for one in (trainer, again))
    moments = [next(iter(one)).state_dict()["state"][0]["exp_avg"] for one in (first, second)]
    assert np.array_equal(moments[0], moments[1])
    again.train(384, lambda progress: True)
    assert again.steps == 384
    assert again.algorithm.iteration == 3
    assert "running episodes" in again.notices[0]
    again.close()


@pytest.mark.parametrize(
    ("name", "hyper"),
    [
        ("ppo", {"train_batch_size_per_learner": 100, "num_epochs": 1}),
        ("dqn", {"epsilon": [[0, 1.0], [10000, 0.05]]}),
    ],
)
def test_training_goes_on_from_a_directory_of_rllib(name, hyper, rllib_directories, tmp_path):
    """Of its present API: settings, weights, filter and counters are the directory's."""
    saved = Checkpoint.open(export(rllib_directories / name, trust=True).write(tmp_path / "a.zip").path)
    settings = resolve_resumed({"steps": saved.manifest.steps + 100}, saved)
    assert settings.hyperparameters["model_config"]["fcnet_hiddens"] == [16, 16]
    assert {key: settings.hyperparameters[key] for key in hyper} == hyper
    trainer = RLlibTrainer.load(saved, settings)
    observations = trainer._seen.observation_space.sample()[None].repeat(9, 0)
    np.testing.assert_array_equal(
        trainer.freeze().act_batch(observations), FrozenPolicy.load(saved.path).act_batch(observations)
    )
    assert trainer.steps == saved.manifest.steps == (100 if name == "ppo" else 0)
    trainer.train(settings.steps, lambda progress: True)
    assert settings.steps <= trainer.steps <= settings.steps + 200
    again = trainer.save(tmp_path / "b.zip", {}, {})
    trainer.close()
    assert Checkpoint.open(again.path).manifest.settings == settings.to_mapping()


def test_it_goes_on_with_other_runners_and_not_with_another_ray(trained, monkeypatch):
    _, checkpoint = trained
    given = {"num_env_runners": 1, "steps": 1000}
    assert resolve_resumed(given, checkpoint).num_env_runners == 1
    monkeypatch.setattr(ray, "__version__", "9.1.0")
    with pytest.raises(CheckpointMismatch, match=r"was trained with Ray 2\.\d+\.\d+, and this is Ray 9\.1\.0"):
        state.require_version(checkpoint)


def test_one_runner_process_samples_and_counts_exactly():
    trainer = RLlibTrainer.create(settled(num_env_runners=1, normalize=True, env_kwargs={"randomize": True}))
    trainer.train(128, lambda progress: True)
    assert (trainer.steps, trainer.notices) == (128, [])
    stats = trainer._env_to_module().connectors[0]._filters[None].running_stats
    assert stats.num_pushes >= 128
    trainer.close()


@pytest.mark.parametrize(
    ("algo", "env", "hyper"),
    [
        ("appo", "bam/reach", {"train_batch_size_per_learner": 100, "model_config": SMALL}),
        ("impala", "bam/reach", {"train_batch_size_per_learner": 100, "model_config": SMALL}),
        ("dqn", "CartPole-v1", {"num_steps_sampled_before_learning_starts": 100, "model_config": SMALL}),
        ("sac", "bam/reach", {"num_steps_sampled_before_learning_starts": 190, "train_batch_size_per_learner": 16}),
    ],
)
def test_other_algorithms_train_and_freeze(algo, env, hyper, tmp_path):
    trainer = RLlibTrainer.create(settled(algo, env, hyper, steps=200))
    trainer.train(200, lambda progress: True)
    assert trainer.steps >= 200
    trainer.save(tmp_path / "a.zip", {}, {"best": None})
    trainer.close()
    FrozenPolicy.load(tmp_path / "a.zip")


def test_numbers_of_the_environment_that_are_not_finite_end_the_run(spoilt):
    trainer = RLlibTrainer.create(settled(env=spoilt))
    with pytest.raises(EnvironmentFailed, match=r"^test/Spoilt-v0: observation\[1\] is nan at step 3 of an episode"):
        trainer.train(128, lambda progress: True)
    trainer.close()


def test_a_foreign_environment_of_this_process_reaches_the_runners(corridor):
    trainer = RLlibTrainer.create(settled(env=corridor, normalize=True))
    trainer.train(128, lambda progress: True)
    statistics = trainer._statistics()
    assert statistics.episodes > 5
    assert 0 <= statistics.success_rate <= 1
    assert statistics.length_mean >= 1
    trainer.close()


@pytest.mark.parametrize("env", ["CartPole-v1", "bam/reach"], ids=["RLlib's runner", "ours"])
def test_an_episode_that_ends_alone_in_an_iteration_counts(env):
    """RLlib makes a number of a list of one; with a time limit of 20 steps, few of these iterations see two ends."""
    hyper = {**PPO, "train_batch_size_per_learner": 8, "minibatch_size": 8, "num_epochs": 1}
    trainer = RLlibTrainer.create(
        settled(env=env, num_envs=1, steps=80, hyper=hyper, env_kwargs={"max_episode_steps": 20})
    )
    lifetime = []
    trainer.train(80, lambda _: lifetime.append(trainer._result["env_runners"]["num_episodes_lifetime"]) or True)
    statistics = trainer._statistics()
    trainer.close()
    assert 1 in np.diff([0, *lifetime])
    assert statistics.episodes == lifetime[-1] >= 4
    assert statistics.length_mean <= 20
    if env == "CartPole-v1":
        assert statistics.return_mean == statistics.length_mean


@pytest.mark.parametrize(("number", "runners", "each"), [(64, 0, 64), (64, 2, 32), (64, 3, 21), (5, 2, 2), (1, 4, 1)])
def test_runners_share_the_environments(number, runners, each):
    assert envs_each(TrainSettings(env="bam/reach-v0", algo="ppo", num_envs=number, num_env_runners=runners)) == each


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
    trainer = RLlibTrainer.create(settled(env=sampled(space), steps=128, normalize=normalize))
    trainer.train(128, lambda progress: True)
    trainer.save(tmp_path / "a.zip", {}, {"best": None})
    assert FrozenPolicy.load(tmp_path / "a.zip").act(space.sample()) in (-1, 0)
    assert trainer.exploring().act(space.sample()) in (-1, 0)
    trainer.close()


@pytest.mark.parametrize(
    ("spaces", "hyper", "text"),
    [
        (
            [Box(0, 255, (42, 42, 3), np.uint8)],
            {},
            "test/Sampled-v0: the rllib trainer takes images of floats, found uint8",
        ),
        ([Dict(a=Dict(b=Discrete(2)))], {}, "observation 'a': a Dict cannot be frozen"),
        ([Tuple((Discrete(2),))], {}, "a Tuple cannot be frozen"),
        ([Discrete(2), Box(-1, 1, (2, 2))], {}, "cannot be set up: Action space has multiple dimensions"),
        ([Discrete(2)], {"use_lstm": True}, "a recurrent network of RLlib cannot be frozen; train without use_lstm"),
    ],
)
def test_what_cannot_be_frozen_is_refused_before_training(spaces, hyper, text, sampled):
    with pytest.raises(BamTrainError) as caught:
        RLlibTrainer.create(settled(env=sampled(*spaces), hyper={**PPO, "model_config": {**SMALL, **hyper}}))
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"algo": "pp"}, "Unknown algorithm 'pp'. Did you mean 'ppo'?"),
        ({"hyperparameters": {"gama": 0.9}}, "Unknown ppo hyperparameter 'gama'. Did you mean 'gamma'?"),
        (
            {"hyperparameters": {"train_batch_size": 9}},
            "train_batch_size is not a hyperparameter here: use train_batch",
        ),
        (
            {"env": "CartPole-v1", "algo": "sac", "hyperparameters": {"twin_q": False}},
            "twin_q: expected true, as actions are choices, found false. Leave it out",
        ),
        *(
            ({"hyperparameters": {old: 1}}, f"{old} is not a hyperparameter here: use {now}")
            for old, now in (
                ("num_workers", "--num-env-runners"),
                ("num_rollout_workers", "--num-env-runners"),
                ("num_envs_per_worker", "--num-envs"),
                ("observation_filter", "normalize=true"),
                ("learning_rate", "lr"),
            )
        ),
        *(
            ({"hyperparameters": {old: 1}}, f"{old}: there is none here; {why}")
            for old, why in (
                ("num_gpus_per_worker", "env runners use no GPU, and --num-gpus is for the learners"),
                ("log_level", "RLlib's log is off"),
                ("horizon", "the environment ends its episodes"),
            )
        ),
        (
            {"hyperparameters": {"lr": "fast"}},
            "lr: expected a number or a schedule [[step, value], ...], found 'fast'",
        ),
        ({"hyperparameters": {"lr": -1}}, "lr: expected a number above 0, found -1"),
        *(
            (
                {"hyperparameters": {name: schedule}},
                f"{name}: expected a number or a schedule [[0, value], [step, value]",
            )
            for name in ("lr", "entropy_coeff")
            for schedule in ([], [[0, 1e-3]], [[5, 1e-3], [9, 0.0]], [[0, 1e-3], [9, 0.0], [8, 0.0]], [[0, 1e-3], [9]])
        ),
        ({"hyperparameters": {"lr": [[0, 1e-3], [9, -1]]}}, "lr: expected a number of at least 0, found -1"),
        ({"hyperparameters": {"gamma": None}}, "gamma: expected a number, found None"),
        ({"hyperparameters": {"num_epochs": None}}, "num_epochs: expected a whole number, found None"),
        ({"hyperparameters": {"model_config": 5}}, "model_config: expected a table of named values, found 5"),
        *(
            (
                {"hyperparameters": {"model_config": {"fcnet_hiddens": sizes}}},
                "model_config.fcnet_hiddens: expected one",
            )
            for sizes in ([], [0], [8, -3])
        ),
        (
            {"hyperparameters": {"model_config": {"head_fcnet_hiddens": [0]}}},
            "model_config.head_fcnet_hiddens: expected",
        ),
        ({"algo": "sac", "hyperparameters": {"n_step": 0}}, "n_step: expected a whole number of at least 1, found 0"),
        (
            {"algo": "sac", "hyperparameters": {"target_entropy": "x"}},
            "target_entropy: expected a number or 'auto', found",
        ),
        ({"algo": "sac", "hyperparameters": {"n_step": [3, 1]}}, "n_step: expected [least, most] of at least 1, found"),
        (
            {"algo": "sac", "hyperparameters": {"initial_alpha": -1}},
            "initial_alpha: expected a number above 0, found -1",
        ),
        *(
            ({"algo": "sac", "hyperparameters": {"replay_buffer_config": buffer}}, f"replay_buffer_config{text}")
            for buffer, text in (
                ({"capacty": 9}, " argument 'capacty'. Did you mean 'capacity'?"),
                ({"capacity": 0}, ".capacity: expected at least 1, found 0"),
                ({"type": "Foo"}, ".type: expected EpisodeReplayBuffer or PrioritizedEpisodeReplayBuffer, found 'Foo'"),
            )
        ),
        ({"hyperparameters": {"model_config": {"fcnet_hidden": []}}}, "Unknown model_config argument 'fcnet_hidden'"),
        ({"algo": "dqn"}, "dqn does not fit bam/reach-v0: it takes Discrete actions, found Box"),
        ({"algo": "bc"}, "data: bc learns from recorded episodes, found none"),
        ({"data": "x"}, "data: ppo learns in the environment"),
        ({"device": "cuda"}, "device: rllib learns on the CPU, or on as many GPUs as --num-gpus says; found 'cuda'."),
        ({"transport": ["tcp://127.0.0.1:1"]}, "transport: the rllib trainer makes its environments"),
        ({"normalize": {"clip_value": 1}}, "Unknown normalize argument 'clip_value'. Did you mean 'clip_by_value'?"),
    ],
)
def test_settings_are_refused(given, text):
    with pytest.raises(SettingsError) as caught:
        resolve({"env": "bam/reach", "algo": "ppo", "trainer": "rllib", **given})
    assert text in str(caught.value)


def test_settings_of_rllib_are_refused_with_sb3():
    with pytest.raises(SettingsError, match="num_env_runners: the sb3 trainer has no use for it"):
        resolve({"env": "bam/reach", "algo": "ppo", "num_env_runners": 2})


@pytest.mark.parametrize(
    ("algo", "given"),
    [
        ("ppo", {"lr": [[0, 1e-3], [900, 0.0]], "entropy_coeff": [[0, 0.1], [900, 0.0]], "grad_clip": None}),
        ("ppo", {"model_config": {"head_fcnet_hiddens": []}, "minibatch_size": None}),
        ("sac", {"n_step": [1, 3], "target_entropy": -2.0, "actor_lr": [[0, 1e-3], [900, 0.0]]}),
        ("sac", {"replay_buffer_config": {"type": "EpisodeReplayBuffer", "capacity": 1e4}}),
    ],
)
def test_settings_that_look_odd_and_are_not(algo, given):
    values = hyperparameters.complete(RLLIB_ALGORITHMS[algo], given)
    for name in given.keys() - {"model_config", "replay_buffer_config"}:
        assert values[name] == given[name]


@pytest.mark.parametrize("name", sorted(RLLIB_ALGORITHMS))
def test_complete_settings_stay_as_they_are(name):
    values = hyperparameters.complete(RLLIB_ALGORITHMS[name], {})
    assert hyperparameters.complete(RLLIB_ALGORITHMS[name], values) == values


def test_the_preset_belongs_to_its_trainer():
    assert resolve({"env": "bam/pick", "algo": "ppo", "trainer": "rllib"}).hyperparameters["action_init_scale"] == 0.01
    assert "n_steps" in resolve({"env": "bam/pick", "algo": "ppo"}).hyperparameters


@pytest.mark.filterwarnings("ignore:.*Overriding environment rllib-single-agent-env-v0")  # by RLlib's own runner
@pytest.mark.parametrize(("runners", "name"), [(0, "bam/reach"), (1, "bam/reach-v0")])
def test_a_script_needs_one_import(runners, name):
    from ray.rllib.algorithms.ppo import PPOConfig

    config = (
        PPOConfig()
        .environment(name, env_config={"randomize": True})
        .env_runners(num_env_runners=runners, num_envs_per_env_runner=2)
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


def test_recorded_episodes_teach_bc(trained, tmp_path, monkeypatch, capsys):
    _, checkpoint = trained
    sys.path.insert(0, str(Path(__file__).parents[4] / "scripts"))
    import record_parquet

    folder = tmp_path / "recorded"
    arguments = ["record_parquet.py", str(checkpoint.path), "--out", str(folder), "--episodes", "5", "--num-envs", "2"]
    monkeypatch.setattr(sys, "argv", arguments)
    record_parquet.main()
    assert "5 episodes" in capsys.readouterr().out
    hyper = {"train_batch_size_per_learner": 64, "model_config": SMALL}
    for algo in ("bc", "marwil"):
        trainer = RLlibTrainer.create(settled(algo, hyper=hyper, data=str(folder), steps=640))
        trainer.train(640, lambda progress: True)
        assert trainer.steps == 640
        saved = trainer.save(tmp_path / f"{algo}.zip", {}, {"best": None})
        trainer.close()
        saved = Checkpoint.open(saved.path)
        more = resolve_resumed({"num_learners": int(algo == "bc"), "steps": 641}, saved)
        again = RLlibTrainer.load(saved, more)
        zeros = np.zeros(again._seen.observation_space.shape, np.float32)
        np.testing.assert_allclose(again.freeze().act(zeros), FrozenPolicy.load(saved.path).act(zeros), atol=1e-6)
        again.train(641, lambda progress: True)
        again.save(tmp_path / f"{algo}-2.zip", {}, {"best": None})
        assert again.steps > 640
        again.close()


def test_data_that_is_not_there_or_not_like_this(tmp_path):
    for data, text in ((tmp_path / "no", "does not exist"), (tmp_path, "has no .parquet file in it")):
        with pytest.raises(SettingsError, match=text):
            RLlibTrainer.create(settled("bc", hyper={}, data=str(data)))


def recorded(folder, **columns):
    """Six steps of two episodes of `test/Sampled-v0`, but for some columns."""
    import pyarrow
    import pyarrow.parquet

    observed = [[0.1 * k, 0.5] for k in range(6)]
    rows = {
        "eps_id": ["a"] * 3 + ["b"] * 3,
        "obs": observed,
        "actions": [-1, 0] * 3,
        "rewards": [1.0] * 6,
        "new_obs": observed,
        "terminateds": [False, False, True] * 2,
        "truncateds": [False] * 6,
    }
    pyarrow.parquet.write_table(pyarrow.table(rows | columns), folder / "a.parquet")
    return str(folder)


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        ({"actions": [-1, 0, 7, 0, 0, 0]}, "actions: expected -1 to 0, found 7"),
        ({"actions": ["x"] * 6}, "actions: expected finite numbers, found others"),
        ({"rewards": [1.0, None, 1.0, 1.0, 1.0, 1.0]}, "rewards: expected finite numbers, found others"),
        ({"obs": [[float("nan"), 0.0]] * 6}, "obs: expected finite numbers, found others"),
        (
            {"obs": [[0.0, 0.0], [1.0], [0.0, 1.0, 2.0]] * 2},
            "obs: expected rows of shape (2,), found rows of different",
        ),
        (
            {name: [] for name in ("eps_id", "obs", "actions", "rewards", "new_obs", "terminateds", "truncateds")},
            "found none",
        ),
    ],
    ids=["choice", "text", "null", "nan", "ragged", "empty"],
)
def test_recorded_rows_that_are_not_whole(columns, text, tmp_path):
    with pytest.raises(SettingsError) as caught:
        load(recorded(tmp_path, **columns), Box(-1, 1, (2,)), Discrete(2, start=-1), 0.9)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_a_learner_elsewhere_says_of_recorded_rows(sampled, tmp_path):
    hyper = {"train_batch_size_per_learner": 8, "model_config": SMALL}
    data, env = recorded(tmp_path, actions=[-1, 0, 7, 0, 0, 0]), sampled(Box(-1, 1, (2,)))
    trainer = RLlibTrainer.create(settled("bc", env, hyper, data=data, steps=64, num_learners=1))
    with pytest.raises(SettingsError, match="actions: expected -1 to 0, found 7"):
        trainer.train(64, lambda progress: True)
    trainer.close()
