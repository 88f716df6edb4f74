import pytest

from bam_envs.bridge.bus import UNKNOWN_CALLER, Caller
from bam_envs.errors import RemoteError
from bam_envs.serve.clients import Clients, shown

A, B = Caller("client1", "127.0.0.1:1"), Caller("client2")


def test_names():
    clients = Clients()
    assert clients.name(A, None) == "127.0.0.1:1"
    assert clients.name(B, None) == "client2"
    assert clients.name(A, "4f1c") == "session 4f1c"
    assert clients.name(UNKNOWN_CALLER, "4f1c") == "session 4f1c"
    assert clients.name(UNKNOWN_CALLER, None) == "a sender without a name"


def test_what_others_are_told_is_no_session():
    assert shown(A, "4f1c") == shown(A, None) == "127.0.0.1:1"
    assert shown(B, "4f1c") == "client2"
    assert shown(UNKNOWN_CALLER, None) == "a sender without a name"
    assert shown(UNKNOWN_CALLER, "4f1c") == "a sender without a name (#cfb7ec)"
    assert shown(UNKNOWN_CALLER, "4f1d") != shown(UNKNOWN_CALLER, "4f1c")


def test_a_client_has_left_with_its_last_connection():
    clients = Clients()
    clients.name(A, "4f1c")
    clients.name(B, "4f1c")
    clients.name(B, None)
    assert clients.left(B) == ["client2"]
    assert clients.left(A) == ["session 4f1c"]
    assert clients.left(A) == []


def test_a_connection_has_so_many_sessions():
    clients = Clients()
    for number in range(64):
        clients.name(A, str(number))
    with pytest.raises(RemoteError) as error:
        clients.name(A, "64")
    assert str(error.value) == "One connection may send for at most 64 sessions; open another one."
    assert clients.name(A, "0") == "session 0"
    assert clients.name(B, "64") == "session 64"
    assert len(clients.left(A)) == 64
    assert clients.name(A, "64") == "session 64"


def test_who_has_no_name_never_leaves():
    clients = Clients()
    clients.name(UNKNOWN_CALLER, "4f1c")
    assert clients.left(UNKNOWN_CALLER) == []
