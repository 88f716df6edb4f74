"""One run of stable-baselines3: what it saves, what it freezes, how it fails."""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN

from bam_envs.core.errors import LinkLost
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_train.checkpoint import Checkpoint
from bam_train.errors import CheckpointError, EnvironmentFailed, SettingsError, TrainingFailed
from bam_train.policy import FrozenPolicy
from bam_train.settings import TrainSettings
from bam_train.trainers.sb3.sb3_trainer import SB3Trainer

FIRST = {"n_steps": 32, "batch_size": 32, "n_epochs": 2}


def completed(env, algo="ppo", **given):
    return SB3Trainer.complete(
        TrainSettings.from_mapping({"env": env, "algo": algo, "steps": 96, "num_envs": 2, **given})
    )


def test_a_checkpoint_says_where_it_comes_from_and_holds_the_policy(walk, tmp_path):
    trainer = SB3Trainer.create(completed(walk, hyperparameters=FIRST, seed=4))
    trainer.train(96, lambda progress: True)
    trainer.save(tmp_path / "a.zip", {"success_rate": 0.5}, {"best": None})
    manifest = Checkpoint.open(tmp_path / "a.zip").manifest
    assert (manifest.env, manifest.algorithm, manifest.trainer, manifest.seed) == (walk, "ppo", "sb3", 4)
    assert manifest.steps == trainer.steps == 128
    assert (manifest.scores, manifest.period) == ({"success_rate": 0.5}, pytest.approx(1 / 20))
    assert TrainSettings.from_mapping(manifest.settings) == trainer.settings
    assert {"python", "torch", "stable-baselines3", "gymnasium"} <= manifest.versions.keys()
    assert manifest.created.endswith("+00:00")
    resume = [f"bam/resume/{name}" for name in ("model.json", "model.safetensors", "state.json", "state.safetensors")]
    ours = {"bam/policy.onnx", "bam/golden.safetensors", *resume, "bam/resume/notes.json"}
    assert {name for name in manifest.sha256 if name.startswith("bam/")} == ours
    observations = np.random.default_rng(0).uniform(-1, 1, (200, 2)).astype(np.float32)
    wanted = trainer.model.predict(observations, deterministic=True)[0]
    for policy in (trainer.freeze(), FrozenPolicy.load(tmp_path / "a.zip")):
        assert np.abs(policy.act_batch(observations) - wanted).max() <= 1e-5


def test_training_on_coarse_physics_is_noted_resumed_and_evaluated_on_the_usual_one(tmp_path):
    given = {"num_envs": 4, "coarse_physics": True, "hyperparameters": FIRST}
    trainer = SB3Trainer.create(completed("bam/reach-v0", **given))
    assert trainer.venv.batch.unwrapped.robot.coarse
    trainer.train(96, lambda progress: True)
    trainer.save(tmp_path / "a.zip", {}, {"best": None})
    trainer.train(256, lambda progress: True)
    again = SB3Trainer.load(Checkpoint.open(tmp_path / "a.zip"))
    again.train(256, lambda progress: True)
    assert again.venv.batch.unwrapped.robot.physics.model.opt.timestep == pytest.approx(0.01)
    np.testing.assert_array_equal(again.model._last_obs, trainer.model._last_obs)
    with trainer.evaluation_envs() as envs:
        assert envs is None  # `evaluate` makes its own


@pytest.mark.parametrize("env", ["CartPole-v1", "bam/ur-reach-v0"])
def test_no_coarse_physics_without_an_arm_that_mujoco_simulates(env):
    with pytest.raises(SettingsError) as caught:
        SB3Trainer.create(completed(env, coarse_physics=True, hyperparameters=FIRST))
    assert str(caught.value) == f"coarse_physics: {env} has no arm that MuJoCo simulates; leave it out"


@pytest.mark.parametrize("normalize", [False, True])
def test_a_new_run_begins_with_the_weights_of_another(walk, tmp_path, normalize):
    path = tmp_path / "plain.zip"
    plain = SB3Trainer.create(completed(walk, hyperparameters=FIRST, seed=4, normalize=normalize))
    plain.train(96, lambda progress: True)
    plain.save(path, {}, {"best": None})
    hardened = SB3Trainer.create(completed(walk, hyperparameters=FIRST, seed=5, normalize=normalize, start=str(path)))
    assert hardened.steps == 0
    observations = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    np.testing.assert_array_equal(hardened.freeze().act_batch(observations), plain.freeze().act_batch(observations))
    hardened.train(96, lambda progress: True)
    hardened.save(tmp_path / "hard.zip", {}, {"best": None})
    path.unlink()  # a resumed run needs its own checkpoint only
    again = SB3Trainer.load(Checkpoint.open(tmp_path / "hard.zip"))
    assert (again.steps, again.settings.start) == (hardened.steps, str(path))


def test_a_run_with_another_kind_of_noise_begins_with_the_weights_and_its_own_noise(walk, tmp_path):
    """Checkpoints of before the presets had noise that lasts (gSDE) are still good beginnings."""
    path = tmp_path / "plain.zip"
    plain = SB3Trainer.create(completed(walk, hyperparameters=FIRST))
    plain.train(96, lambda progress: True)
    plain.save(path, {}, {"best": None})
    lasting = {**FIRST, "use_sde": True, "policy_kwargs": {"log_std_init": -1.8}}
    trainer = SB3Trainer.create(completed(walk, hyperparameters=lasting, start=str(path)))
    observations = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    np.testing.assert_array_equal(trainer.freeze().act_batch(observations), plain.freeze().act_batch(observations))
    assert torch.equal(trainer.model.policy.log_std, torch.full_like(trainer.model.policy.log_std, -1.8))
    trainer.train(96, lambda progress: True)


def test_weights_that_a_run_cannot_begin_with(walk, tmp_path):
    path = tmp_path / "a.zip"
    trainer = SB3Trainer.create(completed(walk, hyperparameters=FIRST))
    trainer.train(64, lambda progress: True)
    trainer.save(path, {}, {"best": None})
    for given, text in (
        ({"algo": "a2c"}, "was trained by ppo of sb3: a2c of sb3 cannot begin with it; leave start out, or give "),
        ({"hyperparameters": {"policy_kwargs": {"net_arch": [8]}}}, "bam/resume/model does not fit these settings: "),
    ):
        with pytest.raises(CheckpointError, match=text) as caught:
            SB3Trainer.create(completed(walk, start=str(path), **given))
        assert str(caught.value).startswith(f"{path}: ")


def test_it_trains_on_as_many_environments_as_the_servers_have(walk, rows, tmp_path):
    with contextlib.ExitStack() as stack:
        servers = [TcpServer(EnvServer(env, env_id=walk)) for env in (gym.make(walk), rows(2))]
        urls = [stack.enter_context(server).url for server in servers]
        settings = completed(walk, hyperparameters=FIRST, transport=urls, num_envs=8)
        assert settings.num_envs == 3
        trainer = SB3Trainer.create(settings)
        trainer.train(96, lambda progress: True)
        with trainer.evaluation_envs() as lent:
            assert lent.num_envs == 3
            lent.reset(seed=1)
        trainer.train(trainer.steps + 96, lambda progress: True)
        trainer.save(tmp_path / "a.zip", {}, {"best": None})
        trainer.close()
        again = SB3Trainer.load(Checkpoint.open(tmp_path / "a.zip"))
        assert again.steps == trainer.steps
        again.close()


def test_a_link_that_drops_ends_training_with_its_own_error(walk, rows):
    with TcpServer(EnvServer(rows(2), env_id=walk)) as server:
        trainer = SB3Trainer.create(completed(walk, hyperparameters=FIRST, transport=[server.url]))
        trainer.train(64, lambda progress: True)
    with pytest.raises(LinkLost, match=r"the link is down|closed"):
        trainer.train(640, lambda progress: True)
    trainer.close()


def test_stable_baselines3_loads_it_and_can_train_it_on(corridor, tmp_path):
    trainer = SB3Trainer.create(
        completed(corridor, "dqn", hyperparameters={"learning_starts": 20, "learning_rate": "lin_1e-3"})
    )
    trainer.train(96, lambda progress: True)
    trainer.save(tmp_path / "a.zip", {}, {})
    model = DQN.load(tmp_path / "a.zip", env=gym.make(corridor))
    for cell in range(5):
        observation = np.array([cell], np.float32)
        assert model.predict(observation, deterministic=True) == trainer.model.predict(observation, deterministic=True)
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps == 96 + 20


def test_progress_and_statistics(walk):
    trainer = SB3Trainer.create(completed(walk, hyperparameters=FIRST))
    seen = []
    trainer.train(128, lambda progress: seen.append((progress.steps, progress.total, progress.statistics())) or True)
    assert [row[:2] for row in seen] == [(64, 128), (128, 128)]
    statistics = seen[-1][2]
    assert statistics.episodes > 0
    assert 0 <= statistics.success_rate <= 1
    assert 1 <= statistics.length_mean <= 12
    assert {"train/loss", "train/value_loss"} <= statistics.metrics.keys()


def test_stopping_between_updates(walk):
    trainer = SB3Trainer.create(completed(walk, "sac", hyperparameters={"learning_starts": 10}))
    trainer.train(96, lambda progress: progress.steps < 20)
    assert trainer.steps == 20
    trainer.train(20, lambda progress: pytest.fail("there is nothing to train"))


@pytest.mark.parametrize(
    ("algo", "hyperparameters", "message"),
    [
        ("ppo", {**FIRST, "learning_rate": 1e30}, "^train/entropy_loss is nan at step 64;"),
        ("ppo", {**FIRST, "learning_rate": 1e12}, "^train/entropy_loss is nan at step 64;"),
        ("a2c", {"learning_rate": 1e30}, "NaN or infinite|is nan|is -?inf"),
        ("sac", {"learning_rate": 1e30, "learning_starts": 10}, "_loss is (nan|inf)"),
    ],
)
def test_a_loss_that_is_not_finite_ends_training(walk, tmp_path, algo, hyperparameters, message):
    trainer = SB3Trainer.create(completed(walk, algo, steps=1000, hyperparameters=hyperparameters))
    with pytest.raises(TrainingFailed, match=message) as caught:
        trainer.train(1000, lambda progress: True)
    assert "expected finite numbers: try a smaller learning_rate" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("signal", ["observation", "reward"])
def test_numbers_of_the_environment_that_are_not_finite_are_not_blamed_on_the_policy(spoilt, signal):
    kwargs = {"signal": signal, "value": "inf"}  # as --set says it
    trainer = SB3Trainer.create(completed(spoilt, hyperparameters=FIRST, normalize=True, env_kwargs=kwargs))
    with pytest.raises(EnvironmentFailed, match=r"^test/Spoilt-v0: (observation\[1\]|reward) is inf at step 3 of "):
        trainer.train(96, lambda progress: True)


@pytest.mark.parametrize(
    ("part", "value", "text"),
    [
        ("mlp_extractor.policy_net.0.weight", float("nan"), "the policy's weights are NaN or infinite at step 0; "),
        ("log_std", 1000.0, "the policy's weights are NaN or infinite at step 0; "),  # its exponential is
        (
            "action_net.weight",
            3e38,
            "weights or actions are NaN or infinite after step 0; ",
        ),  # products are
    ],
)
def test_weights_that_are_not_finite_are_never_saved(walk, tmp_path, part, value, text):
    trainer = SB3Trainer.create(completed(walk, hyperparameters=FIRST))
    dict(trainer.model.policy.named_parameters())[part].data[:] = value
    with pytest.raises(TrainingFailed, match=text):
        trainer.save(tmp_path / "a.zip", {}, {})
    assert list(tmp_path.iterdir()) == []
    if "at step" in text:
        with pytest.raises(TrainingFailed, match=text):
            trainer.freeze()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"hyperparameters": {"batch_size": 1}},
            "ppo on test/Walk-v0 cannot be set up: `batch_size` must be greater than 1",
        ),
        ({"device": "cuda:99"}, "device: 'cuda:99' is not there; expected auto or one of cpu"),
    ],
)
def test_settings_that_the_library_refuses(walk, given, message):
    settings = completed(walk, **given)
    with pytest.raises(SettingsError) as caught:
        SB3Trainer.create(settings)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_what_the_library_warns_about_becomes_a_notice(walk):
    trainer = SB3Trainer.create(completed(walk, hyperparameters={"n_steps": 10, "batch_size": 64}))
    size = "batch_size 64 does not divide a rollout of n_steps 10 x num_envs 2 = 20 steps: its last batch has 20"
    assert trainer.notices == [size]


@pytest.mark.parametrize(("steps", "every"), [(500, 1000), (100_000, 5000)])
def test_evaluations_by_default(corridor, steps, every):
    assert completed(corridor, steps=steps).eval_every == every
    with pytest.raises(SettingsError, match=r"test/Corridor-v0 cannot be made with these arguments: "):
        completed(corridor, env_kwargs={"slwo": True})


def test_tensorboard_files(walk, tmp_path):
    trainer = SB3Trainer.create(completed(walk, hyperparameters=FIRST))
    trainer.log_to(tmp_path)
    trainer.train(128, lambda progress: trainer.log({"eval/return_mean": 1.5}) or True)
    trainer.close()
    events = b"".join(path.read_bytes() for path in tmp_path.iterdir())
    assert b"eval/return_mean" in events
    assert b"train/value_loss" in events


class Seen(gym.Env):
    """Random images, channels last, and numbers."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, continuous=False):
        image, x = gym.spaces.Box(0, 255, (36, 36, 3), np.uint8), gym.spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = gym.spaces.Dict({"image": image, "x": x})
        self.action_space = gym.spaces.Box(-1, 1, (1,)) if continuous else gym.spaces.MultiDiscrete([2, 3])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.look(), {}

    def look(self):
        image = self.np_random.integers(0, 256, (36, 36, 3), dtype=np.uint8)
        return {"image": image, "x": self.np_random.uniform(-1, 1, 2).astype(np.float32)}

    def step(self, action):
        return self.look(), 1.0, bool(self.np_random.random() < 0.1), False, {}


@pytest.fixture
def seen():
    gym.register("test/Seen-v0", entry_point=Seen)
    yield "test/Seen-v0"
    del gym.registry["test/Seen-v0"]


SAC = {"learning_starts": 8, "batch_size": 4, "buffer_size": 100, "policy_kwargs": {"net_arch": [8]}}


@pytest.mark.parametrize(
    ("algo", "given"),
    [
        ("ppo", {"hyperparameters": {"n_steps": 8, "batch_size": 8, "n_epochs": 1}}),
        ("sac", {"hyperparameters": SAC}),
        ("sac", {"hyperparameters": SAC, "normalize": {"norm_obs_keys": ["x"]}}),
        ("sac", {"hyperparameters": SAC, "normalize": {"norm_obs": False}}),
        ("sac", {"hyperparameters": SAC, "normalize": True}),
    ],
)
def test_images_and_dictionaries(seen, tmp_path, algo, given):
    kwargs = {"continuous": algo == "sac"}
    trainer = SB3Trainer.create(completed(seen, algo, env_kwargs=kwargs, **given))
    trainer.train(16, lambda progress: True)
    trainer.save(tmp_path / "a.zip", {}, {})
    checkpoint = Checkpoint.open(tmp_path / "a.zip")
    assert checkpoint.manifest.observation_space["spaces"]["image"]["dtype"] == "uint8"
    SB3Trainer.load(checkpoint).train(32, lambda progress: True)
    env = gym.make(seen, **kwargs)
    assert env.action_space.contains(FrozenPolicy.load(tmp_path / "a.zip").act(env.reset(seed=1)[0]))
