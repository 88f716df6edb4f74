"""Ray of a run's own, and one that is joined: what is started, who can reach it, and that nothing is left."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("ray.rllib")

import psutil
import ray

from bam_train.errors import SettingsError, TrainingFailed
from bam_train.settings import RLlibSettings
from bam_train.signals import Terminated
from bam_train.trainers.base import cores
from bam_train.trainers.rllib.ray_cluster import cluster, reach

pytestmark = pytest.mark.slow


def settings(**given):
    return RLlibSettings.from_mapping({"env": "bam/reach-v0", "algo": "ppo", "trainer": "rllib", **given})


@pytest.fixture(autouse=True)
def home(no_ray, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_ADDRESS"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.fixture
def started():
    """Processes that Ray runs for this one, which those of other tests are not, such as multiprocessing's tracker."""
    others = psutil.Process().children(recursive=True)
    return lambda: [process for process in psutil.Process().children(recursive=True) if process not in others]


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


STUBBORN = "import signal, time; signal.signal(15, signal.SIG_IGN); print(flush=True); time.sleep(60)"


def test_one_of_its_own_is_here_alone_and_gone_after_another_ctrl_c(home, started, capfd, monkeypatch):
    environment, handlers, came = dict(os.environ), logging.getLogger("ray").handlers[:], []
    before = signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    handler, shutdown = signal.getsignal(signal.SIGTERM), ray.shutdown

    def disturbed(**given):
        signal.raise_signal(signal.SIGINT)
        shutdown(**given)

    try:
        try:
            with monkeypatch.context() as patch, cluster(settings()):
                processes = started()
                assert len(processes) >= 4
                assert not {"dashboard.py", "monitor.py", "log_monitor.py"} & {
                    Path(word).name for process in processes for word in process.cmdline()
                }
                assert os.getpgrp() not in {os.getpgid(process.pid) for process in processes}
                assert listening([psutil.Process(), *processes]) == {"127.0.0.1"}
                assert ray.cluster_resources()["CPU"] == cores()
                assert signal.getsignal(signal.SIGTERM) is handler
                (folder,) = folders(processes)
                assert Path(folder).is_dir()
                with cluster(settings()):  # one that runs in this process is used, and stays
                    assert len(started()) == len(processes)
                assert ray.is_initialized()
                with pytest.raises(SettingsError, match="in the cluster"), cluster(settings(num_env_runners=1000)):
                    pass
                stubborn = subprocess.Popen([sys.executable, "-c", STUBBORN], stdout=subprocess.PIPE)
                stubborn.stdout.readline()
                patch.setattr(ray, "shutdown", disturbed)
                raise SystemExit
        except KeyboardInterrupt:
            came.append(signal.SIGINT)
        assert not psutil.pid_exists(stubborn.pid)
        stubborn.wait()  # whose status is known already
        stubborn.stdout.close()
        assert not any(process.is_running() for process in processes)
        assert not Path(folder).exists()
        assert not (home / ".ray").exists()
        assert not ray.is_initialized()
        assert logging.getLogger("ray").handlers == handlers
        changed = {name for name in os.environ if environment.get(name) != os.environ[name]}
        of_ray = {"RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_USAGE_STATS_ENABLED", "RAY_CLIENT_MODE"}
        assert changed <= {*of_ray, "PYTHONBREAKPOINT"}
        assert capfd.readouterr() == ("", "")
        assert is_caught(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert came == [signal.SIGINT, signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


def is_caught(number):
    """Whether the process has a handler for a signal; Python does not know what C++ did to it."""
    status = Path("/proc/self/status")
    if not status.exists():  # not on Linux
        return True
    mask = re.search(r"SigCgt:\s+(\w+)", status.read_text())[1]
    return bool(int(mask, 16) >> (number - 1) & 1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_waits_while_it_starts(number, monkeypatch):
    class Came(BaseException):
        pass

    def came(*_):
        raise Came

    ended = []
    monkeypatch.setattr(ray, "init", lambda **_: (signal.raise_signal(number), ended.append(True)))
    before = signal.signal(number, came)
    try:
        with pytest.raises(Came), cluster(settings()):
            pass
        assert signal.getsignal(number) is came
    finally:
        signal.signal(number, before)
    assert ended == [True]


def test_a_sigterm_that_ray_takes_while_it_starts(monkeypatch):
    monkeypatch.setattr(ray, "init", lambda **_: sys.exit(signal.SIGTERM))  # as Ray's own handler does
    with pytest.raises(Terminated) as caught, cluster(settings()):
        pass
    assert caught.value.signal == signal.SIGTERM


def test_a_ray_that_does_not_start(monkeypatch):
    def fail(**_):
        raise RuntimeError("Failed to start GCS.\nLast 0 lines of error files:")

    monkeypatch.setattr(ray, "init", fail)
    with pytest.raises(TrainingFailed) as caught, cluster(settings()):
        pass
    text = "Ray does not start on this computer: Failed to start GCS. Is there enough memory and disk?"
    assert str(caught.value) == text
    too_much = cluster(settings(num_env_runners=1000))  # refused before anything is started
    with pytest.raises(SettingsError, match="1000 env runners ask for 1000 CPUs"), too_much:
        pass


CLUSTER = """
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False, "no_monitor": True})
print(cluster.address, flush=True)
input()
cluster.shutdown()
"""

JOIN = """
import os, sys
from bam_train.cli.program import guarded
from bam_train.settings import RLlibSettings
from bam_train.trainers.rllib.ray_cluster import cluster
import ray
@ray.remote(max_retries=0)
def crash():
    os.kill(os.getpid(), 9)
given = {"env": "bam/reach-v0", "algo": "ppo", "trainer": "rllib", "address": sys.argv[1]}
def join():
    with cluster(RLlibSettings.from_mapping(given)):
        try:
            ray.get(crash.remote())
        except ray.exceptions.WorkerCrashedError:
            print(int(ray.cluster_resources()["CPU"]), "CPU")
    with cluster(RLlibSettings.from_mapping(given | {"num_env_runners": 2})):
        pass
sys.exit(guarded(join, "bam-train"))
"""

TOKEN = "0123456789abcdef" * 4


def test_a_cluster_is_joined_and_left_as_it_was(monkeypatch):
    """One that another process has started, with a token."""
    monkeypatch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # here alone
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", TOKEN)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", CLUSTER], **pipes) as process:
        try:
            address = process.stdout.readline().strip()
            assert address, process.stderr.read()  # Ray gives a raylet 30 s to start
            processes = psutil.Process(process.pid).children(recursive=True)
            with subprocess.Popen([sys.executable, "-c", JOIN, address], **pipes) as joining:
                monkeypatch.setenv("RAY_AUTH_TOKEN", "f" * 64)
                with pytest.raises(TrainingFailed) as caught:
                    reach(address)
                out, err = joining.communicate(timeout=120)
            assert all(process.is_running() for process in processes if "IDLE" not in process.name())
        finally:
            process.communicate("\n", timeout=60)
    assert str(caught.value) == (
        f"{address}: the cluster does not accept the token, or none was given. Set RAY_AUTH_MODE=token, and "
        "RAY_AUTH_TOKEN to what ray get-auth-token says on its head"
    )
    assert (joining.returncode, out, err) == (
        1,
        "1 CPU\n",
        "bam-train: 2 env runners ask for 2 CPUs, 1 in the cluster. "
        "Lower --num-env-runners or --num-learners, or add computers with ray start\n",
    )
