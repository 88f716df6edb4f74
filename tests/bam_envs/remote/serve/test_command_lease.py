"""One client in command at a time."""

import pytest

from bam_envs.core.errors import NotInCommand
from bam_envs.remote.serve.command_lease import CommandLease
from tests.raising import raising


@pytest.fixture
def now():
    return [100.0]


@pytest.fixture
def lease(now):
    return CommandLease(5.0, clock=lambda: now[0])


def test_the_first_to_ask_has_it_until_it_leaves_however_silent_it_is(lease, now):
    text = "Nobody is in command, ann neither; reset() takes command."
    with raising(NotInCommand, text):
        lease.require("ann")
    with raising(NotInCommand, text), lease.busy("ann"):
        pass
    assert [lease.take("ann"), lease.take("ann")] == [True, False]
    now[0] += 1000
    lease.require("ann")
    assert lease.holder == "ann"
    assert [lease.release("bob"), lease.release("ann"), lease.take("bob")] == [False, True, True]


@pytest.mark.parametrize(("silence", "passes"), [(5.0, False), (5.001, True)])
def test_it_passes_on_after_silence(lease, now, silence, passes):
    lease.take("ann")
    now[0] += 3
    lease.require("ann")
    now[0] += silence
    if passes:
        assert lease.take("bob") is True
    else:
        with pytest.raises(NotInCommand):
            lease.take("bob")


def test_a_long_request_is_not_silence(lease, now):
    lease.take("ann")
    with lease.busy("ann"), lease.busy("ann"):
        now[0] += 60
        with pytest.raises(NotInCommand):
            lease.take("bob")
    now[0] += 4
    with pytest.raises(NotInCommand):
        lease.take("bob")
    now[0] += 2
    lease.take("bob")


def test_it_can_be_taken_by_force_even_from_a_busy_client_and_lapse_then(lease, now):
    lease.take("ann")
    with lease.busy("ann"):
        assert lease.take("bob", force=True) is True
    now[0] += 6
    assert lease.take("ann") is True


def test_the_others_are_told_what_a_client_is_called_and_not_its_secret(lease):
    told = []
    lease.on_change(lambda before, after: told.append((before, after)))
    lease.take("session 4f1c", shown="10.0.0.2:51444")
    for refused in (lambda: lease.take("session 77aa", shown="10.0.0.3:1"), lambda: lease.require("10.0.0.3:1")):
        with raising(
            NotInCommand,
            "10.0.0.2:51444 is in command, not 10.0.0.3:1; it passes on when 10.0.0.2:51444 leaves or is silent for "
            "5 s.",
        ):
            refused()
    assert lease.holder == "session 4f1c"
    lease.release("session 4f1c")
    assert told == [(None, "10.0.0.2:51444"), ("10.0.0.2:51444", None)]


def test_changes_are_told(lease, now):
    told = []
    lease.on_change(lambda before, after: told.append((before, after)))
    lease.take("ann")
    lease.take("ann")
    now[0] += 6
    lease.take("bob")
    lease.take("ann", force=True)
    lease.release("ann")
    assert told == [(None, "ann"), ("ann", "bob"), ("bob", "ann"), ("ann", None)]
