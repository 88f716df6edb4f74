"""The lease on the robot of a live agent: when it ends by itself."""

import math
from unittest import mock

import pytest

from bam_envs.core.errors import NotInCommand
from bam_envs.rosbridge.bus import Caller
from bam_train.agent.front.agent_lease import CUT_LINK_TIMEOUT, SILENT_LINK_TIMEOUT, AgentLease


@pytest.fixture
def lease():
    clock = mock.Mock(side_effect=lambda: clock.now, now=100.0)
    lease = AgentLease(30.0, clock)
    lease.clock, lease.heard = clock, 0.0
    lease.grant("a", Caller("client1", "10.0.0.7:1", silence=lambda: lease.heard), shown="anna")
    return lease


def test_without_use_it_ends(lease):
    lease.clock.now += 29.0
    lease.take("a")
    lease.clock.now += 30.0
    assert (lease.over(), lease.owner, lease.left) == (None, "anna", 0.0)
    lease.clock.now += 0.1
    assert lease.over() == ("a", "the lease of anna ended: it was not used for 30 s")


@pytest.mark.parametrize(
    ("silence", "is_silent"),
    [(0.0, False), (SILENT_LINK_TIMEOUT, False), (SILENT_LINK_TIMEOUT + 0.1, True), (math.inf, False)],
)
def test_an_owner_without_a_sign_of_life_is_silent(lease, silence, is_silent):
    lease.heard = silence
    assert lease.is_silent is is_silent
    lease.release("a")
    assert not lease.is_silent


def test_once_its_link_was_cut_it_ends_a_little_later(lease):
    lease.cut("a", "anna")
    lease.release("a")
    with pytest.raises(NotInCommand, match=r"^anna drives this robot; the lease ends 2\.0 s after its last use\."):
        lease.grant("b", Caller("client2"))
    assert lease.over() is None
    lease.clock.now += CUT_LINK_TIMEOUT
    assert lease.over() == ("a", "the lease of anna ended, 2 s after its link was cut")
    assert lease.grant("b", Caller("client2"), shown="bob")
    with pytest.raises(NotInCommand, match=r"bob drives this robot"):
        lease.take("a")
