"""Sessions: opened by a call, used by who opened them alone."""

import hmac
import json

import pytest

from bam_envs.core.errors import ProtocolError, RemoteError
from bam_envs.ros.freshness import Tagger, read_tag
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Caller
from bam_envs.rosbridge.sessions import Sessions, read_session

A, B = Caller("client1", "127.0.0.1:1"), Caller("client2", "127.0.0.1:2")


def opened(sessions, caller=A):
    return read_session(sessions.open({}, caller), "/bam/session")


def say(sessions, tagger, caller=A, content=b"1.0", **options):
    """A signed message; the refusal, or None."""
    tag = read_tag(tagger.sign(tagger.next(1, 0.1), "/go", content))
    try:
        sessions.prove(tag, "/go", content, caller, **options).require(tag, "/go")
    except RemoteError as error:
        return str(error)
    return None


def test_a_session_is_of_the_connection_that_opened_it():
    sessions = Sessions()
    tagger, other = opened(sessions), json.loads(sessions.open({}, B)["message"])
    assert (len(bytes.fromhex(other["key"])), other["session"] != tagger.session) == (32, True)
    assert say(sessions, tagger) is None
    assert say(sessions, tagger, B) == f"session {tagger.session} is of another connection"
    assert say(sessions, tagger, B, anywhere=True) is None
    assert sessions.left(B) == [other["session"]]
    assert sessions.left(A) == [tagger.session]
    assert "is not open here" in say(sessions, tagger)


def test_a_wrong_key_is_noticed_and_changes_nothing():
    sessions = Sessions()
    tagger = opened(sessions, UNKNOWN_CALLER)
    forger = Tagger(session=tagger.session, key=bytes(32))
    for _ in range(5):
        forger.next(1, 0.1)
    text = f"session {tagger.session}: the signature of a message on /go is wrong"
    assert say(sessions, forger, UNKNOWN_CALLER) == text
    assert say(sessions, tagger, UNKNOWN_CALLER) is None  # its number is not old


def test_the_text_of_a_tag_is_signed_as_its_sender_writes_numbers():
    sessions = Sessions()
    said = json.loads(sessions.open({}, A)["message"])
    text = f"bam1 s={said['session']} e=1 q=1 t=12.5 d=13"
    mac = hmac.digest(bytes.fromhex(said["key"]), f"{text}\n/go\n1.0".encode(), "sha256")[:16].hex()
    tag = read_tag(f"{text} m={mac}")
    sessions.prove(tag, "/go", b"1.0", A).require(tag, "/go")


def test_many_new_sessions_take_the_place_of_old_ones_but_not_of_who_drives():
    driving = set()
    sessions = Sessions(driving.__contains__)
    first, second, other = opened(sessions), opened(sessions), opened(sessions, B)
    driving.add(first.session)
    for _ in range(64):
        opened(sessions)
    assert say(sessions, first) is None
    assert say(sessions, other, B) is None
    assert say(sessions, second) == (
        f"session {second.session} is not open here: reset(), which opens one at /bam/session; "
        "both sides must be of one version of bam-train"
    )


@pytest.mark.parametrize(
    "message", [None, 3, "", "{}", "[]", '{"session": "a b", "key": "00"}', '{"session": "a", "key": "0011"}']
)
def test_what_is_no_session(message):
    with pytest.raises(ProtocolError) as caught:
        read_session({"success": True, "message": message}, "/bam/session")
    assert str(caught.value) == "/bam/session: expected a session and its key, found something else."
