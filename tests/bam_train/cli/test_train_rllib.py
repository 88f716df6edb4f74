"""`bam-train --trainer rllib`: what cannot be, in one line each; Ctrl-C; copies."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
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


@pytest.mark.parametrize("missing", ["ray", "torch"])
def test_one_command_installs_all_that_rllib_needs(missing):
    code = (
        "import sys\n"
        "class Hidden:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {missing!r}: raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Hidden())\n"
        "sys.argv[1:] = ['--env', 'bam/reach', '--algo', 'ppo', '--trainer', 'rllib']\n"
        "from bam_train.cli.train import main\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=environment(), check=False
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == (
        f'bam-train: The rllib trainer needs {missing}, which is not installed. Run: pip install "bam-train[rllib]"\n'
    )


def test_an_algorithm_that_rllib_does_not_have():
    code = (
        "import sys; sys.modules['ray'] = None; sys.argv[1:] = ['--env', 'bam/reach', '--algo', 'ppp', '--trainer', "
        "'rllib']; from bam_train.cli.train import main; main()"
    )  # before ray is imported, which takes seconds
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=environment(), check=False
    )
    expected = "bam-train: Unknown algorithm 'ppp'. Did you mean 'ppo'?\n"
    assert (done.returncode, done.stdout, done.stderr) == (1, "", expected)


def test_more_cpus_than_there_are(bam_train):
    status, err = bam_train(num_env_runners=1000)
    assert status == 1
    assert re.fullmatch(
        r"bam-train: 1000 env runners ask for 1000 CPUs, \d+ on this computer\. "
        r"Lower --num-env-runners or --num-learners, or join a cluster with --address\n",
        err,
    )


def test_more_gpus_than_there_are(bam_train):
    status, err = bam_train(num_gpus=99)
    assert status == 1
    expected = r"num_gpus: 99 GPUs asked for, \d+ on this computer\. Give --num-gpus \d+"
    assert re.fullmatch(f"bam-train: {expected}\n", err)


def test_a_number_of_gpus_that_is_none(bam_train, monkeypatch):
    monkeypatch.setenv("RLLIB_NUM_GPUS", "abc")
    expected = "RLLIB_NUM_GPUS: expected a whole number of GPUs, such as 1, found 'abc'. Mend or unset it"
    assert bam_train() == (1, f"bam-train: {expected}\n")


def test_a_cluster_that_does_not_answer(bam_train):
    with socket.create_server(("127.0.0.1", 0)) as server:
        place = f"127.0.0.1:{server.getsockname()[1]}"
    before = time.monotonic()
    status, err = bam_train(address=place)
    assert time.monotonic() - before < 20.0
    assert status == 1
    assert err.startswith(f"bam-train: {place}: no Ray cluster answers there (Connection refused). ")
    assert err.count("\n") == 1


def test_flags_of_rllib_without_it(bam_train):
    status, err = bam_train(trainer="sb3", num_env_runners=2, set=())
    assert (status, err.count("\n")) == (1, 1)
    assert err.startswith("bam-train: num_env_runners: ")


def test_an_address_to_copy_to_that_cannot_be(bam_train):
    expected = "nowhere://x: cannot be copied to: Protocol not known: nowhere"
    assert bam_train(copy_to="nowhere://x") == (1, f"bam-train: {expected}\n")


@pytest.mark.slow
def test_checkpoints_are_copied(bam_train, here):
    status, err = bam_train(copy_to=f"file://{here}/bucket/", out=here / "reach.zip")
    assert status == 0, err
    assert (here / "bucket" / "reach.zip").read_bytes() == (here / "reach.zip").read_bytes()
    (here / "file").write_text("in the way")
    status, err = bam_train(copy_to=f"file://{here}/file/x", out=here / "again.zip")
    assert status == 1
    last = err.splitlines()[-1]
    assert last.startswith(
        f"bam-train: file://{here}/file/x: {here}/again.zip could not be copied there: NotADirectory"
    )
    assert "all steps done at 256 steps" in err
    assert Checkpoint.open(here / "again.zip").manifest.steps == 256


@pytest.fixture
def start():
    """Starts the program in a process group of its own, as a shell does, with its standard error piped."""
    with contextlib.ExitStack() as stack:

        def start(*arguments, folder=None):
            command = [sys.executable, "-m", "bam_train.cli.train", "--env", "bam/reach", "--algo", "ppo"]
            command += ["--trainer", "rllib", "--num-env-runners", "1", "--steps", "100000000"]
            for setting in SMALL:
                command += ["--set", setting]
            process = stack.enter_context(
                subprocess.Popen(
                    [*command, *arguments],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                    env=environment(),
                    start_new_session=True,
                    cwd=folder,
                )
            )
            stack.callback(process.kill)  # Ray's own processes end with it
            timer = threading.Timer(LONGEST, process.kill)
            timer.start()
            stack.callback(timer.cancel)
            return process

        yield start


LONGEST = 300.0
"""Seconds after which a program that was started is killed."""


def wait_for(process, words):
    """Read standard error up to a line that holds `words`."""
    lines = []
    for line in process.stderr:
        lines.append(line)
        if words in line:
            return
    raise AssertionError(f"never said {words!r}, but {lines}")


def as_timeout_does(group, number):
    """To the program, and then to its whole group; `systemctl stop` and batch systems do alike."""
    os.kill(group, number)
    os.killpg(group, number)


def folders_of(processes):
    """Folders of the Ray that these processes are of."""
    return {found for one in processes for found in re.findall(r"/\S*bam-ray-\w+", " ".join(one.cmdline()))}


SENT = (
    ((signal.SIGINT, os.killpg, 130), (signal.SIGTERM, os.kill, 143)),
    ((signal.SIGTERM, as_timeout_does, 143), (signal.SIGHUP, os.killpg, 129)),
)


@pytest.mark.slow
@pytest.mark.parametrize("sent", SENT, ids=["ctrl-c-and-kill", "timeout-and-hang-up"])
def test_a_signal_saves_and_leaves_no_process(here, start, sent):
    """Two runs at once, each with a Ray of its own: together they are ready nearly as soon as one is alone."""
    folders = [here / str(place) for place in range(len(sent))]
    for folder in folders:
        folder.mkdir()
    processes = [start("--eval-every", "100000000", folder=folder) for folder in folders]
    for process, folder, (number, send, status) in zip(processes, folders, sent, strict=True):
        require_saved_and_gone(process, folder, number, send, status)


def require_saved_and_gone(process, here, number, send, status):
    wait_for(process, "steps/s")
    processes = psutil.Process(process.pid).children(recursive=True)
    assert len(processes) > 5
    folders = folders_of(processes)
    send(process.pid, number)  # a terminal sends Ctrl-C, and SIGHUP at its end, to the whole group
    _, err = process.communicate(timeout=120)
    assert process.returncode == status, err
    assert "finishing the update and saving" in err
    assert "Traceback" not in err
    assert err.splitlines()[-1] == "  bam-train --resume runs/reach-rllib-ppo/last.zip"
    assert Checkpoint.open(here / "runs" / "reach-rllib-ppo" / "last.zip").manifest.steps >= 256
    assert not any(one.is_running() for one in processes)
    assert len(folders) == 1
    assert not any(map(os.path.exists, folders))


@pytest.mark.slow
def test_ctrl_c_while_it_is_set_up_leaves_no_process(start):
    process = start()
    processes, end = set(), time.monotonic() + 120
    while not any("raylet" in one.name() for one in processes) and time.monotonic() < end:
        processes = set(psutil.Process(process.pid).children(recursive=True))
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert err.splitlines()[-1] == "bam-train: interrupted"
    _, alive = psutil.wait_procs(processes, timeout=10)
    assert not alive


@pytest.mark.slow
def test_two_signals_quit_at_once_and_leave_no_process(start):
    process = start("--set", "num_epochs=100000")
    wait_for(process, "ppo on bam/reach-v0, seed 0")
    time.sleep(3.0)  # into the first update, which takes minutes
    processes = psutil.Process(process.pid).children(recursive=True)
    folders = folders_of(processes)
    os.killpg(process.pid, signal.SIGINT)
    wait_for(process, "finishing the update")
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 130
    assert err == "bam-train: quit at once; no checkpoint had been saved yet\n"
    _, alive = psutil.wait_procs(processes, timeout=10)  # less than Ray's agents take to see that nobody is left
    assert not alive
    assert len(folders) == 1
    assert not any(map(os.path.exists, folders))
