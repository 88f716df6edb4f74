"""The address of a Ray cluster: what was typed, found and tried before Ray itself is let near it.

Ray tries a silent address for minutes and may end the whole process; so a socket, then another process, tries it first.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys

from bam_train.errors import SettingsError, TrainingFailed

SOCKET_TIMEOUT = 5.0
"""How long a host may take to accept a connection [s]."""

REACH_TIMEOUT = 13.0
"""How long the whole way into a cluster may take then [s]; about 2 s are usual."""

_AUTO = "auto"
_VARIABLE = "RAY_ADDRESS"
_STAGES = ("there", "known", "joined")

_PROBE = """
import logging, sys
import ray
from ray._raylet import GcsClient
print("there", flush=True)
GcsClient(address=sys.argv[1])
print("known", flush=True)
ray.init(address=sys.argv[1], log_to_driver=False, logging_level=logging.CRITICAL)
print("joined", flush=True)
ray.shutdown()
"""
"""Goes the whole way into a cluster, and says how far it came."""


def find(address: str) -> str:
    """The ``host:port`` of a cluster.

    Args:
        address: ``auto``, or ``host:port``; as Ray has it, RAY_ADDRESS is what ``auto`` means if it is set.

    Raises:
        SettingsError: It is no address of a cluster.
        TrainingFailed: ``auto``, and no cluster was started on this computer.
    """
    place, name = address, "address"
    if address == _AUTO and (said := os.environ.get(_VARIABLE)):
        place, name = said, _VARIABLE
    if place == _AUTO:
        place = _started_here()
    if place.startswith("ray://"):
        raise SettingsError(
            f"{name}: expected auto or host:port, such as 10.0.0.5:6379, found {place!r}, which is for Ray's client. "
            "Run bam-train on a computer of the cluster and give --address auto"
        )
    parts = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[^\s:/]+):(\d{1,5})", place)
    if parts is None or not 0 < int(parts[2]) < 2**16:
        raise SettingsError(f"{name}: expected auto or host:port, such as 10.0.0.5:6379, found {place!r}")
    return place


def _started_here() -> str:
    """Where ``ray start`` on this computer says the cluster is."""
    from ray._private.utils import read_ray_address

    found: str | None = read_ray_address()
    if not found:
        raise TrainingFailed(
            "no Ray cluster was started on this computer, so --address auto finds none. Start one with "
            "ray start --head, give --address host:port, or leave --address out"
        )
    return found


def reach(place: str) -> None:
    """Find out whether a run can join the cluster at ``host:port``, within 20 s.

    Raises:
        TrainingFailed: Nothing answers there, what answers is no cluster, or it does not let us in; says which.
    """
    _connect(place)
    came, said = _probe(place)
    if came == "joined":
        return
    raise TrainingFailed(f"{place}: {reason(came, said)}")


def _connect(place: str) -> None:
    host, _, port = place.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), SOCKET_TIMEOUT).close()
    except OSError as error:
        why = getattr(error, "strerror", None) or str(error)
        raise TrainingFailed(
            f"{place}: no Ray cluster answers there ({why}). Check --address, and that ray start --head runs there "
            "and no firewall is between"
        ) from error


def _probe(place: str) -> tuple[str, str]:
    """How far another process came on the way into the cluster, and what it said."""
    command = [sys.executable, "-c", _PROBE, place]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            said, _ = process.communicate(timeout=REACH_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            said, _ = process.communicate()
        except BaseException:
            process.kill()
            raise
    lines = said.splitlines()
    return next((stage for stage in reversed(_STAGES) if stage in lines), ""), said


def reason(came: str, said: str) -> str:
    """Why the way into a cluster ended, and what to do."""
    if re.search("InvalidAuthToken|AuthenticationError|authentication token", said):
        return (
            "the cluster does not accept the token, or none was given. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to "
            "what ray get-auth-token says on its head"
        )
    if "ersion mismatch" in said:
        return "the cluster runs another Python or Ray than this computer. Install the same versions everywhere"
    if came in ("", "there"):
        return "something answers there, but it is no Ray cluster. Check the port: that of ray start --head is 6379"
    return (
        f"the cluster is there, but could not be joined within {REACH_TIMEOUT:.0f} s: this computer is not part of it, "
        "or busy. Run ray start --address=HOST:PORT here first, or run bam-train on one of its computers"
    )
