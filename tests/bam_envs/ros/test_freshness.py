"""Old messages are refused, whatever kept them."""

import pytest

from bam_envs.core.errors import RemoteError
from bam_envs.ros.freshness import ClockOffset, FreshnessCheck, Tag, Tagger, read_echo, read_tag

OTHER = [
    "bam1 s=a e=1 q=2",
    "bam1 s=a e=x q=2 t=0 d=0",
    "bam1 s=a e=1 q=2 t=nan d=0",
    f"bam1 s={'a' * 256} e=1 q=2 t=0 d=0",
]


class Clock:
    def __init__(self, now=100.0):
        self.now = now

    def __call__(self):
        return self.now


def test_a_tag_travels_as_text():
    tag = Tag("4f1c", 2, 17, 1700000000.25, 1700000000.35)
    assert tag.to_text() == "bam1 s=4f1c e=2 q=17 t=1700000000.250000 d=1700000000.350000"
    assert read_tag(tag.to_text()) == tag
    assert read_tag(tag.to_text() + " seed=0") == tag


@pytest.mark.parametrize("text", ["", "base_link", None, 3, "bam1", *OTHER])
def test_other_text_is_no_tag(text):
    assert read_tag(text) is None


def test_an_echo_says_session_and_number_alone():
    tagger = Tagger(session="4f1c", key=b"secret")
    tag = tagger.next(2, 0.1)
    assert tag.echo == "bam1 s=4f1c q=1"
    assert read_echo(tag.echo) == ("4f1c", 1)
    assert read_tag(tag.echo) is None
    others = ["", None, "base_link", "bam1 s=4f1c", "bam1 q=1 s=4f1c", "bam1 s=4f1c q=x", "bam1 s=4f1c q=-1"]
    assert [read_echo(text) for text in (*others, tag.to_text(), tagger.sign(tag, "/go", b""))] == [None] * 9


def test_a_signature_is_of_the_tag_its_channel_and_its_content():
    tagger = Tagger(session="4f1c", key=b"secret")
    tag = tagger.next(1, 0.1)
    text = tagger.sign(tag, "/go", b"content")
    assert text == f"{tag.to_text()} m={read_tag(text).mac}"
    assert len({tagger.sign(*one) for one in ((tag, "/go", b""), (tag, "/to", b"content"), (tag, "/go", b"c"))}) == 3
    assert Tagger(session="4f1c").sign(tag, "/go", b"content") == tag.to_text()


def test_a_tagger_counts_and_says_when():
    clock = Clock()
    tagger = Tagger(clock)
    first = tagger.next(1, 0.1)
    clock.now += 5
    second = tagger.next(2, 0.5)
    assert (first.session, first.epoch, first.sequence, first.sent, first.deadline) == (
        tagger.session, 1, 1, 100.0, 100.1,
    )  # fmt: skip
    assert (second.epoch, second.sequence, second.sent, second.deadline) == (2, 2, 105.0, 105.5)
    assert Tagger().session != tagger.session


def test_the_quickest_message_was_instant():
    offset = ClockOffset(drift=0.0)
    assert offset.age(sent=10.0, arrived=1000.2) == 0.0
    assert offset.age(sent=11.0, arrived=1001.1) == pytest.approx(0.0)  # quicker: the offset follows
    assert offset.offset == pytest.approx(990.1)
    assert offset.age(sent=12.0, arrived=1002.6) == pytest.approx(0.5)


def test_a_drifting_clock_is_followed():
    offset = ClockOffset(drift=1e-3)
    offset.age(sent=0.0, arrived=0.0)
    assert offset.age(sent=100.0, arrived=100.1) == pytest.approx(0.0)


def checked(clock, *tags, channel="arm"):
    check = FreshnessCheck(clock)
    for tag in tags:
        check.require(tag, channel)
    return check


def test_newer_messages_pass():
    checked(Clock(), Tag("a", 1, 1, 0, 0.1), Tag("a", 1, 2, 0, 0.1), Tag("a", 2, 5, 0, 0.1), Tag("b", 1, 1, 50, 50.1))


def test_one_number_may_come_once_on_each_channel():
    check = checked(Clock(), Tag("a", 1, 1, 0, 0.1), channel="gripper")
    check.require(Tag("a", 1, 1, 0, 0.1), "arm")
    with pytest.raises(RemoteError, match=r"^old message: number 1 after number 1$"):
        check.require(Tag("a", 1, 1, 0, 0.1), "arm")


def test_what_was_sent_before_a_cut_is_refused_after_it():
    check = checked(Clock(), Tag("a", 1, 1, 0, 9), Tag("a", 2, 3, 0, 9))
    with pytest.raises(RemoteError, match=r"^old connection: epoch 1, and epoch 2 is there$"):
        check.require(Tag("a", 1, 4, 0, 9), "gripper")


def test_what_waited_too_long_is_refused():
    clock = Clock()
    check = checked(clock, Tag("a", 1, 1, 7.0, 7.1))
    clock.now += 1.0
    check.require(Tag("a", 1, 2, 8.0, 8.1), "arm")
    clock.now += 1.35
    with pytest.raises(RemoteError, match=r"^expired: 0\.250 s after its deadline$"):
        check.require(Tag("a", 1, 3, 9.0, 9.1), "arm")


def test_sessions_are_forgotten_in_the_end():
    check = FreshnessCheck(Clock())
    for k in range(3000):
        check.require(Tag(f"s{k}", 1, 1, 0, 1))
    with pytest.raises(RemoteError, match="old message"):
        check.require(Tag("s2999", 1, 1, 0, 1))
    check.require(Tag("s0", 1, 1, 0, 1))
