import pytest

from bam_envs.rosbridge.server.client_session import Packet
from bam_envs.rosbridge.server.server_connection import Outbox


def packet(name, stream=None, size=1):
    return Packet((name.encode().ljust(size),), text=True, stream=stream)


def drain(outbox):
    return [outbox.pop().frames[0].strip().decode() for _ in range(len(outbox))]


@pytest.fixture
def outbox():
    return Outbox(10, 3)


def test_what_waits_stays_in_order(outbox):
    for name, stream in [("a", None), ("b", "/t"), ("c", "/u")]:
        assert outbox.add(packet(name, stream))
    assert outbox.size == 3
    assert drain(outbox) == ["a", "b", "c"]
    assert outbox.size == 0


def test_a_topic_keeps_its_newest(outbox):
    for name in "abcd":
        outbox.add(packet(name, "/t"))
    outbox.add(packet("x", "/u"))
    assert drain(outbox) == ["b", "c", "d", "x"]


def test_a_client_may_want_fewer_to_wait_but_not_more(outbox):
    for name in "abcd":
        outbox.add(packet(name, "/t"), keep=1)
    assert drain(outbox) == ["d"]
    for name in "abcd":
        outbox.add(packet(name, "/t"), keep=99)
    assert drain(outbox) == ["b", "c", "d"]


def test_topics_give_way_to_what_must_arrive(outbox):
    for name in "ab":
        outbox.add(packet(name, f"/{name}", 5))
    assert outbox.add(packet("must", size=100))
    assert drain(outbox) == ["b", "must"]


def test_there_is_no_room_for_ever(outbox):
    assert outbox.add(packet("a", size=100))
    assert not outbox.add(packet("b"))
    assert outbox.add(packet("c", "/t"))
    assert drain(outbox) == ["a"]
