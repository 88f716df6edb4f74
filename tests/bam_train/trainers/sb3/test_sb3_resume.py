"""Going on exactly: half a run, saved and loaded, then the other half, is the whole run, bit for bit."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from bam_train.checkpoint import Checkpoint
from bam_train.errors import CheckpointError
from bam_train.settings import TrainSettings
from bam_train.trainers.sb3 import sb3_resume as resume
from bam_train.trainers.sb3.sb3_trainer import SB3Trainer

SMALL = {"net_arch": [16, 16]}
ON = {"n_steps": 16, "batch_size": 48, "policy_kwargs": SMALL}
OFF = {"batch_size": 16, "learning_starts": 30, "gradient_steps": 2, "train_freq": 4, "policy_kwargs": SMALL}
DISCRETE, NORMALISED = {"env_kwargs": {"discrete": True}}, {"normalize": True}
SCHEDULES = {"learning_rate": "lin_1e-3", "clip_range": "lin_0.2"}
TOTAL = 192

RUNS = {
    "ppo": ("ppo", {**ON, "n_epochs": 2}, {}),
    "ppo-sde-normalised": ("ppo", {**ON, "n_epochs": 2, "use_sde": True, "sde_sample_freq": 4}, NORMALISED),
    "ppo-schedule-discrete": ("ppo", {**ON, "n_epochs": 2, **SCHEDULES}, DISCRETE),
    "a2c": ("a2c", {}, {}),
    "trpo": ("trpo", ON, {}),
    "recurrent-ppo": ("recurrent-ppo", {**ON, "n_epochs": 2, "policy_kwargs": {"lstm_hidden_size": 8}}, {}),
    "sac": ("sac", OFF, {}),
    "sac-full-buffer": ("sac", {**OFF, "buffer_size": 60, "use_sde": True}, NORMALISED),
    "sac-fixed-entropy": ("sac", {**OFF, "ent_coef": 0.1, "n_steps": 3}, {}),
    "td3": ("td3", {**OFF, "action_noise": "normal_0.1"}, {}),
    "ddpg": ("ddpg", {**OFF, "action_noise": "ornstein-uhlenbeck_0.2"}, {}),
    "tqc": ("tqc", OFF, {}),
    "crossq": ("crossq", OFF, {}),
    "dqn": ("dqn", {**OFF, "target_update_interval": 40}, DISCRETE),
    "qrdqn": ("qrdqn", {**OFF, "target_update_interval": 40}, DISCRETE),
}


def everything(trainer: SB3Trainer) -> dict[str, bytes]:
    """All that training goes on from."""
    return resume.members(trainer.model, trainer.venv, trainer.model.get_vec_normalize_env(), None, {})


def settings(env, name, steps=TOTAL):
    algo, hyperparameters, extra = RUNS[name]
    given = {"env": env, "algo": algo, "steps": steps, "num_envs": 3, "hyperparameters": hyperparameters, **extra}
    return SB3Trainer.complete(TrainSettings.from_mapping(given))


def trained(settings, until=TOTAL):
    """A run that stopped after an update."""
    trainer = SB3Trainer.create(settings)
    trainer.train(settings.steps, lambda progress: progress.steps < until)
    return trainer


@pytest.mark.parametrize("name", RUNS)
def test_half_and_half_is_the_whole(walk, tmp_path, name):
    whole = trained(settings(walk, name))
    half = trained(settings(walk, name), TOTAL // 2)
    assert TOTAL // 2 <= half.steps < TOTAL
    half.save(tmp_path / "half.zip", {}, {})

    torch.manual_seed(123)  # whatever another process drew
    np.random.seed(321)
    rest = SB3Trainer.load(Checkpoint.open(tmp_path / "half.zip"))
    assert rest.notices == []
    rest.train(TOTAL, lambda progress: True)
    assert rest.steps == whole.steps
    assert everything(rest) == everything(whole)


@pytest.mark.parametrize(
    ("name", "fall"),
    [
        ("ppo-schedule-discrete", "clip_range and learning_rate change"),
        ("dqn", "exploration_fraction changes"),
        ("sac", None),
    ],
)
def test_another_total_is_another_schedule_and_said(walk, tmp_path, name, fall):
    trained(settings(walk, name, steps=96), 1).save(tmp_path / "half.zip", {}, {})
    rest = SB3Trainer.load(Checkpoint.open(tmp_path / "half.zip"), settings(walk, name))
    expected = f"{fall} over all of --steps, which were 96 and are {TOTAL}: the result differs from an unbroken run's"
    assert rest.notices == ([expected] if fall else [])


def test_saving_freezing_and_looking_disturb_nothing(walk, tmp_path):
    expected = everything(trained(settings(walk, "sac", steps=96)))
    watched = SB3Trainer.create(settings(walk, "sac", steps=96))

    def look(progress):
        progress.statistics()
        watched.freeze().act_batch(np.zeros((2, 2), np.float32))
        with watched.undisturbed():
            torch.rand(3)
            np.random.rand(3)
        if progress.steps > 70:
            watched.save(tmp_path / "a.zip", {}, {})
        return True

    watched.train(96, look)
    assert everything(watched) == expected


def test_a_loaded_run_can_be_saved_before_it_goes_on(walk, tmp_path):
    trained(settings(walk, "ddpg"), 1).save(tmp_path / "a.zip", {}, {})
    SB3Trainer.load(Checkpoint.open(tmp_path / "a.zip")).save(tmp_path / "b.zip", {}, {})
    one, two = Checkpoint.open(tmp_path / "a.zip"), Checkpoint.open(tmp_path / "b.zip")
    members = [name for name in one.manifest.sha256 if name.startswith("bam/")]
    assert len(members) == 9
    for name in members:
        assert one.read(name) == two.read(name), name


PROGRAM = """
import hashlib, sys
from bam_train.checkpoint import Checkpoint
from bam_train.trainers.sb3 import sb3_resume as resume
from bam_train.trainers.sb3.sb3_trainer import SB3Trainer
for path in sys.argv[1:]:
    trainer = SB3Trainer.load(Checkpoint.open(path))
    trainer.train(trainer.settings.steps, lambda progress: True)
    state = resume.members(trainer.model, trainer.venv, None, None, {})
    print(trainer.steps, hashlib.sha256(b"".join(state.values())).hexdigest())
"""


@pytest.mark.slow
def test_half_a_run_in_simulation_goes_on_in_a_new_process(tmp_path):
    runs = {
        "ppo": {"n_steps": 25, "batch_size": 100, "n_epochs": 2},
        "sac": {"learning_starts": 100, "train_freq": 25, "gradient_steps": 2, "batch_size": 32},
    }
    given = {"env": "bam/pick-v0", "steps": 400, "num_envs": 8}
    expected = []
    for algo, hyperparameters in runs.items():
        mapping = {**given, "algo": algo, "hyperparameters": hyperparameters}
        complete = SB3Trainer.complete(TrainSettings.from_mapping(mapping))
        trained(complete, 200).save(tmp_path / f"{algo}.zip", {}, {})
        state = everything(trained(complete, 400))
        expected.append(f"400 {hashlib.sha256(b''.join(state.values())).hexdigest()}")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    command = [sys.executable, "-c", PROGRAM, *(str(tmp_path / f"{algo}.zip") for algo in runs)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment, check=False)
    assert done.stdout.splitlines() == expected, done.stderr


def test_a_foreign_environment_begins_new_episodes_and_says_so(corridor, tmp_path):
    given = {"env": corridor, "algo": "ppo", "steps": 128, "hyperparameters": {"n_steps": 32, "batch_size": 32}}
    trained(SB3Trainer.complete(TrainSettings.from_mapping(given)), 64).save(tmp_path / "a.zip", {}, {})
    resumed = [SB3Trainer.load(Checkpoint.open(tmp_path / "a.zip")) for _ in range(2)]
    expected = "test/Corridor-v0 cannot save running episodes: new ones begin, so the rest differs from an unbroken run"
    assert resumed[0].notices == [expected]
    for one in resumed:
        one.train(128, lambda progress: True)
        assert one.steps == 128
    one, two = (everything(trainer)["bam/resume/model.safetensors"] for trainer in resumed)
    assert one == two


def test_a_resume_state_of_another_network_is_refused(walk, tmp_path):
    trained(settings(walk, "ppo"), 1).save(tmp_path / "a.zip", {}, {})
    checkpoint = Checkpoint.open(tmp_path / "a.zip")
    other = TrainSettings.from_mapping(
        {**checkpoint.manifest.settings, "hyperparameters": {"policy_kwargs": {"net_arch": [4]}}}
    )
    with pytest.raises(CheckpointError, match=r"bam/resume/model does not fit these settings: "):
        SB3Trainer.load(checkpoint, SB3Trainer.complete(other))


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """A checkpoint that any run may go on from, once what a stranger changed is found."""
    given = {"env": "CartPole-v1", "algo": "ppo", "hyperparameters": {"n_steps": 32, "batch_size": 32}, "steps": 64}
    trainer = trained(SB3Trainer.complete(TrainSettings.from_mapping(given)), 1)
    path = tmp_path_factory.mktemp("half") / "half.zip"
    trainer.save(path, {}, {})
    return path


@pytest.mark.parametrize(
    ("names", "value", "message"),
    [
        (["counters", "num_timesteps"], "abc", "num_timesteps: expected a count, found 'abc'"),
        (["counters", "num_timesteps"], 1e300, "num_timesteps: expected a count, found 1e+300"),
        (["counters", "num_timesteps"], 10**30, "num_timesteps: expected a count, found 1000000000000"),
        (["counters", "_n_updates"], None, "_n_updates: expected a count, found None"),
        (["counters", "_current_progress_remaining"], 1e9, "_current_progress_remaining: expected a share of the run"),
        (["counters", "last"], [], "list indices must be integers"),
        (["counters", "last", "_last_obs"], "x", "_last_obs: expected arrays of shape {'': (1, 4)}, found {'': ()}"),
        (
            ["counters", "deques", "ep_info_buffer"],
            [{"r": "x", "l": 1}],
            "ep_info_buffer: expected numbers",
        ),
        (["counters", "deques", "ep_info_buffer"], [{}], "'r'"),
        (["counters", "deques"], {}, "'ep_info_buffer'"),
        (["counters"], {}, "'last'"),
        (["random"], 5, "'int' object is not subscriptable"),
        (["random", "python"], [3, [1], None], "state vector must be a tuple"),
        (["random", "numpy", "position"], "x", "an integer is required"),
        (["random", "torch"], None, "'NoneType' object has no attribute 'cpu'"),
        (["noise"], [1, 2], "zip() argument 2 is longer"),
    ],
)
def test_a_state_that_no_run_has_is_refused(half, tmp_path, forge, names, value, message):
    path = tmp_path / "forged.zip"
    path.write_bytes(half.read_bytes())
    tree = json.loads(Checkpoint.open(path).read("bam/resume/state.json"))
    inner = tree
    for name in names[:-1]:
        inner = inner[name]
    inner[names[-1]] = value
    forge(path, {"bam/resume/state.json": json.dumps(tree).encode()})
    with pytest.raises(CheckpointError) as caught:
        SB3Trainer.load(Checkpoint.open(path)).train(128, lambda progress: False)
    text = str(caught.value).removeprefix(f"{path}: bam/resume/state does not fit these settings: ")
    assert text.startswith(message)


class Evil:
    """Pickled, it makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_nothing_of_stable_baselines3_is_unpickled_when_a_run_goes_on(half, tmp_path, forge):
    path, evil = tmp_path / "forged.zip", base64.b64encode(pickle.dumps(Evil(tmp_path / "was-here"))).decode()
    path.write_bytes(half.read_bytes())
    data = json.loads(Checkpoint.open(path).read("data"))
    data["clip_range"] = {":type:": "x", ":serialized:": evil}
    forge(path, {"data": json.dumps(data).encode()})
    resumed = SB3Trainer.load(Checkpoint.open(path))
    resumed.train(128, lambda progress: True)
    resumed.freeze()
    assert not (tmp_path / "was-here").exists()
