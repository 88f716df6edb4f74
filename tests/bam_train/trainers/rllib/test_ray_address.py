"""Addresses of clusters: typed, found, silent, or somebody else's."""

from __future__ import annotations

import socket
import time

import pytest

pytest.importorskip("ray.rllib")

from ray._private import utils as ray_utils

from bam_train.errors import SettingsError, TrainingFailed
from bam_train.trainers.rllib import ray_address as address
from bam_train.trainers.rllib.ray_address import find, reach


@pytest.fixture
def listener():
    """Accepts connections, and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture(autouse=True)
def no_variable(monkeypatch):
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


@pytest.mark.parametrize("place", ["10.0.0.5:6379", "head.local:1234", "[::1]:6379"])
def test_an_address_is_taken_as_it_is(place):
    assert find(place) == place


def test_auto_is_the_cluster_of_this_computer(monkeypatch):
    monkeypatch.setattr(ray_utils, "read_ray_address", lambda: "10.0.0.5:6379")
    assert find("auto") == "10.0.0.5:6379"
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.6:6379")
    assert find("auto") == "10.0.0.6:6379"


def test_what_the_variable_says_may_be_auto_too_and_is_named_if_it_is_wrong(monkeypatch):
    monkeypatch.setattr("ray._private.utils.read_ray_address", lambda: "10.0.0.6:6380")
    monkeypatch.setenv("RAY_ADDRESS", "auto")
    assert find("auto") == "10.0.0.6:6380"
    monkeypatch.setenv("RAY_ADDRESS", "local")
    with pytest.raises(SettingsError, match=r"^RAY_ADDRESS: expected auto or host:port, .* found 'local'$"):
        find("auto")
    assert find("10.0.0.5:6379") == "10.0.0.5:6379"


def test_auto_without_a_cluster(monkeypatch):
    monkeypatch.setattr(ray_utils, "read_ray_address", lambda: None)
    with pytest.raises(TrainingFailed) as caught:
        find("auto")
    assert str(caught.value) == (
        "no Ray cluster was started on this computer, so --address auto finds none. Start one with ray start --head, "
        "give --address host:port, or leave --address out"
    )


@pytest.mark.parametrize(
    "place", ["6379", "head", "head:", "http://head:6379", "head:port", "", "a b:1", "head:0", "head:65536"]
)
def test_what_is_no_address(place):
    with pytest.raises(SettingsError) as caught:
        find(place)
    assert str(caught.value) == f"address: expected auto or host:port, such as 10.0.0.5:6379, found {place!r}"


def test_an_address_for_rays_client():
    with pytest.raises(SettingsError, match=r"found 'ray://head:10001', which is for Ray's client\. Run bam-train on"):
        find("ray://head:10001")


def test_nobody_listens():
    with socket.create_server(("127.0.0.1", 0)) as server:
        place = f"127.0.0.1:{server.getsockname()[1]}"
    before = time.monotonic()
    with pytest.raises(TrainingFailed) as caught:
        reach(place)
    assert time.monotonic() - before < 5.0
    assert str(caught.value) == (
        f"{place}: no Ray cluster answers there (Connection refused). Check --address, and that ray start --head runs "
        "there and no firewall is between"
    )


def test_a_host_that_swallows_everything(monkeypatch):
    def silence(target, timeout):
        assert (target, timeout) == (("::1", 6379), 5.0)
        raise TimeoutError("timed out")

    monkeypatch.setattr(socket, "create_connection", silence)
    with pytest.raises(TrainingFailed, match=r"^\[::1\]:6379: no Ray cluster answers there \(timed out\)"):
        reach("[::1]:6379")


def test_a_listener_that_says_nothing(listener, monkeypatch):
    monkeypatch.setattr(address, "REACH_TIMEOUT", 2.0)
    before = time.monotonic()
    with pytest.raises(TrainingFailed) as caught:
        reach(listener)
    assert time.monotonic() - before < 10.0
    assert str(caught.value) == (
        f"{listener}: something answers there, but it is no Ray cluster. "
        "Check the port: that of ray start --head is 6379"
    )


def test_it_all_takes_less_than_twenty_seconds():
    assert address.SOCKET_TIMEOUT + address.REACH_TIMEOUT <= 18.0


@pytest.mark.parametrize(
    ("came", "said", "start"),
    [
        ("known", "", "the cluster is there, but could not be joined within 13 s: this computer is not part of it"),
        (
            "there",
            "RuntimeError: Version mismatch: The cluster was started with: Ray: 2.50",
            "the cluster runs another",
        ),
        ("there", "AuthenticationError: RPC error: InvalidAuthToken", "the cluster does not accept the token"),
    ],
)
def test_reasons(came, said, start):
    assert address.reason(came, said).startswith(start)
