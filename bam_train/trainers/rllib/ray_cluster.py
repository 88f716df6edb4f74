"""Ray for one training run: a private instance on this computer, or an existing cluster.

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
import threading
from collections.abc import Iterator
from typing import Any

import ray
import ray.rllib  # sets up its loggers

from bam_train.errors import SettingsError, TrainingFailed
from bam_train.settings import RLlibSettings
from bam_train.signals import at_quit, interrupt, waiting
from bam_train.trainers.rllib.ray_resources import cores, gpus, require_resources

psutil: Any = importlib.import_module("psutil")  # Ray brings its own copy

OBJECT_STORE = 200 * 2**20  # bytes of the private Ray for samples and weights, which are a few megabytes
GRACE = 3.0  # s in which Ray's processes may end by themselves after Ray has shut down

SOCKET_TIMEOUT = 5.0
"""Longest wait for the host of a cluster to accept a connection [s]."""

REACH_TIMEOUT = 13.0
"""Longest time for joining the cluster after that [s]; about 2 s are usual."""

_TOKEN = secrets.token_hex(32)
_LOGGERS = ("ray", "ray.rllib", "ray.tune", "ray.train", "ray.data")
_MODE, _TOKENS = "RAY_AUTH_MODE", ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


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
                ray.init(address=place, log_to_driver=False, configure_logging=False)
        require_resources(settings)
        if not ray.is_initialized():
            stack.enter_context(_private(settings))
        yield


@contextlib.contextmanager
def _private(settings: RLlibSettings) -> Iterator[None]:
    before = set(psutil.Process().children())
    with (
        _new_folder() as folder,
        at_quit(lambda: _kill_at_once(before, folder)),
        _private_token(),
    ):
        try:
            try:
                with _starting(), loopback_only(), _out_of_the_group():
                    ray.init(
                        address="local",
                        num_cpus=cores(),
                        num_gpus=gpus(settings),
                        object_store_memory=OBJECT_STORE,
                        include_dashboard=False,
                        log_to_driver=False,
                        configure_logging=False,
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


@contextlib.contextmanager
def _new_folder() -> Iterator[str]:
    """A folder for Ray's files; a forked process leaves it alone, which `tempfile.TemporaryDirectory` does not."""
    root = "/tmp" if os.path.isdir("/tmp") else None  # paths of Ray's sockets must be short
    folder = tempfile.mkdtemp(prefix="bam-ray-", dir=root)
    try:
        yield folder
    finally:
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
def _private_token() -> Iterator[None]:
    """Give the private Ray a token of this process, instead of one that Ray would write into the home folder."""
    if any(name in os.environ for name in (_MODE, *_TOKENS)):
        yield  # the user has configured the token
        return
    raylet: Any = importlib.import_module("ray._raylet")

    def read_again() -> None:  # Ray reads mode and token once, when it is imported
        raylet.Config.initialize("")
        raylet.AuthenticationTokenLoader.instance().reset_cache()

    try:
        with _environment(**{_MODE: "token", _TOKENS[0]: _TOKEN}):
            read_again()
            yield
    finally:
        read_again()


@contextlib.contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Set environment variables within the ``with`` block, for this process and those that it starts."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def loopback_only() -> Iterator[None]:
    """Within the ``with`` block, Ray starts with 127.0.0.1 as its address, to which all its servers bind.

    Ray has no public option for this: it replaces `ray.init(_node_ip_address="127.0.0.1")` by an address that others
    can reach, unless this constant, which it reads when it is imported, is unset.
    """
    from ray._private import ray_constants

    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        with _environment(**{ray_constants.ENABLE_RAY_CLUSTERS_ENV_VAR: "0"}):
            yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


@contextlib.contextmanager
def _out_of_the_group() -> Iterator[None]:
    """Within the ``with`` block, Ray's processes start in sessions of their own; Linux kills them with this process.

    ``timeout``, batch systems and terminals signal the whole process group: Ray's processes would end before the update
    is finished and saved, and Ray has no public option for this. On other systems they stay in the group.
    """
    from ray._private import services, utils

    if not (sys.platform == "linux" and utils.detect_fate_sharing_support()):
        yield
        return
    before = services.ConsolePopen
    services.ConsolePopen = functools.partial(before, start_new_session=True)
    try:
        yield
    finally:
        services.ConsolePopen = before


# Private instances and clusters


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the loggers of Ray and RLlib within the ``with`` block: `RunnerWatch` and exceptions inform the user."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    before = [(logger, logger.handlers[:], logger.propagate) for logger in loggers]
    _hush()
    try:
        yield
    finally:
        for logger, handlers, propagate in before:
            logger.handlers[:], logger.propagate = handlers, propagate


def _hush() -> None:
    """Silence the loggers of Ray, which `ray.init` changes."""
    for name in _LOGGERS:
        logger = logging.getLogger(name)
        logger.handlers[:], logger.propagate = [logging.NullHandler()], False


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Around `ray.init`: silence its C++ part, which reports this on standard error, and delay signals.

    An exception of a signal handler would make the C++ part abort. `ray.init` handles SIGTERM itself, by SystemExit.
    """
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        with waiting(), _environment(RAY_BACKEND_LOG_LEVEL="fatal"):
            os.dup2(nowhere, 2)
            try:
                yield
            finally:
                os.dup2(kept, 2)
    except SystemExit as end:
        interrupt(int(end.code or signal.SIGTERM))
    finally:
        os.close(kept)
        os.close(nowhere)
        _hush()


def _shut_down(**options: bool) -> None:
    """Shut Ray down; its C++ part resets SIGTERM to kill the process, so the handler is installed again."""
    try:
        ray.shutdown(**options)
    finally:
        handler = signal.getsignal(signal.SIGTERM)
        if handler is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


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
        from ray._private.utils import read_ray_address  # the address that ``ray start`` wrote

        place = read_ray_address() or ""
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
from ray._raylet import GcsClient
GcsClient(address=sys.argv[1])
print("known", flush=True)
ray.init(address=sys.argv[1], log_to_driver=False, logging_level=logging.CRITICAL)
print("joined", flush=True)
ray.shutdown()
"""
"""Program that joins a cluster, and prints each step that succeeded."""


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
    command = [sys.executable, "-c", _PROBE, place]
    try:
        output = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=timeout, check=False
        ).stdout
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
    if "known" not in output.splitlines():
        return "something answers there, but it is no Ray cluster. Check the port: that of ray start --head is 6379"
    return (
        f"the cluster is there, but could not be joined within {REACH_TIMEOUT:.0f} s: this computer is not part of it, "
        "or busy. Run ray start --address=HOST:PORT here first, or run bam-train on one of its computers"
    )
