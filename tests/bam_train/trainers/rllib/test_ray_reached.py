"""Addresses of clusters: typed, found, silent, or somebody else's; no cluster is started."""

from __future__ import annotations

import socket

import pytest

pytest.importorskip("ray.rllib")

from bam_train.errors import SettingsError, TrainingFailed
from bam_train.trainers.rllib import ray_cluster
from bam_train.trainers.rllib.ray_cluster import find, reach, reason


@pytest.fixture
def started_here(monkeypatch, tmp_path):
    """What ``ray start`` on this computer wrote."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    (tmp_path / "ray").mkdir()
    (tmp_path / "ray" / "ray_current_cluster").write_text("10.0.0.5:6379\n")
    return tmp_path / "ray" / "ray_current_cluster"


@pytest.mark.parametrize("place", ["10.0.0.5:6379", "head.local:1234", "[::1]:6379"])
def test_an_address_is_taken_as_it_is(place):
    assert find(place) == place


def test_auto_is_the_cluster_of_this_computer_or_the_variables(started_here, monkeypatch):
    assert find("auto") == "10.0.0.5:6379"
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.6:6379")
    assert find("auto") == "10.0.0.6:6379"
    monkeypatch.setenv("RAY_ADDRESS", "auto")
    assert find("auto") == "10.0.0.5:6379"
    monkeypatch.setenv("RAY_ADDRESS", "local")
    with pytest.raises(SettingsError, match=r"^RAY_ADDRESS: expected auto or host:port, .* found 'local'$"):
        find("auto")
    assert find("10.0.0.7:6379") == "10.0.0.7:6379"


def test_auto_without_a_cluster(started_here):
    started_here.unlink()
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
    with pytest.raises(TrainingFailed) as caught:
        reach(place)
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


def test_a_listener_that_never_answers():
    with socket.create_server(("127.0.0.1", 0)) as server:
        place = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(TrainingFailed) as caught:
            reach(place, timeout=0.5)
    assert str(caught.value) == (
        f"{place}: what answers there could not be joined within 13 s: it is not a Ray cluster (whose port is 6379 by "
        "default), or this computer is not part of the cluster, or busy. Run ray start --address=HOST:PORT here first, "
        "or run bam-train on one of its computers"
    )
    assert ray_cluster.SOCKET_TIMEOUT + ray_cluster.REACH_TIMEOUT <= 18.0  # of the 20 s that are promised


@pytest.mark.parametrize(
    ("said", "start"),
    [
        ("", "what answers there could not be joined within 13 s: "),
        ("RuntimeError: Version mismatch: The cluster was started with: Ray: 2.50", "the cluster runs another"),
        ("AuthenticationError: RPC error: InvalidAuthToken", "the cluster does not accept the token"),
    ],
)
def test_reasons(said, start):
    assert reason(said).startswith(start)
