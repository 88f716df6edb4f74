"""`bam-train` from its flags to its files, its lines and its status."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from stable_baselines3 import PPO

from bam_train.checkpoint import Checkpoint
from bam_train.cli.flags import TrainConfig
from bam_train.cli.program import guarded
from bam_train.cli.train import train
from bam_train.policy import FrozenPolicy

SHORT = ("num_envs=1", "n_steps=32", "batch_size=32", "n_epochs=2", "policy_kwargs.net_arch=[8]")
BASE = {"env": "CartPole-v1", "algo": "ppo", "steps": 128, "eval_every": 64, "eval_episodes": 2, "set": SHORT}


pytestmark = pytest.mark.usefixtures("here")


def test_a_whole_run(bam_train, here):
    status, out, err = bam_train()
    assert (status, out) == (0, "")
    checkpoint = Checkpoint.open("checkpoints/CartPole-v1-ppo.zip")
    assert checkpoint.manifest.steps in (64, 128)
    assert checkpoint.manifest.scores["episodes"] == 2
    assert checkpoint.manifest.settings["hyperparameters"]["policy_kwargs"] == {"net_arch": [8]}
    assert FrozenPolicy.load(checkpoint.path).act([0, 0, 0, 0]) in (0, 1)
    assert PPO.load(checkpoint.path).num_timesteps == checkpoint.manifest.steps
    folder = here / "runs" / "CartPole-v1-ppo"
    assert sorted(path.name for path in folder.iterdir()) == [
        "config.json",
        "last.zip",
        "learning-curve.png",
        "outcome.json",
        "progress.jsonl",
        "tensorboard",
    ]
    assert Checkpoint.open(folder / "last.zip").manifest.steps == 128
    lines = err.splitlines()
    assert lines[0] == "ppo on CartPole-v1, seed 0"
    assert any(line.startswith("evaluation at 64 steps: return ") for line in lines)
    assert any(line.startswith("ppo on CartPole-v1: all steps done at 128 steps, ") for line in lines)
    size = f"  size        {checkpoint.path.stat().st_size / 1000:,.0f} kB"
    assert lines[-3:] == [size, "next:", "  bam-eval checkpoints/CartPole-v1-ppo.zip"]


def test_settings_are_checked_before_torch_and_ray_are_imported():
    code = """
import sys
from bam_train.cli import train
for words in (
    "ppo --set gamma=2", "ppo --set gama=1", "ppo --trainer rllib --set lr=-1",
    "sac --trainer rllib --set actor_lr=fast", "dagger --teacher scripted --set width=0", "ppo --print-config",
):
    try: train.main(["--env", "bam/reach", "--algo", *words.split()])
    except SystemExit as end: print(end.code, *{'torch', 'ray', 'stable_baselines3'} & {*sys.modules}, file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines() == [
        "bam-train: gamma: expected a number from 0 to 1, found 2",
        "1",
        "bam-train: Unknown ppo hyperparameter 'gama'. Did you mean 'gamma'?",
        "1",
        "bam-train: lr: expected a number above 0, found -1",
        "1",
        "bam-train: actor_lr: expected a number or a schedule [[step, value], ...], found 'fast'",
        "1",
        "bam-train: hyperparameters: width: expected a whole number from 1 to 10000000, found 0",
        "1",
        "0",
    ]


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        ({}, "bam-train: --record: CartPole-v1 is not of bam_envs; use bam-data collect, or RecordDataset\n"),
        (
            {"trainer": "rllib", "set": ()},
            "ppo on CartPole-v1: the rllib trainer is loaded, which takes a few seconds\n"
            "bam-train: --record is for --trainer sb3, found rllib; use bam-data collect\n",
        ),
    ],
)
def test_a_run_that_cannot_be_recorded(bam_train, here, flags, text):
    assert bam_train(record="data", **flags) == (1, "", text)
    assert list(here.iterdir()) == []


def test_a_run_that_has_learnt_nothing_is_no_success(bam_train):
    status, _, err = bam_train(algo="trpo", set=("n_steps=32", "batch_size=32"), stop_reward=475.0)
    assert status == 3
    lines = err.splitlines()
    told = "no preset: the library's defaults, but for n_steps, batch_size"
    assert lines[:2] == ["trpo on CartPole-v1, seed 0", told]
    last = r"bam-train: nothing was learnt in 128 steps: return \d+(\.\d+)?, and the goal is 475\. Try --seed 1, "
    assert re.match(last, lines[-1])
    assert "  bam-eval checkpoints/CartPole-v1-trpo.zip" in lines


def test_print_config_is_read_back(bam_train, here):
    status, printed, err = bam_train(print_config=True)
    assert (status, err) == (0, "")
    assert json.loads(printed)["hyperparameters"]["n_steps"] == 32
    (here / "a.json").write_text(printed)
    again = guarded(lambda: train(TrainConfig(config=Path("a.json"), print_config=True)), "bam-train")
    assert again == 0
    assert not (here / "runs").exists()


def test_flags_win_over_set_over_files(bam_train, here):
    (here / "a.toml").write_text(
        "steps = 5\nseed = 6\nnum_envs = 2\n[hyperparameters]\ngamma = 0.5\ngae_lambda = 0.5\n"
    )
    printed = bam_train(config=Path("a.toml"), set=("gamma=0.25", "seed=7"), steps=8, print_config=True)[1]
    values = json.loads(printed)
    assert (values["steps"], values["seed"], values["num_envs"]) == (8, 7, 2)
    assert (values["hyperparameters"]["gamma"], values["hyperparameters"]["gae_lambda"]) == (0.25, 0.5)


def test_an_existing_checkpoint_is_not_overwritten(bam_train):
    bam_train()
    stem = "checkpoints/CartPole-v1-ppo"
    before = Path(f"{stem}.zip").read_bytes()
    _, _, err = bam_train(seed=1)
    assert Path(f"{stem}.zip").read_bytes() == before
    assert Path(f"{stem}-2.zip").exists()
    assert f"{stem}.zip exists: the checkpoint goes to {stem}-2.zip (--force overwrites)" in err.splitlines()
    bam_train(seed=1, force=True)
    assert Path(f"{stem}.zip").read_bytes() != before


def test_resume_counts_from_the_first_step_and_needs_nothing_else(bam_train):
    bam_train(steps=100, eval_every=1000)
    checkpoint = Path("checkpoints/CartPole-v1-ppo.zip")
    nothing = dict.fromkeys(("env", "algo", "eval_every", "eval_episodes"))
    status, _, err = bam_train(**nothing, resume=checkpoint, steps=192, set=())
    assert status == 0
    assert err.splitlines()[0] == f"ppo on CartPole-v1, seed 0, going on from {checkpoint} at 128 steps"
    assert "no preset" not in err
    assert "CartPole-v1 cannot save running episodes: new ones begin" in err
    assert Checkpoint.open("runs/CartPole-v1-ppo-2/last.zip").manifest.steps == 192


ERRORS = [  # one of each kind; the rest is in the tests of settings, hyperparameters and run folders
    ({"env": "CartPol-v1"}, "Unknown environment 'CartPol-v1'. Did you mean 'CartPole-v1'?"),
    (
        {"env": "bam/pick", "set": ("env_kwargs.randomise=true",)},
        "unknown argument 'randomise' of bam/pick-v0. Did you mean 'randomize'?",
    ),
    ({"set": ("n_steps",)}, "--set n_steps: expected name=value, such as --set learning_rate=3e-4, found 'n_steps'"),
    (
        {"out": Path("/proc/version/a.zip")},
        "/proc/version/a.zip: cannot be written: /proc/version is a file, expected a folder. "
        "Choose another place with --out",
    ),
    (
        {"runs": Path("/proc/version")},
        "/proc/version: cannot be written: /proc/version is a file, expected a folder. "
        "Choose another place with --runs",
    ),
    (
        {"resume": Path("no.zip")},
        "--resume no.zip: no such file. Check the name; a run keeps runs/NAME/last.zip",
    ),
]


@pytest.mark.parametrize(("flags", "line"), ERRORS)
def test_bad_input_is_one_line_and_leaves_nothing(bam_train, here, flags, line):
    assert bam_train(**flags) == (1, "", f"bam-train: {line}\n")
    assert list(here.iterdir()) == []


def test_a_wrong_value_in_a_file_names_the_file(bam_train, here):
    (here / "a.toml").write_text("steps = 'many'\n")
    line = "bam-train: a.toml: steps: expected a whole number from 1 to 1000000000000000, found 'many'\n"
    assert bam_train(config=Path("a.toml"), steps=None) == (1, "", line)


def test_a_nan_keeps_the_last_good_checkpoint(bam_train):
    status, _, err = bam_train(set=(*SHORT, "learning_rate=1e30"))
    assert status == 1
    end = "expected finite numbers: try a smaller learning_rate; no checkpoint had been saved yet"
    assert err.splitlines()[-1].startswith("bam-train: t")
    assert err.splitlines()[-1].endswith(end)
    assert not Path("checkpoints/CartPole-v1-ppo.zip").exists()


# In a process of its own


IMPORTED = (
    *("torch.utils.tensorboard", "matplotlib.pyplot", "onnxruntime", "stable_baselines3"),
    *("bam_train.trainers.sb3.sb3_trainer", "bam_train.trainers.training_run"),
)
QUICK = ("--set", "n_steps=64", "--set", "n_epochs=1", "--set", "policy_kwargs.net_arch=[8]")


@pytest.fixture
def start(here, start_forked):
    """Starts the program."""

    def start(*arguments):
        return start_forked(
            IMPORTED, here, "--env", "CartPole-v1", "--algo", "ppo", "--num-envs", "1", *QUICK, *arguments
        )

    return start


LONG = ("--steps", "10000000", "--eval-every", "256", "--eval-episodes", "1")


def last_checkpoint(here):
    return Checkpoint.open(here / "runs" / "CartPole-v1-ppo" / "last.zip").manifest


@pytest.mark.parametrize(
    ("number", "status", "again", "times"),
    [(signal.SIGINT, 130, "Ctrl-C again", 1), (signal.SIGTERM, 143, "another signal", 4)],
)
def test_a_signal_saves_and_ends_cleanly(start, here, number, status, again, times):
    """`timeout` sends SIGTERM to the program, and then to its group: what comes again at once is one signal."""
    program = start(*LONG)
    program.wait_for("evaluation at 512 steps")
    for pause in (0.0, 0.0, 0.001, 0.02)[:times]:
        time.sleep(pause)
        program.send(number)
    found, err = program.end()
    assert found == status, err
    assert err.count(f"finishing the update and saving; {again} quits at once") == 1
    assert "Traceback" not in err
    assert last_checkpoint(here).steps >= 512
    assert err.splitlines()[-1] == "  bam-train --resume runs/CartPole-v1-ppo/last.zip"


def test_two_signals_quit_at_once(start):
    program = start(*LONG, "--set", "n_epochs=100000")
    program.wait_for("ppo on CartPole-v1, seed 0")
    time.sleep(1.0)  # into the first update, which takes minutes
    program.send(signal.SIGINT)
    program.wait_for("finishing the update")
    program.send(signal.SIGINT)
    assert program.end() == (130, "bam-train: quit at once; no checkpoint had been saved yet\n")


def test_two_signals_while_saving_quit_at_once_too(start, here):
    program = start(*LONG)
    program.wait_for("evaluation at 512 steps")
    program.send(signal.SIGINT)
    time.sleep(0.1)
    program.send(signal.SIGINT)
    before = time.monotonic()
    status, err = program.end()
    assert time.monotonic() - before < 2.0
    assert status == 130
    last = "runs/CartPole-v1-ppo/last.zip"
    assert err.splitlines()[-1] == f"bam-train: quit at once; the last checkpoint on the disk is {last}"
    assert last_checkpoint(here).steps >= 256
    assert not list((here / "runs" / "CartPole-v1-ppo").glob(".*"))


def test_stopped_before_the_first_evaluation(start, here):
    program = start("--steps", "10000000")
    program.wait_for("steps/s")
    program.send(signal.SIGINT)
    lines = [" ".join(line.split()) for line in program.end()[1].splitlines()]
    assert "best none yet: stopped before the first evaluation; the checkpoint is the newest state" in lines
    assert lines[-1] == "bam-train --resume runs/CartPole-v1-ppo/last.zip"
    newest = Checkpoint.open(here / "checkpoints" / "CartPole-v1-ppo.zip").manifest
    assert (newest.steps, newest.scores) == (last_checkpoint(here).steps, {})


def test_a_run_folder_that_fills_up(start):
    """A limit on the size of files stands in for a full disk."""
    import resource

    program = start("--steps", "2048", "--eval-every", "512", "--eval-episodes", "1")
    program.wait_for("evaluation at 512 steps")
    _, hard = resource.prlimit(program.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(program.process.pid, resource.RLIMIT_FSIZE, (1, hard))
    status, err = program.end()
    assert status == 1
    assert "Traceback" not in err
    assert any("all steps done at 2048 steps" in line for line in err.splitlines())
    assert err.splitlines()[-1].startswith("bam-train: ")
    assert "cannot be written: File too large" in err.splitlines()[-1]


def test_nobody_need_read(start, here):
    program = start("--steps", "1024", "--eval-every", "256", "--eval-episodes", "1")
    program.wait_for("ppo on CartPole-v1, seed 0")
    program.stderr.close()
    program.process.join(60)
    assert program.process.exitcode == 0
    assert last_checkpoint(here).steps == 1024
    assert (here / "checkpoints" / "CartPole-v1-ppo.zip").exists()


def test_kill_leaves_a_whole_checkpoint_that_can_be_gone_on_from(start, here):
    program = start(*LONG)
    program.wait_for("evaluation at 512 steps")
    program.send(signal.SIGKILL)
    program.end()
    steps = last_checkpoint(here).steps + 64
    resumed = start("--resume", "runs/CartPole-v1-ppo/last.zip", "--steps", str(steps), "--eval-episodes", "1")
    status, err = resumed.end()
    assert status == 0, err
    assert Checkpoint.open(here / "runs" / "CartPole-v1-ppo-2" / "last.zip").manifest.steps == steps
    assert Checkpoint.open(here / "checkpoints" / "CartPole-v1-ppo.zip").manifest.steps <= steps


def test_a_missing_extra_says_what_to_install(here):
    hidden = (
        "import sys\n"
        "class Hidden:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'torch': raise ModuleNotFoundError(\"No module named 'torch'\", name='torch')\n"
        "sys.meta_path.insert(0, Hidden())\n"
        "from bam_train.cli.train import main\n"
        "main()\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    done = subprocess.run(
        [sys.executable, "-c", hidden, "--env", "CartPole-v1", "--algo", "ppo"],
        capture_output=True,
        text=True,
        cwd=here,
        env=environment,
        check=False,
    )
    expected = 'bam-train: The sb3 trainer needs torch, which is not installed. Run: pip install "bam-train[train]"\n'
    assert (done.returncode, done.stderr) == (1, expected)
