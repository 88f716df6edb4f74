"""One client in command at a time."""

import pytest

from bam_envs.core.errors import NotInCommand
from bam_envs.remote.serve.command_lease import CommandLease


@pytest.fixture
def now():
    return [100.0]


@pytest.fixture
def lease(now):
    return CommandLease(5.0, clock=lambda: now[0])


def test_the_first_to_ask_has_it(lease):
    assert lease.holder is None
    assert lease.take("ann") is True
    assert lease.take("ann") is False
    assert lease.holder == "ann"


def test_the_others_are_told_who(lease):
    lease.take("ann")
    for refused in (lease.take, lease.require):
        with pytest.raises(NotInCommand) as caught:
            refused("bob")
        assert str(caught.value) == ("ann is in command, not bob; it passes on when ann leaves or is silent for 5 s.")


def test_nobody_in_command_is_said_too(lease):
    with pytest.raises(NotInCommand) as caught:
        lease.require("ann")
    assert str(caught.value) == "Nobody is in command, ann neither; reset() takes command."


def test_it_passes_on_when_its_holder_leaves(lease):
    lease.take("ann")
    assert lease.release("bob") is False
    assert lease.release("ann") is True
    assert lease.take("bob") is True


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


def test_silence_alone_takes_nothing_away(lease, now):
    lease.take("ann")
    now[0] += 1000
    lease.require("ann")
    assert lease.holder == "ann"


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


def test_it_can_be_taken_by_force_even_from_a_busy_client(lease, now):
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
        with pytest.raises(NotInCommand) as caught:
            refused()
        assert str(caught.value) == (
            "10.0.0.2:51444 is in command, not 10.0.0.3:1; it passes on when 10.0.0.2:51444 leaves or is silent for "
            "5 s."
        )
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


def test_command_that_is_taken_during_a_request_can_lapse(now):
    lease = CommandLease(5.0, lambda: now[0])
    lease.take("ann")
    with lease.busy("ann"):
        lease.take("bob", force=True)
    now[0] += 6
    assert lease.take("ann") is True


def test_only_the_client_in_command_can_be_busy(lease):
    with pytest.raises(NotInCommand), lease.busy("ann"):
        pass
