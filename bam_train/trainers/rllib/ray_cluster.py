"""Ray for one training run: a private instance on this computer, or an existing cluster; and its CPUs and GPUs.

The private instance listens on the loopback device only, requires a secret token, and is removed when the run ends for
any reason. A cluster is joined, and not changed. Ray tries an address without an answer for minutes and may end the
whole process; so the address is first tested by a socket, then by another process.
"""

import contextlib
import functools
import importlib
import logging
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray
import ray.rllib  # sets up its loggers

from bam_train.errors import SettingsError, TrainingFailed
from bam_train.files.log_lines import counted
from bam_train.settings import RLlibSettings
from bam_train.signals import at_quit, interrupt, reinstalled, waiting
from bam_train.trainers.base import cores

psutil: Any = importlib.import_module("psutil")  # Ray brings its own copy

OBJECT_STORE = 200 * 2**20  # bytes of the private Ray for samples and weights, which are a few megabytes
GRACE = 3.0  # s in which Ray's processes may end by themselves after Ray has shut down

SOCKET_TIMEOUT = 5.0
"""Longest wait for the host of a cluster to accept a connection [s]."""

REACH_TIMEOUT = 13.0
"""Longest time for joining the cluster after that [s]; about 2 s are usual."""

SPARED = ("start_monitor", "start_log_monitor", "start_api_server")
"""Ray's processes that add computers, copy logs, and answer a dashboard, of which there is none."""

VARIABLE = "RLLIB_NUM_GPUS"
LONGEST_BUSY = 10.0  # s to wait for CPUs and GPUs that others in the cluster use

_TOKEN = secrets.token_hex(32)
_LOGGERS = ("ray", "ray.rllib", "ray.tune", "ray.train", "ray.data")


@contextlib.contextmanager
def cluster(settings: RLlibSettings) -> Iterator[None]:
    """Within the ``with`` block, Ray runs: an instance of this process, the cluster at `address`, or a private one.

    Raises:
        SettingsError: More resources are requested than exist, or the address is malformed.
        TrainingFailed: Ray does not start, or the cluster does not answer or refuses to be joined; within 20 s.
    """
    with _quiet(), contextlib.ExitStack() as stack:
        if settings.address is not None and not ray.is_initialized():
            place = find(settings.address)
            reach(place)
            stack.callback(_shut_down)
            with _starting():
                ray.init(address=place, log_to_driver=False, logging_level=logging.CRITICAL)
        require_resources(settings)
        if not ray.is_initialized():
            stack.enter_context(_private(settings))
        yield


@contextlib.contextmanager
def _private(settings: RLlibSettings) -> Iterator[None]:
    if not any(name in os.environ for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")):
        # Ray would write a token, readable by others, into the home folder. It reads the token once in a process, so
        # the variable stays for a later `ray.init`.
        os.environ["RAY_AUTH_TOKEN"] = _TOKEN
    before = set(psutil.Process().children())
    # Paths of Ray's sockets must be short; a forked process would remove a `tempfile.TemporaryDirectory`.
    folder = tempfile.mkdtemp(prefix="bam-ray-", dir="/tmp" if os.path.isdir("/tmp") else None)
    try:
        with at_quit(lambda: _kill_at_once(before, folder)):
            try:
                with _starting(), contained():
                    ray.init(
                        address="local",
                        num_cpus=cores(),
                        num_gpus=gpus(settings),
                        object_store_memory=OBJECT_STORE,
                        include_dashboard=False,
                        log_to_driver=False,
                        logging_level=logging.CRITICAL,
                        _temp_dir=folder,
                    )
            except Exception as error:  # Ray has no common class for failures of its processes
                why = str(error).strip().partition("\n")[0].rstrip(".")
                text = f"Ray does not start on this computer: {why}. Is there enough memory and disk?"
                raise TrainingFailed(text) from error
            yield
    finally:
        # Another Ctrl-C waits, as it would leave a part of Ray running, unless its handler quits at once.
        quits = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        with contextlib.nullcontext() if quits else waiting():
            started = _started_since(before)  # with their children: once a parent is gone, they cannot be found
            with contextlib.suppress(Exception):  # after any failure its processes are killed below
                _shut_down(wait_for_processes=True)
            _, alive = psutil.wait_procs(started, timeout=GRACE)
            _kill(alive)
            psutil.wait_procs(alive, timeout=GRACE)
            shutil.rmtree(folder, ignore_errors=True)


def _started_since(before: set[Any]) -> list[Any]:
    """The child processes that are not in `before`, and all their descendants."""
    started: set[Any] = set()
    for child in set(psutil.Process().children()) - before:
        started.add(child)
        with contextlib.suppress(psutil.Error):
            started.update(child.children(recursive=True))
    return list(started)


def _kill_at_once(before: set[Any], folder: str) -> None:
    """Kill the processes that are not in `before`, some of which would run for a minute, and remove `folder`.

    The raylet is suspended first and killed last: it would end when its agents do, and Ray then ends this process with
    status 1.
    """
    started = _started_since(before)
    raylets = []
    for process in started:
        with contextlib.suppress(psutil.Error):
            if process.name() == "raylet":
                process.suspend()
                raylets.append(process)
    _kill([process for process in started if process not in raylets])
    shutil.rmtree(folder, ignore_errors=True)
    _kill(raylets)


def _kill(processes: list[Any]) -> None:
    for process in processes:
        with contextlib.suppress(psutil.Error):
            process.kill()


@contextlib.contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Set environment variables within the ``with`` block, for this process and those that it starts."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


@contextlib.contextmanager
def contained() -> Iterator[None]:
    """Within the ``with`` block, Ray starts on 127.0.0.1 alone, in few processes, in sessions of their own.

    The only private names of Ray here, as its options do neither. `ray.init` replaces ``_node_ip_address="127.0.0.1"``
    by an address that others can reach, and with 127.0.0.2 its servers bind to all addresses; it reads the environment
    variable when it is imported. ``timeout``, batch systems and terminals signal the whole process group: Ray's
    processes would end before the update is finished and saved. Starting Ray from a process of its own takes 2 s more.
    `SPARED` are of no use to one run, and half of what a start costs.
    """
    from ray._private import node, ray_constants, services

    changes: dict[tuple[Any, str], Any] = {(ray_constants, "ENABLE_RAY_CLUSTER"): False}
    changes |= {(node.Node, name): lambda *args, **options: None for name in SPARED}
    if sys.platform == "linux":  # which kills them with this process; elsewhere they stay in the group
        changes[services, "ConsolePopen"] = functools.partial(services.ConsolePopen, start_new_session=True)
    before = {place: getattr(*place) for place in changes}
    try:
        for place, value in changes.items():
            setattr(*place, value)
        with _environment(RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER="0"):
            yield
    finally:
        for place, value in before.items():
            setattr(*place, value)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the loggers of Ray and RLlib within the ``with`` block: `RunnerWatch` and exceptions inform the user."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    before = [(logger, logger.handlers[:], logger.propagate) for logger in loggers]
    for logger in loggers:
        logger.handlers[:], logger.propagate = [logging.NullHandler()], False
    try:
        yield
    finally:
        for logger, handlers, propagate in before:
            logger.handlers[:], logger.propagate = handlers, propagate


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Around `ray.init`: silence its C++ part, which reports even this on standard error, and delay signals.

    An exception of a signal handler would make the C++ part abort. `ray.init` handles SIGTERM itself, by SystemExit.
    """
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with waiting(), _environment(RAY_BACKEND_LOG_LEVEL="fatal"), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            try:
                yield
            finally:
                os.dup2(kept, 2)
    except SystemExit as end:
        interrupt(int(end.code or signal.SIGTERM))
    finally:
        os.close(kept)


def _shut_down(**options: bool) -> None:
    """Shut Ray down; its C++ part resets SIGTERM to kill the process, so the handler is installed again."""
    with reinstalled(signal.SIGTERM):
        ray.shutdown(**options)


# Existing clusters


def find(address: str) -> str:
    """The ``host:port`` of a cluster from ``auto`` or ``host:port``; ``auto`` reads RAY_ADDRESS first.

    Raises:
        SettingsError: The address is malformed.
        TrainingFailed: The address is ``auto``, and no cluster was started on this computer.
    """
    place, name = address, "address"
    if address == "auto" and (variable := os.environ.get("RAY_ADDRESS")):
        place, name = variable, "RAY_ADDRESS"
    if place == "auto":
        written = Path(os.environ.get("RAY_TMPDIR") or tempfile.gettempdir()) / "ray/ray_current_cluster"
        place = written.read_text().strip() if written.is_file() else ""  # the address that ``ray start`` wrote
        if not place:
            raise TrainingFailed(
                "no Ray cluster was started on this computer, so --address auto finds none. Start one with "
                "ray start --head, give --address host:port, or leave --address out"
            )
    expected = f"{name}: expected auto or host:port, such as 10.0.0.5:6379, found {place!r}"
    if place.startswith("ray://"):
        raise SettingsError(
            f"{expected}, which is for Ray's client. Run bam-train on a computer of the cluster and give --address auto"
        )
    parts = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[^\s:/]+):(\d{1,5})", place)
    if parts is None or not 0 < int(parts[2]) < 2**16:
        raise SettingsError(expected)
    return place


_PROBE = """
import logging, sys
import ray
ray.init(address=sys.argv[1], log_to_driver=False, logging_level=logging.CRITICAL)
print("joined", flush=True)
ray.shutdown()
"""
"""Program that joins a cluster, and prints a line when it has."""


def reach(place: str, timeout: float = REACH_TIMEOUT) -> None:
    """Check that a run can join the cluster at ``host:port`` within `timeout` s after the host accepts a connection.

    Raises:
        TrainingFailed: Nothing answers there, the server is not a cluster, or it refuses to be joined.
    """
    host, _, port = place.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), SOCKET_TIMEOUT).close()
    except OSError as error:
        why = error.strerror or str(error)
        raise TrainingFailed(
            f"{place}: no Ray cluster answers there ({why}). Check --address, and that ray start --head runs there "
            "and no firewall is between"
        ) from error
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    try:
        command = [sys.executable, "-c", _PROBE, place]
        output = subprocess.run(command, **pipes, timeout=timeout, check=False).stdout
    except subprocess.TimeoutExpired as error:
        output = error.stdout or b""
    text = output.decode(errors="replace")
    if "joined" not in text.splitlines():
        raise TrainingFailed(f"{place}: {reason(text)}")


def reason(output: str) -> str:
    """Why the process that printed `output` could not join a cluster, and the remedy."""
    if re.search("InvalidAuthToken|AuthenticationError|authentication token", output):
        return (
            "the cluster does not accept the token, or none was given. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to "
            "what ray get-auth-token says on its head"
        )
    if "ersion mismatch" in output:
        return "the cluster runs another Python or Ray than this computer. Install the same versions everywhere"
    return (
        f"what answers there could not be joined within {REACH_TIMEOUT:.0f} s: it is not a Ray cluster (whose port is "
        "6379 by default), or this computer is not part of the cluster, or busy. Run ray start --address=HOST:PORT "
        "here first, or run bam-train on one of its computers"
    )


# CPUs and GPUs: RLlib would silently wait for more than exist


def gpus(settings: RLlibSettings) -> int:
    """GPUs that the learners of a run use in all: ``--num-gpus``, else RLLIB_NUM_GPUS, else 0.

    Raises:
        SettingsError: RLLIB_NUM_GPUS is not a whole number of at least 0.
    """
    if settings.num_gpus is not None:
        return settings.num_gpus
    text = os.environ.get(VARIABLE, "").strip() or "0"
    if not (text.isascii() and text.isdigit()):
        raise SettingsError(f"{VARIABLE}: expected a whole number of GPUs, such as 1, found {text!r}. Mend or unset it")
    return int(text)


def learners(settings: RLlibSettings) -> tuple[int, int]:
    """RLlib's ``num_learners``, where 0 is the trainer's own process, and ``num_gpus_per_learner``.

    Raises:
        SettingsError: The GPUs cannot be shared evenly among the learners.
    """
    number, wanted = settings.num_learners, gpus(settings)
    if number == 0:
        return (0, wanted) if wanted <= 1 else (wanted, 1)
    if wanted not in (0, number):
        name = VARIABLE if settings.num_gpus is None else "num_gpus"
        raise SettingsError(f"{name}: {number} learners use 0 or {number} GPUs, one each, found {wanted}")
    return number, int(wanted > 0)


def require_resources(settings: RLlibSettings) -> None:
    """Refuse a run that needs more CPUs or GPUs than the joined cluster, or else this computer, has.

    Each runner and each learner without a GPU needs a CPU; a learner with a GPU needs only that.

    Raises:
        SettingsError: The message gives the wanted and the existing numbers, and a remedy.
    """
    import torch

    number, gpus_each = learners(settings)
    own_gpus = torch.cuda.device_count()
    if number == 0:
        _require_gpus(settings, gpus_each, own_gpus, "on this computer")
    joined = ray.is_initialized()
    where = "in the cluster" if joined else "on this computer"
    there = ray.cluster_resources() if joined else {"CPU": cores(), "GPU": own_gpus}
    wanted = {"CPU": settings.num_env_runners + number * (gpus_each == 0), "GPU": number * gpus_each}
    _require_gpus(settings, wanted["GPU"], int(there.get("GPU", 0)), where)
    if wanted["CPU"] > there.get("CPU", 0):
        for_what = [counted(settings.num_env_runners, "env runner")] * (settings.num_env_runners > 0)
        for_what += [counted(number, "learner")] * (number > 0 and not gpus_each)
        add = "add computers with ray start" if joined else "join a cluster with --address"
        raise SettingsError(
            f"{' and '.join(for_what)} ask for {counted(wanted['CPU'], 'CPU')}, {int(there.get('CPU', 0))} {where}. "
            f"Lower --num-env-runners or --num-learners, or {add}"
        )
    if joined:
        _require_free(wanted)


def _require_gpus(settings: RLlibSettings, wanted: int, there: int, where: str) -> None:
    if wanted > there:
        unset = settings.num_gpus is None
        remedy = f"Set it to {there}, or unset it" if unset else f"Give --num-gpus {there}"
        name = VARIABLE if unset else "num_gpus"
        raise SettingsError(f"{name}: {counted(wanted, 'GPU')} asked for, {there} {where}. {remedy}")


def _require_free(wanted: dict[str, int]) -> None:
    """Wait some seconds for CPUs and GPUs that others in the cluster use, such as a run that has just ended."""
    end = time.monotonic() + LONGEST_BUSY
    while True:
        free = ray.available_resources()
        name = next((name for name, number in wanted.items() if number > free.get(name, 0)), None)
        if name is None:
            return
        if time.monotonic() > end:
            raise SettingsError(
                f"{counted(wanted[name], name)} asked for, and {int(free.get(name, 0))} of the cluster's "
                f"{int(ray.cluster_resources()[name])} not in use by others. Ask for less, or wait for them"
            )
        time.sleep(0.2)
