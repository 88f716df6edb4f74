"""The scripts that train with RLlib and with stable-baselines3, and then use what they trained."""

import os
import re
import signal
import threading
import time
from pathlib import Path

import pytest

from bam_train.checkpoint import Checkpoint
from bam_train.policy import FrozenPolicy

SCRIPTS = Path(__file__).parents[2] / "scripts"
RLLIB = ("training_inference_mir", "training_inference_ur")
TRAINING = (*RLLIB, "td3_mir")
ALL = (*TRAINING, "policy_from_cp_mir", "policy_from_cp_ur")
OPTIONS = {
    *("--run", "--num-cpus", "--framework", "--stop-iters", "--stop-timesteps", "--stop-reward", "--robot", "--yes"),
    *("--explore-during-inference", "--num-episodes-during-inference", "--seed", "--env", "--parity", "--out"),
    "--render",
}


@pytest.mark.parametrize("name", [*ALL, "training_inference", "policy_from_cp"])
def test_each_is_short_enough_to_copy(name):
    assert len((SCRIPTS / f"{name}.py").read_text().splitlines()) < 150


@pytest.mark.parametrize("name", ALL)
def test_help(run_here, name, tmp_path):
    done = run_here(name, "-h", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count(f"\n  python scripts/{name}.py") >= 3
    assert "\nExamples:\n" in done.stdout
    if name in RLLIB:
        assert set(re.findall(r"^[ |│]+(--[a-z][a-z-]+)", done.stdout, re.MULTILINE)) == OPTIONS


WRONG = [
    (["--framework", "tf2"], 1, "--framework tf2: RLlib has nothing but torch any more; leave it out"),
    (["--stop-itrs", "3"], 2, "unknown option --stop-itrs, did you mean --stop-iters? Run python "),
    (["--seed", "-1"], 2, "--seed: expected a whole number of at least 0, found -1. Run python "),
    (["--stop-iters", "0"], 2, "--stop-iters: expected a whole number of at least 1, found 0. Run "),
    (["--stop-reward", "high"], 2, "--stop-reward: expected a number, found 'high'. Run python "),
    (["--run", "PPOO"], 1, "Unknown algorithm 'ppoo'. Did you mean 'ppo'?"),
    (["--env", "bam/pik"], 1, "Unknown environment 'bam/pik'. Did you mean 'bam/pick-v0'?"),
    (["--env", "bam/pick", "--parity"], 1, "unknown argument 'parity' of bam/pick-v0. "),
    (
        ["--run", "BC"],
        1,
        "data: bc learns from a data set, found none. Give its place with --data; bam-data collect records one",
    ),
    (["--run", "DQN"], 1, "dqn does not fit bam/mir100-navigation-v0: it takes Discrete actions, found Box. "),
    (["--num-cpus", "1000"], 1, "--num-cpus: expected at most "),
    (["--robot", "nonsense"], 1, "A live robot's address is ws://host:port or wss://host:port, not 'nonsense'. "),
    (
        ["--robot", "ws://10.0.0.5:9090", "--explore-during-inference"],
        1,
        "--explore-during-inference draws actions at random, which is not for a live robot; leave it out",
    ),
]


@pytest.mark.parametrize(("arguments", "status", "text"), WRONG, ids=[" ".join(one[0]) for one in WRONG])
def test_what_cannot_be_is_one_line(run_here, arguments, status, text, tmp_path):
    done = run_here("training_inference_mir", *arguments, folder=tmp_path)
    assert done.returncode == status, done.stderr
    assert done.stderr.startswith(f"training_inference_mir: {text}")
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "arguments", "text"),
    [
        (
            "td3_mir",
            ("--robot", "10.0.0.5:9090"),
            "A live robot's address is ws://host:port or wss://host:port, not '10.0.0.5:9090'. "
            "Did you mean 'ws://10.0.0.5:9090'?",
        ),
        (
            "training_inference_ur",
            (),
            "RLLIB_NUM_GPUS: expected a whole number of GPUs, such as 1, found 'abc'. Mend or unset it",
        ),
    ],
)
def test_what_is_refused_before_training(run_here, name, arguments, text, tmp_path, monkeypatch):
    monkeypatch.setenv("RLLIB_NUM_GPUS", "abc")
    done = run_here(name, *arguments, folder=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"{name}: {text}\n")
    assert list(tmp_path.iterdir()) == []


def test_without_ray(run_script, environment, tmp_path):
    (tmp_path / "ray.py").write_text('raise ModuleNotFoundError("No module named \'ray\'", name="ray")\n')
    path = os.pathsep.join([str(tmp_path), environment["PYTHONPATH"]])
    done = run_script("training_inference_mir", folder=tmp_path, PYTHONPATH=path)
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert 'pip install "bam-train[rllib]"' in done.stderr


def test_it_trains_saves_and_explores_in_a_new_environment(trained):
    folder, done = trained
    lines = done.stdout.splitlines()
    assert lines[0] == "saving to checkpoints/mir100-navigation-rllib-ppo.zip after every iteration"
    assert lines[1].startswith("iteration 1: 4,096 steps, mean total reward ")
    assert [re.sub(r"reward -?\d+\.\d\d(, success)?$", "reward R", line) for line in lines[2:]] == [
        "episode 1: total reward R",
        "episode 2: total reward R",
    ]
    path = folder / "checkpoints" / "mir100-navigation-rllib-ppo.zip"
    assert FrozenPolicy.load(path).act([0.0] * 4).shape == (2,)
    assert Checkpoint.open(path).manifest.steps == 4096


def test_sigterm_saves(run_here, tmp_path):
    saved = tmp_path / "checkpoints" / "ur-reach-rllib-ppo.zip"

    def send():
        end = time.monotonic() + 120
        while not saved.exists() and time.monotonic() < end:
            time.sleep(0.05)
        if callable(signal.getsignal(signal.SIGTERM)):  # else it would end this process
            os.kill(os.getpid(), signal.SIGTERM)

    sender = threading.Thread(target=send)
    sender.start()
    done = run_here("training_inference_ur", "--parity", folder=tmp_path)
    sender.join()
    lines = done.stdout.splitlines()
    assert done.returncode == 143, done.stderr
    assert lines[0] == "saving to checkpoints/ur-reach-rllib-ppo.zip after every iteration"
    assert lines[1].startswith("iteration 1: 4,096 steps")
    assert lines[-1].startswith("iteration ")
    assert done.stderr == "training_inference_ur: ended by SIGTERM\n"
    assert Checkpoint.open(saved).manifest.env_kwargs == {"ur_model": "ur5", "parity": True}


def test_td3_trains_saves_and_runs_and_overwrites_nothing(run_here, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    taken = tmp_path / "checkpoints" / "mir100-navigation-td3.zip"
    taken.write_text("somebody's")
    done = run_here("td3_mir", "--steps", 64, "--episodes", 1, "--seed", 3, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert lines[0] == "saving to checkpoints/mir100-navigation-td3-2.zip twenty times"
    assert lines[-2].startswith("       64 steps, mean total reward ")
    assert re.fullmatch(r"episode 1: total reward -?\d+\.\d\d(, success)?", lines[-1])
    assert taken.read_text() == "somebody's"
