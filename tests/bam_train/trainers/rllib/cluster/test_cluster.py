"""Ray of a run's own, and one that is joined: what is started, who can reach it, and that nothing is left."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("ray.rllib")

import psutil
import ray
from ray._private import utils

from bam_train.errors import SettingsError, TrainingFailed
from bam_train.settings import TrainSettings
from bam_train.trainers.rllib.cluster import cluster as module
from bam_train.trainers.rllib.cluster.cluster import cluster
from bam_train.trainers.rllib.cluster.descendants import Descendants

pytestmark = pytest.mark.slow


def settings(**given):
    return TrainSettings.from_mapping({"env": "bam/reach-v0", "algo": "ppo", "trainer": "rllib", **given})


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_ADDRESS"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.fixture(autouse=True)
def _others():
    """Processes of other tests, such as multiprocessing's tracker, are not Ray's."""
    OTHERS.clear()
    OTHERS.update(psutil.Process().children(recursive=True))


OTHERS = set()


def started():
    """Processes that Ray runs for this one."""
    return [process for process in psutil.Process().children(recursive=True) if process not in OTHERS]


def listening(processes):
    """Addresses that processes listen on."""
    return {
        connection.laddr.ip.removeprefix("::ffff:")
        for process in processes
        for connection in process.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    }


def folders(processes):
    return {found for process in processes for found in re.findall(r"/\S*bam-ray-\w+", " ".join(process.cmdline()))}


def test_one_of_its_own_is_here_alone_and_gone_afterwards(home, capfd):
    environment, handler = dict(os.environ), signal.getsignal(signal.SIGTERM)
    handlers = logging.getLogger("ray").handlers[:]
    with cluster(settings()):
        processes = started()
        assert len(processes) >= 5
        assert os.getpgrp() not in {os.getpgid(process.pid) for process in processes}
        assert listening([psutil.Process(), *processes]) == {"127.0.0.1"}
        assert ray.cluster_resources()["CPU"] == module.cores()
        assert signal.getsignal(signal.SIGTERM) is handler
        (folder,) = folders(processes)
        assert Path(folder).is_dir()
    assert not any(process.is_running() for process in processes)
    assert not Path(folder).exists()
    assert not (home / ".ray").exists()
    assert not ray.is_initialized()
    assert logging.getLogger("ray").handlers == handlers
    changed = {name for name in os.environ if environment.get(name) != os.environ[name]}
    assert changed <= {"RAY_USAGE_STATS_ENABLED", "RAY_CLIENT_MODE", "PYTHONBREAKPOINT"}
    assert capfd.readouterr() == ("", "")


def test_it_is_gone_after_an_exception():
    processes = []

    def interrupted():
        with cluster(settings()):
            processes.extend(started())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert processes
    assert not any(process.is_running() for process in processes)


def test_sigterm_is_heard_afterwards():
    came = []
    before = signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    try:
        with cluster(settings()):
            pass
        assert is_caught(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert came == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


def is_caught(number):
    """Whether the process has a handler for a signal; Python does not know what C++ did to it."""
    status = Path("/proc/self/status")
    if not status.exists():  # not on Linux
        return True
    mask = re.search(r"SigCgt:\s+(\w+)", status.read_text())[1]
    return bool(int(mask, 16) >> (number - 1) & 1)


def test_another_ctrl_c_at_the_end_leaves_nothing_either(monkeypatch):
    processes, found, shutdown = [], [], ray.shutdown

    def disturbed(**given):
        signal.raise_signal(signal.SIGINT)
        shutdown(**given)

    def interrupted():
        with monkeypatch.context() as patch, cluster(settings()):
            processes.extend(started())
            found.extend(folders(processes))
            patch.setattr(ray, "shutdown", disturbed)
            raise SystemExit

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not ray.is_initialized()
    assert processes
    assert not any(process.is_running() for process in processes)
    assert len(found) == 1
    assert not Path(found[0]).exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_it_starts_is_our_own(number, monkeypatch):
    class Came(BaseException):
        pass

    def came(*_):
        raise Came

    def start(**_):
        utils.set_sigterm_handler(lambda *_: pytest.fail("Ray's handler"))  # as `ray.init` does
        signal.raise_signal(number)
        ended.append(True)

    ended, before = [], signal.signal(number, came)
    monkeypatch.setattr(ray, "init", start)
    try:
        with pytest.raises(Came), cluster(settings()):
            pass
        assert signal.getsignal(number) is came
    finally:
        signal.signal(number, before)
    assert ended == [True]


def test_one_that_runs_in_this_process_is_used_and_stays():
    with cluster(settings()):
        processes = started()
        with cluster(settings()):
            assert len(started()) == len(processes)
        assert ray.is_initialized()
        with pytest.raises(SettingsError, match="in the cluster"), cluster(settings(num_env_runners=1000)):
            pass


def test_too_much_is_refused_before_anything_is_started(monkeypatch):
    monkeypatch.setattr(ray, "init", lambda **_: pytest.fail("Ray was started"))
    with (
        pytest.raises(SettingsError, match="1000 env runners ask for 1000 CPUs"),
        cluster(settings(num_env_runners=1000)),
    ):
        pass


def test_a_ray_that_does_not_start(monkeypatch):
    def fail(**_):
        raise RuntimeError("Failed to start GCS.\nLast 0 lines of error files:")

    monkeypatch.setattr(ray, "init", fail)
    with pytest.raises(TrainingFailed) as caught, cluster(settings()):
        pass
    assert str(caught.value) == (
        "Ray does not start on this computer: Failed to start GCS. Is there enough memory and disk?"
    )


def test_a_process_that_does_not_go_is_killed(monkeypatch):
    monkeypatch.setattr("bam_train.trainers.rllib.cluster.descendants.GRACE", 0.2)
    descendants = Descendants()
    code = "import signal, time; signal.signal(15, signal.SIG_IGN); print(flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        descendants.watch()
        before = time.monotonic()
        descendants.end()
        assert not psutil.pid_exists(process.pid)
        assert time.monotonic() - before < 10.0


CLUSTER = """
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
print(cluster.address, flush=True)
input()
cluster.shutdown()
"""

JOIN = """
import sys, ray
from bam_train.cli.program import guarded
from bam_train.settings import TrainSettings
from bam_train.trainers.rllib.cluster.cluster import cluster
given = {"env": "bam/reach-v0", "algo": "ppo", "trainer": "rllib", "address": sys.argv[1]}
def join():
    with cluster(TrainSettings.from_mapping(given | {"num_env_runners": int(sys.argv[2])})):
        print(int(ray.cluster_resources()["CPU"]), "CPU")
sys.exit(guarded(join, "bam-train"))
"""

HERE_ALONE = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
TOKEN = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0123456789abcdef" * 4}


@pytest.fixture
def joinable():
    """A cluster that another process has started, with a token; its address, and that process."""
    command, environment = [sys.executable, "-c", CLUSTER], {**os.environ, **HERE_ALONE, **TOKEN}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            yield process.stdout.readline().strip(), process
        finally:
            process.communicate("\n", timeout=60)


def join(address, runners=0, **variables):
    """Joins a cluster in another process; its status, and what it says."""
    environment = {**os.environ, **HERE_ALONE, "PYTHONPATH": os.pathsep.join(sys.path), **variables}
    done = subprocess.run(
        [sys.executable, "-c", JOIN, address, str(runners)],
        capture_output=True,
        text=True,
        timeout=120,
        env=environment,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def test_a_cluster_is_joined_and_left_as_it_was(joinable):
    address, process = joinable
    processes = psutil.Process(process.pid).children(recursive=True)
    assert join(address, **TOKEN) == (0, "1 CPU\n")
    assert join(address, runners=2, **TOKEN) == (
        1,
        "bam-train: 2 env runners ask for 2 CPUs, 1 in the cluster. "
        "Lower --num-env-runners or --num-learners, or add computers with ray start\n",
    )
    refused = (
        1,
        f"bam-train: {address}: the cluster does not accept the token, or none was given. Set RAY_AUTH_MODE=token, and "
        "RAY_AUTH_TOKEN to what ray get-auth-token says on its head\n",
    )
    assert join(address) == refused
    assert join(address, RAY_AUTH_MODE="token") == refused
    assert join(address, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN="f" * 64) == refused
    assert all(process.is_running() for process in processes if "IDLE" not in process.name())
