"""Going on exactly: half a run, saved and loaded, then the other half, is the whole run, bit for bit."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from bam_train.checkpoint import Checkpoint
from bam_train.errors import AlteredCheckpoint
from bam_train.settings import TrainSettings
from bam_train.trainers.sb3 import sb3_resume as resume
from bam_train.trainers.sb3.sb3_trainer import SB3Trainer

SMALL = {"net_arch": [16, 16]}
OFF = {"batch_size": 16, "learning_starts": 60, "gradient_steps": 2, "train_freq": 4, "policy_kwargs": SMALL}

RUNS = {
    "ppo": ("ppo", {"n_steps": 32, "batch_size": 96, "n_epochs": 2, "policy_kwargs": SMALL}, {}),
    "ppo-sde-normalised": (
        "ppo",
        {"n_steps": 32, "batch_size": 96, "use_sde": True, "sde_sample_freq": 4},
        {"normalize": True},
    ),
    "ppo-discrete": ("ppo", {"n_steps": 32, "batch_size": 96, "n_epochs": 2}, {"env_kwargs": {"discrete": True}}),
    "ppo-schedule": (
        "ppo",
        {"n_steps": 32, "batch_size": 96, "learning_rate": "lin_1e-3", "clip_range": "lin_0.2"},
        {},
    ),
    "a2c": ("a2c", {}, {}),
    "trpo": ("trpo", {"n_steps": 32, "batch_size": 96}, {}),
    "recurrent-ppo": (
        "recurrent-ppo",
        {"n_steps": 32, "batch_size": 96, "n_epochs": 2, "policy_kwargs": {"lstm_hidden_size": 8}},
        {},
    ),
    "sac": ("sac", OFF, {}),
    "sac-full-buffer": ("sac", {**OFF, "buffer_size": 90, "use_sde": True}, {"normalize": True}),
    "sac-fixed-entropy": ("sac", {**OFF, "ent_coef": 0.1, "n_steps": 3}, {}),
    "td3": ("td3", {**OFF, "action_noise": "normal_0.1"}, {}),
    "ddpg": ("ddpg", {**OFF, "action_noise": "ornstein-uhlenbeck_0.2"}, {}),
    "tqc": ("tqc", OFF, {}),
    "crossq": ("crossq", OFF, {}),
    "dqn": ("dqn", {**OFF, "target_update_interval": 40}, {"env_kwargs": {"discrete": True}}),
    "qrdqn": ("qrdqn", {**OFF, "target_update_interval": 40}, {"env_kwargs": {"discrete": True}}),
}


def everything(trainer: SB3Trainer) -> dict[str, bytes]:
    """All that training goes on from, but for wall times."""
    for episode in trainer.model.ep_info_buffer:
        episode["t"] = 0
    return resume.members(trainer.model, trainer.venv, trainer.model.get_vec_normalize_env(), None, {})


def settings(env, name, steps=384):
    algo, hyperparameters, extra = RUNS[name]
    given = {"env": env, "algo": algo, "steps": steps, "num_envs": 3, "hyperparameters": hyperparameters, **extra}
    return SB3Trainer.complete(TrainSettings.from_mapping(given))


@pytest.mark.parametrize("name", RUNS)
def test_half_and_half_is_the_whole(walk, tmp_path, name):
    whole = SB3Trainer.create(settings(walk, name))
    whole.train(384, lambda progress: True)

    half = SB3Trainer.create(settings(walk, name))
    half.train(384, lambda progress: progress.steps < 192)
    assert 192 <= half.steps < 384
    half.save(tmp_path / "half.zip", {}, {})

    torch.manual_seed(123)  # whatever another process drew
    np.random.seed(321)
    rest = SB3Trainer.load(Checkpoint.open(tmp_path / "half.zip"))
    assert rest.notices == []
    rest.train(384, lambda progress: True)
    assert rest.steps == whole.steps
    assert everything(rest) == everything(whole)


@pytest.mark.parametrize(
    ("name", "fall"),
    [("ppo-schedule", "clip_range and learning_rate change"), ("dqn", "exploration_fraction changes"), ("sac", None)],
)
def test_another_total_is_another_schedule_and_said(walk, tmp_path, name, fall):
    half = SB3Trainer.create(settings(walk, name, steps=192))
    half.train(192, lambda progress: False)
    half.save(tmp_path / "half.zip", {}, {})
    rest = SB3Trainer.load(Checkpoint.open(tmp_path / "half.zip"), settings(walk, name))
    expected = f"{fall} over all of --steps, which were 192 and are 384: the result differs from an unbroken run's"
    assert rest.notices == ([expected] if fall else [])


def test_saving_freezing_and_looking_disturb_nothing(walk, tmp_path):
    quiet = SB3Trainer.create(settings(walk, "sac"))
    quiet.train(240, lambda progress: True)
    expected = everything(quiet)
    watched = SB3Trainer.create(settings(walk, "sac"))

    def look(progress):
        progress.statistics()
        watched.freeze().act_batch(np.zeros((2, 2), np.float32))
        with watched.undisturbed():
            torch.rand(3)
            np.random.rand(3)
        if progress.steps > 150:
            watched.save(tmp_path / "a.zip", {}, {})
        return True

    watched.train(240, look)
    assert everything(watched) == expected


def test_a_loaded_run_can_be_saved_before_it_goes_on(walk, tmp_path):
    first = SB3Trainer.create(settings(walk, "ddpg"))
    first.train(384, lambda progress: progress.steps < 192)
    first.save(tmp_path / "a.zip", {}, {})
    SB3Trainer.load(Checkpoint.open(tmp_path / "a.zip")).save(tmp_path / "b.zip", {}, {})
    one, two = Checkpoint.open(tmp_path / "a.zip"), Checkpoint.open(tmp_path / "b.zip")
    members = [name for name in one.manifest.sha256 if name.startswith("bam/")]
    assert len(members) == 9
    for name in members:
        assert one.read(name) == two.read(name), name


PROGRAM = """
import hashlib, sys
from pathlib import Path
from bam_train.checkpoint import Checkpoint
from bam_train.settings import TrainSettings
from bam_train.trainers.sb3 import sb3_resume as resume
from bam_train.trainers.sb3.sb3_trainer import SB3Trainer
import json
given, first, total, path = json.loads(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
if path.exists():
    trainer = SB3Trainer.load(Checkpoint.open(path))
else:
    trainer = SB3Trainer.create(SB3Trainer.complete(TrainSettings.from_mapping(given)))
trainer.train(total, lambda progress: progress.steps < first)
if trainer.steps < total:
    trainer.save(path, {}, {})
for episode in trainer.model.ep_info_buffer:
    episode["t"] = 0
state = resume.members(trainer.model, trainer.venv, None, None, {})
print(trainer.steps, hashlib.sha256(b"".join(state.values())).hexdigest())
"""


@contextlib.contextmanager
def a_new_process(given, first, total, path):
    """Within, the program runs; what it gives is called for what it printed."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    command = [sys.executable, "-c", PROGRAM, json.dumps(given), str(first), str(total), str(path)]

    def printed():
        out, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
        return out.split()

    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            yield printed
        finally:
            process.kill()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "hyperparameters"),
    [
        ("ppo", {"n_steps": 125, "batch_size": 100, "n_epochs": 3}),
        ("sac", {"learning_starts": 400, "train_freq": 25, "gradient_steps": 10, "batch_size": 64}),
    ],
)
def test_2k_steps_saved_and_2k_more_in_a_new_process_are_4k(tmp_path, algo, hyperparameters):
    given = {"env": "bam/pick-v0", "algo": algo, "steps": 4000, "num_envs": 8, "hyperparameters": hyperparameters}
    with a_new_process(given, 4000, 4000, tmp_path / "whole.zip") as whole:
        with a_new_process(given, 2000, 4000, tmp_path / "half.zip") as half:
            assert half()[0] == "2000"
        with a_new_process(given, 4000, 4000, tmp_path / "half.zip") as rest:
            assert rest() == (expected := whole())
    assert expected[0] == "4000"


def test_a_foreign_environment_begins_new_episodes_and_says_so(corridor, tmp_path):
    given = {"env": corridor, "algo": "ppo", "steps": 128, "hyperparameters": {"n_steps": 32, "batch_size": 32}}
    trainer = SB3Trainer.create(SB3Trainer.complete(TrainSettings.from_mapping(given)))
    trainer.train(128, lambda progress: progress.steps < 64)
    trainer.save(tmp_path / "a.zip", {}, {})
    resumed = [SB3Trainer.load(Checkpoint.open(tmp_path / "a.zip")) for _ in range(2)]
    expected = "test/Corridor-v0 cannot save running episodes: new ones begin, so the rest differs from an unbroken run"
    assert resumed[0].notices == [expected]
    for one in resumed:
        one.train(128, lambda progress: True)
        assert one.steps == 128
    one, two = (everything(trainer)["bam/resume/model.safetensors"] for trainer in resumed)
    assert one == two


def test_a_resume_state_of_another_network_is_refused(walk, tmp_path):
    small = SB3Trainer.create(settings(walk, "ppo"))
    small.train(384, lambda progress: False)
    small.save(tmp_path / "a.zip", {}, {})
    checkpoint = Checkpoint.open(tmp_path / "a.zip")
    other = TrainSettings.from_mapping(
        {**checkpoint.manifest.settings, "hyperparameters": {"policy_kwargs": {"net_arch": [4]}}}
    )
    with pytest.raises(AlteredCheckpoint, match=r"bam/resume/model does not fit these settings: "):
        SB3Trainer.load(checkpoint, SB3Trainer.complete(other))


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """A checkpoint that any run may go on from, once what a stranger changed is found."""
    given = {"env": "CartPole-v1", "algo": "ppo", "hyperparameters": {"n_steps": 32, "batch_size": 32}}
    trainer = SB3Trainer.create(SB3Trainer.complete(TrainSettings.from_mapping({**given, "steps": 64})))
    trainer.train(64, lambda progress: False)
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
        (["random", "python"], [3, [1], None], "state vector is the wrong size"),
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
    with pytest.raises(AlteredCheckpoint) as caught:
        SB3Trainer.load(Checkpoint.open(path)).train(128, lambda progress: False)
    text = str(caught.value).removeprefix(f"{path}: bam/resume/state does not fit these settings: ")
    assert text.startswith(message)


class Evil:
    """Pickled, it makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_nothing_of_stable_baselines3_is_unpickled_when_a_run_goes_on(walk, tmp_path):
    import base64
    import hashlib
    import pickle

    trainer = SB3Trainer.create(settings(walk, "ppo"))
    trainer.train(384, lambda progress: False)
    trainer.save(tmp_path / "a.zip", {}, {})
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    evil = base64.b64encode(pickle.dumps(Evil(tmp_path / "was-here"))).decode()
    data["clip_range"] = {":type:": "x", ":serialized:": evil}
    members["data"] = json.dumps(data).encode()
    manifest = json.loads(members["bam/manifest.json"])
    manifest["sha256"]["data"] = hashlib.sha256(members["data"]).hexdigest()
    members["bam/manifest.json"] = json.dumps(manifest).encode()
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    resumed = SB3Trainer.load(Checkpoint.open(tmp_path / "b.zip"))
    resumed.train(384, lambda progress: True)
    resumed.freeze()
    assert not (tmp_path / "was-here").exists()
