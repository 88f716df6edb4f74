"""The places of a server's clients: which are kept for whom, and who gives way."""

from types import SimpleNamespace

import pytest

from bam_envs.rosbridge.tokens import places, who_leaves

EVERY = ("watch", "drive", "administer")


@pytest.mark.parametrize(
    ("most", "known", "expected"),
    [
        (64, EVERY, (32, 48, 64)),
        (64, ("watch", "administer"), (48, 48, 64)),
        (64, ("administer",), (48, 48, 64)),
        (256, (), (256, 256, 256)),
        (2, EVERY, (2, 2, 2)),
    ],
)
def test_a_quarter_is_kept_for_each_higher_role_that_there_is(most, known, expected):
    assert tuple(places(most, role, known) for role in EVERY) == expected


def client(host, spoke=1.0, role="drive", born=0.0):
    return SimpleNamespace(host=host, spoke=spoke, role=role, born=born)


def test_who_never_said_anything_leaves_first_the_oldest_of_the_most():
    talkers = [client("10.0.0.1", spoke=5.0 + k) for k in range(6)]
    silent = [client("10.0.0.2", 0.0, born=2.0), client("10.0.0.3", 0.0, born=4.0), client("10.0.0.3", 0.0, born=3.0)]
    assert who_leaves(client("10.0.0.1"), [*talkers, *silent]) is silent[2]
    assert who_leaves(client("10.0.0.3"), [*talkers, silent[0]]) is silent[0]


def test_an_address_with_two_more_gives_up_the_one_that_was_silent_for_longest():
    many = [client("10.0.0.1", spoke) for spoke in (8.0, 7.0, 9.0)]
    assert who_leaves(client("10.0.0.2"), many) is many[1]
    assert who_leaves(client("10.0.0.2"), [*many, client("10.0.0.2")]) is many[1]
    assert who_leaves(client("10.0.0.2"), [*many, client("10.0.0.2"), client("10.0.0.2")]) is None
    assert who_leaves(client("10.0.0.1"), many) is None


def test_the_addresses_of_one_ipv6_network_are_one():
    many = [client(f"2001:db8::{k}", 1.0 + k) for k in range(3)]
    assert who_leaves(client("2001:db8::9"), many) is None
    assert who_leaves(client("2001:db8:1::9"), many) is many[0]


def test_nobody_leaves_for_a_lower_role():
    present = [
        client("10.0.0.1", 0.0, "administer"),
        client("10.0.0.1", 0.0, "drive"),
        client("10.0.0.1", 1.0, "watch"),
    ]
    assert who_leaves(client("10.0.0.2", role="watch"), [*present, client("10.0.0.1", 2.0, "watch")]) is present[2]
    assert who_leaves(client("10.0.0.2", role="watch"), present) is None
    assert who_leaves(client("10.0.0.2", role="administer"), present) is present[0]
    assert who_leaves(client("10.0.0.2"), []) is None
