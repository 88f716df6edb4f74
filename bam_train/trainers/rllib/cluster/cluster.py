"""Ray for one training run: a quiet one of its own on this computer, or a cluster that is there already.

The own one listens on the loopback device only, asks for a token that nobody else has, keeps its files in a folder of
its own, and is gone when the run ends, however it ends. A cluster is joined and left as it was.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import logging
import os
import secrets
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray
import ray.rllib  # sets up its loggers

from bam_train.errors import TrainingFailed
from bam_train.settings import TrainSettings
from bam_train.trainers.quit_callbacks import at_quit
from bam_train.trainers.rllib.cluster.address import find, reach
from bam_train.trainers.rllib.cluster.descendants import Descendants
from bam_train.trainers.rllib.cluster.fault_tolerance import fault_tolerance
from bam_train.trainers.rllib.cluster.folder import own_folder
from bam_train.trainers.rllib.cluster.resources import cores, gpus, learners, require_resources

__all__ = ["cluster", "fault_tolerance", "gpus", "learners", "require_resources"]

OBJECT_STORE = 200 * 2**20
"""Memory that the own Ray shares samples and weights through [bytes]; they are a few megabytes."""

_TOKEN = secrets.token_hex(32)
_LOGGERS = ("ray", "ray.rllib", "ray.tune", "ray.train", "ray.data")
_MODE = "RAY_AUTH_MODE"
_TOKENS = ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


@contextlib.contextmanager
def cluster(settings: TrainSettings) -> Iterator[None]:
    """Ray for a run, within; one that runs in this process already is used, and left running.

    Args:
        settings: `address` is None for a Ray of the run's own, else ``auto`` or ``host:port`` of the cluster to join;
            runners, learners and GPUs say how much of it is asked for.

    Raises:
        SettingsError: More is asked for than there is, or the address cannot be one.
        TrainingFailed: Ray does not start, or the cluster does not answer or let us in; within 20 s.
    """
    with _quiet():
        if ray.is_initialized():
            require_resources(settings)
            yield
        elif settings.address is None:
            require_resources(settings)
            with _own(settings):
                yield
        else:
            with _joined(settings.address):
                require_resources(settings)
                yield


@contextlib.contextmanager
def _own(settings: TrainSettings) -> Iterator[None]:
    """A Ray of the run's own, on this computer alone."""
    descendants = Descendants()
    with own_folder() as folder, at_quit(lambda: _abandon(descendants, folder)), _private_token():
        try:
            _start(folder, gpus(settings))
            yield
        finally:
            with _undisturbed():
                descendants.watch()
                with contextlib.suppress(Exception):  # whatever it says about its end, nothing of it must be left
                    _shut_down(wait_for_processes=True)
                descendants.end()


def _abandon(descendants: Descendants, folder: Path) -> None:
    """What `_own` does at its end, without waiting for anything; two of Ray's processes would go on for a minute."""
    descendants.kill()
    shutil.rmtree(folder, ignore_errors=True)


def _start(folder: Path, num_gpus: int) -> None:
    try:
        with _starting(), loopback_only(), _out_of_the_group():
            ray.init(
                address="local",
                num_cpus=cores(),
                num_gpus=num_gpus,
                object_store_memory=OBJECT_STORE,
                include_dashboard=False,
                log_to_driver=False,
                configure_logging=False,
                _temp_dir=str(folder),
            )
    except Exception as error:  # Ray has no one error for what may go wrong with its processes
        why = str(error).strip().partition("\n")[0].rstrip(".")
        raise TrainingFailed(f"Ray does not start on this computer: {why}. Is there enough memory and disk?") from error


@contextlib.contextmanager
def _private_token() -> Iterator[None]:
    """A token of this process alone for the own Ray, instead of the one that Ray would write into the home folder."""
    if _MODE in os.environ or any(name in os.environ for name in _TOKENS):
        yield  # whoever set them knows
        return
    try:
        with _environment(**{_MODE: "token", _TOKENS[0]: _TOKEN}):
            _read_token_again()
            yield
    finally:
        _read_token_again()


def _read_token_again() -> None:
    """Ray reads mode and token once, when it is imported."""
    raylet: Any = importlib.import_module("ray._raylet")
    raylet.Config.initialize("")
    raylet.AuthenticationTokenLoader.instance().reset_cache()


@contextlib.contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Within, these environment variables are set so, for what is started too."""
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
    """Ray started within takes 127.0.0.1 for its computer's address, and then its servers bind to nothing else.

    `ray.init(_node_ip_address="127.0.0.1")` would not do: Ray puts an address that others can reach in its place, but
    where clusters are not enabled (the default on macOS and Windows, for the sake of their firewalls).
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
    """Ray started within has sessions of its own: what a whole process group is sent does not reach it.

    ``timeout``, systemd, batch systems and terminals send their signal to the group; Ray's processes would be gone
    before the update is finished and saved. They end with this process as before, as Linux kills them then. Elsewhere
    Ray itself kills the group for that, so they stay in it.
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


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Within, Ray and RLlib say nothing: `RunnerWatch` and the errors here say what the user needs to know."""
    from ray._private import worker

    loggers = [logging.getLogger(name) for name in _LOGGERS]
    before = [(logger, logger.handlers[:], logger.propagate) for logger in loggers]
    said = worker.print_to_stdstream
    worker.print_to_stdstream = _nothing  # prints dead processes on standard output, whatever `ray.init` is given
    _hush()
    try:
        yield
    finally:
        worker.print_to_stdstream = said
        for logger, handlers, propagate in before:
            logger.handlers[:], logger.propagate = handlers, propagate


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Around `ray.init`: its C++ part learns to be quiet, says so on standard error, and our signals stay ours."""
    with _own_signals(), _environment(RAY_BACKEND_LOG_LEVEL="fatal"):
        sys.stderr.flush()
        kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(nowhere)
            _hush()


def _hush() -> None:
    """Take their handlers from the loggers of Ray; `ray.init` does that too, and leaves none."""
    for name in _LOGGERS:
        logger = logging.getLogger(name)
        logger.handlers[:], logger.propagate = [logging.NullHandler()], False


def _nothing(*_: object, **__: object) -> None:
    return


@contextlib.contextmanager
def _own_signals() -> Iterator[None]:
    """Signals wait until the end, as Ray's C++ would abort; `ray.init` may not take SIGTERM, to exit with status 15."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    from ray._private import utils

    came: list[int] = []
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    heard = [number for number in numbers if signal.getsignal(number) is not None]
    before = [(number, signal.signal(number, lambda number, _: came.append(number))) for number in heard]
    rays, utils.set_sigterm_handler = utils.set_sigterm_handler, _nothing
    try:
        yield
    finally:
        utils.set_sigterm_handler = rays
        for number, handler in before:
            signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Another Ctrl-C waits until Ray is gone: half of it would be left. A handler that quits at once is let do so."""
    with _own_signals() if signal.getsignal(signal.SIGINT) is signal.default_int_handler else contextlib.nullcontext():
        yield


@contextlib.contextmanager
def _joined(address: str) -> Iterator[None]:
    """A cluster that is there already."""
    place = find(address)
    reach(place)
    try:
        with _starting():
            ray.init(address=place, log_to_driver=False, configure_logging=False)
        yield
    finally:
        _shut_down()


def _shut_down(**given: bool) -> None:
    """Ray's C++ leaves SIGTERM to kill the process, and Python does not know: a robot would no longer be halted."""
    from ray._private import worker

    node: Any = worker._global_node
    if node is not None:
        rays = node.kill_all_processes

        def kill_all(**how: bool) -> None:
            _hear_sigterm()
            rays(**how)

        node.kill_all_processes = kill_all  # comes after the C++, and takes seconds
    try:
        ray.shutdown(**given)
    finally:
        _hear_sigterm()


def _hear_sigterm() -> None:
    """The handler that Python knows of, again."""
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
