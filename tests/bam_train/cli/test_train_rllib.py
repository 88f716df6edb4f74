"""`bam-train --trainer rllib`: what cannot be, in one line each; Ctrl-C; copies."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time

import pytest

pytest.importorskip("ray.rllib")

import psutil

from bam_train.checkpoint import Checkpoint
from bam_train.cli.flags import TrainConfig
from bam_train.cli.program import guarded
from bam_train.cli.train import train

SMALL = ("train_batch_size_per_learner=256", "minibatch_size=64", "num_epochs=1", "model_config.fcnet_hiddens=[8]")
BASE = {"env": "bam/reach", "algo": "ppo", "trainer": "rllib", "steps": 256, "eval_episodes": 2, "set": SMALL}
LOADED = "ppo on bam/reach-v0: the rllib trainer is loaded, which takes a few seconds\n"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("RLLIB_NUM_GPUS", "RAY_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.fixture
def bam_train(capsys):
    """Runs the program in this process; its status, and standard error."""

    def run(**flags):
        status = guarded(lambda: train(TrainConfig(**{**BASE, **flags})), "bam-train")
        out, err = capsys.readouterr()
        assert out == ""
        return status, err

    return run


def environment():
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}


@pytest.mark.parametrize(
    ("missing", "algo", "text"),
    [
        ("ray", "ppo", 'The rllib trainer needs ray, which is not installed. Run: pip install "bam-train[rllib]"'),
        ("torch", "ppo", 'The rllib trainer needs torch, which is not installed. Run: pip install "bam-train[rllib]"'),
        ("ray", "ppp", "Unknown algorithm 'ppp'. Did you mean 'ppo'?"),  # before ray is imported, which takes seconds
    ],
)
def test_one_command_installs_all_that_rllib_needs(missing, algo, text):
    code = (
        "import sys\n"
        "class Hidden:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {missing!r}: raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Hidden())\n"
        f"sys.argv[1:] = ['--env', 'bam/reach', '--algo', {algo!r}, '--trainer', 'rllib']\n"
        "from bam_train.cli.train import main\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=environment(), check=False
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.removeprefix(LOADED) == f"bam-train: {text}\n"


def silent():
    """An address where nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (
            {"num_env_runners": 1000},
            r"1000 env runners ask for 1000 CPUs, \d+ on this computer\. "
            r"Lower --num-env-runners or --num-learners, or join a cluster with --address",
        ),
        ({"num_gpus": 99}, r"num_gpus: 99 GPUs asked for, \d+ on this computer\. Give --num-gpus \d+"),
        ({"address": silent}, r"127\.0\.0\.1:\d+: no Ray cluster answers there \(Connection refused\)\. .*"),
        ({"trainer": "sb3", "num_env_runners": 2, "set": ()}, "num_env_runners: the sb3 trainer has no use for it.*"),
        (
            {"copy_to": "nowhere://x"},
            "nowhere://x: nowhere:// is unknown. Give a path, or an address that fsspec .*",
        ),
    ],
)
def test_what_cannot_be_is_one_line(no_ray, bam_train, flags, text):
    status, err = bam_train(**{name: value() if callable(value) else value for name, value in flags.items()})
    assert status == 1
    assert re.fullmatch(f"bam-train: {text}\n", err.removeprefix(LOADED))


@pytest.mark.slow
def test_checkpoints_are_copied(one_ray, bam_train, here):
    status, err = bam_train(copy_to=f"file://{here}/bucket/", out=here / "reach.zip")
    assert status == 0, err
    assert (here / "bucket" / "reach.zip").read_bytes() == (here / "reach.zip").read_bytes()
    (here / "file").write_text("in the way")
    status, err = bam_train(copy_to=f"file://{here}/file/x", out=here / "again.zip")
    assert status == 1
    last = err.splitlines()[-1]
    assert last.startswith(f"bam-train: {here}/file/x/again.zip: cannot be written: Not a directory. ")
    assert "all steps done at 256 steps" in err
    assert Checkpoint.open(here / "again.zip").manifest.steps == 256


@pytest.fixture
def start(here, start_forked):
    """Starts the program."""

    def start(*arguments, runners=0):
        command = ["--env", "bam/reach", "--algo", "ppo", "--trainer", "rllib", "--num-env-runners", str(runners)]
        command += ["--steps", "100000000", *(word for setting in SMALL for word in ("--set", setting))]
        return start_forked(["bam_train.trainers.rllib.rllib_trainer"], here, *command, *arguments)

    return start


def as_timeout_does(group, number):
    """To the program, and then to its whole group; `systemctl stop` and batch systems do alike."""
    os.kill(group, number)
    os.killpg(group, number)


def folders_of(processes):
    """Folders of the Ray that these processes are of."""
    return {found for one in processes for found in re.findall(r"/\S*bam-ray-\w+", " ".join(one.cmdline()))}


@pytest.mark.slow
def test_a_signal_saves_and_leaves_no_process(here, start):
    """Ctrl-C does the same: `test_two_signals_quit_at_once_and_leave_no_process` has its beginning."""
    process = start("--eval-every", "100000000", runners=1)
    process.wait_for("steps/s")
    processes = psutil.Process(process.pid).children(recursive=True)
    assert len(processes) >= 5
    (rays,) = folders_of(processes)
    as_timeout_does(process.pid, signal.SIGTERM)
    status, err = process.end()
    assert status == 143, err
    assert "finishing the update and saving" in err
    assert "Traceback" not in err
    assert err.splitlines()[-1] == "  bam-train --resume runs/reach-rllib-ppo/last.zip"
    assert Checkpoint.open(here / "runs" / "reach-rllib-ppo" / "last.zip").manifest.steps >= 256
    assert not any(one.is_running() for one in processes)
    assert not os.path.exists(rays)


@pytest.mark.slow
def test_ctrl_c_while_it_is_set_up_leaves_no_process(start):
    process = start(runners=1)
    processes, end = set(), time.monotonic() + 120
    while not any("raylet" in one.name() for one in processes) and time.monotonic() < end:
        processes = set(psutil.Process(process.pid).children(recursive=True))
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    status, err = process.end()
    assert status == 130, err
    assert err.splitlines()[-1] == "bam-train: interrupted"
    _, alive = psutil.wait_procs(processes, timeout=10)
    assert not alive


@pytest.mark.slow
def test_two_signals_quit_at_once_and_leave_no_process(start):
    process = start("--set", "num_epochs=100000")
    process.wait_for("ppo on bam/reach-v0, seed 0")
    time.sleep(1.0)  # into the first update, which takes minutes
    processes = psutil.Process(process.pid).children(recursive=True)
    folders = folders_of(processes)
    os.killpg(process.pid, signal.SIGINT)
    process.wait_for("finishing the update")
    os.killpg(process.pid, signal.SIGINT)
    assert process.end() == (130, "bam-train: quit at once; no checkpoint had been saved yet\n")
    _, alive = psutil.wait_procs(processes, timeout=10)  # less than Ray's agents take to see that nobody is left
    assert not alive
    assert len(folders) == 1
    assert not any(map(os.path.exists, folders))
