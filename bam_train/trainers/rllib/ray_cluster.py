"""Ray for one training run: a quiet one of its own on this computer, or a cluster that is there already.

The own one listens on the loopback device only, asks for a token that nobody else has, and is gone when the run ends,
however it ends. A cluster is joined and left as it was. Ray tries a silent address for minutes and may end the whole
process; so a socket, then another process, tries it first.
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
from bam_train.settings import TrainSettings
from bam_train.signals import at_quit, interrupt, waiting
from bam_train.trainers.rllib.ray_resources import cores, gpus, require_resources

psutil: Any = importlib.import_module("psutil")  # Ray has it in a folder of its own

OBJECT_STORE = 200 * 2**20  # bytes that the own Ray shares samples and weights through; they are a few megabytes
GRACE = 3.0  # s that a process of Ray's may take to end by itself once Ray has shut down

SOCKET_TIMEOUT = 5.0
"""How long the host of a cluster may take to accept a connection [s]."""

REACH_TIMEOUT = 13.0
"""How long joining a cluster may take then [s]; about 2 s are usual."""

_TOKEN = secrets.token_hex(32)
_LOGGERS = ("ray", "ray.rllib", "ray.tune", "ray.train", "ray.data")
_MODE, _TOKENS = "RAY_AUTH_MODE", ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


@contextlib.contextmanager
def cluster(settings: TrainSettings) -> Iterator[None]:
    """Ray for a run, within this: one that runs in this process already, the cluster at `address`, else its own.

    Raises:
        SettingsError: More is asked for than there is, or the address cannot be one.
        TrainingFailed: Ray does not start, or the cluster does not answer or refuses us; within 20 s.
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
            stack.enter_context(_own(settings))
        yield


@contextlib.contextmanager
def _own(settings: TrainSettings) -> Iterator[None]:
    before = set(psutil.Process().children())
    root = "/tmp" if os.path.isdir("/tmp") else None  # paths of Ray's sockets must be short
    with (
        tempfile.TemporaryDirectory(prefix="bam-ray-", dir=root, ignore_cleanup_errors=True) as folder,
        at_quit(lambda: shutil.rmtree(folder, ignore_errors=True)),
        at_quit(lambda: _kill(_started_since(before))),  # comes first; two of Ray's would go on for a minute
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
            except Exception as error:  # Ray has no one error for what may go wrong with its processes
                why = str(error).strip().partition("\n")[0].rstrip(".")
                text = f"Ray does not start on this computer: {why}. Is there enough memory and disk?"
                raise TrainingFailed(text) from error
            yield
        finally:
            # Another Ctrl-C waits until Ray is gone: half of it would be left. A handler that quits at once may do so.
            quits = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
            with contextlib.nullcontext() if quits else waiting():
                started = _started_since(before)  # with their children: once a parent is gone, they cannot be found
                with contextlib.suppress(Exception):  # whatever it says about its end, nothing of it must be left
                    _shut_down(wait_for_processes=True)
                _, alive = psutil.wait_procs(started, timeout=GRACE)
                _kill(alive)
                psutil.wait_procs(alive, timeout=GRACE)


def _started_since(before: set[Any]) -> list[Any]:
    """The processes below this one whose ancestor here is not among those of `before`."""
    found: set[Any] = set()
    for child in set(psutil.Process().children()) - before:
        found.add(child)
        with contextlib.suppress(psutil.Error):
            found.update(child.children(recursive=True))
    return list(found)


def _kill(processes: list[Any]) -> None:
    for process in processes:
        with contextlib.suppress(psutil.Error):
            process.kill()


@contextlib.contextmanager
def _private_token() -> Iterator[None]:
    """A token of this process alone for the own Ray, instead of the one that Ray would write into the home folder."""
    if any(name in os.environ for name in (_MODE, *_TOKENS)):
        yield  # whoever set them knows
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
    """Within this, these environment variables are set so, for what is started too."""
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
    """Ray started within this takes 127.0.0.1 for its computer's address, and its servers bind to nothing else.

    There is no public way to it: Ray puts an address that others can reach in the place of
    `ray.init(_node_ip_address="127.0.0.1")`, unless this constant, which it reads when it is imported, is unset.
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
    """Ray started within this has sessions of its own, and ends with this process as before, as Linux kills it then.

    ``timeout``, batch systems and terminals signal the whole process group: Ray's processes would be gone before the
    update is finished and saved, and Ray has no public way to start them elsewhere. On other systems they stay in it.
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


# Any Ray


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Within this, Ray's and RLlib's loggers are silent: `RunnerWatch` and errors tell what the user needs to know."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    before = [(logger, logger.handlers[:], logger.propagate) for logger in loggers]
    _hush()
    try:
        yield
    finally:
        for logger, handlers, propagate in before:
            logger.handlers[:], logger.propagate = handlers, propagate


def _hush() -> None:
    """Silence the loggers of Ray; `ray.init` changes them."""
    for name in _LOGGERS:
        logger = logging.getLogger(name)
        logger.handlers[:], logger.propagate = [logging.NullHandler()], False


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Around `ray.init`: its C++ part learns to be quiet, and says so on standard error; signals wait.

    An exception that a signal raises would make the C++ part abort. `ray.init` handles SIGTERM itself, by SystemExit.
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


def _shut_down(**given: bool) -> None:
    """Shut Ray down; its C++ part leaves SIGTERM to kill the process, so the handler is installed once more."""
    try:
        ray.shutdown(**given)
    finally:
        handler = signal.getsignal(signal.SIGTERM)
        if handler is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


# A cluster that is there already


def find(address: str) -> str:
    """The ``host:port`` of a cluster from ``auto`` or ``host:port``; RAY_ADDRESS is what ``auto`` means if it is set.

    Raises:
        SettingsError: It is no address of a cluster.
        TrainingFailed: ``auto``, and no cluster was started on this computer.
    """
    place, name = address, "address"
    if address == "auto" and (variable := os.environ.get("RAY_ADDRESS")):
        place, name = variable, "RAY_ADDRESS"
    if place == "auto":
        from ray._private.utils import read_ray_address  # what ``ray start`` wrote

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
"""Joins a cluster, and prints how far it came."""


def reach(place: str, timeout: float = REACH_TIMEOUT) -> None:
    """Find out whether a run can join the cluster at ``host:port``, within `timeout` s once the host accepts.

    Raises:
        TrainingFailed: Nothing answers there, what answers is no cluster, or it refuses us; says which.
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
        said = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=timeout, check=False
        ).stdout
    except subprocess.TimeoutExpired as error:
        said = error.stdout or b""
    text = said.decode(errors="replace")
    if "joined" not in text.splitlines():
        raise TrainingFailed(f"{place}: {reason(text)}")


def reason(said: str) -> str:
    """Why another process, which printed this, could not join a cluster, and what to do."""
    if re.search("InvalidAuthToken|AuthenticationError|authentication token", said):
        return (
            "the cluster does not accept the token, or none was given. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to "
            "what ray get-auth-token says on its head"
        )
    if "ersion mismatch" in said:
        return "the cluster runs another Python or Ray than this computer. Install the same versions everywhere"
    if "known" not in said.splitlines():
        return "something answers there, but it is no Ray cluster. Check the port: that of ray start --head is 6379"
    return (
        f"the cluster is there, but could not be joined within {REACH_TIMEOUT:.0f} s: this computer is not part of it, "
        "or busy. Run ray start --address=HOST:PORT here first, or run bam-train on one of its computers"
    )
