"""What is done before a program quits at once."""

import pytest

from bam_train.signals import at_quit, before_quitting


def test_the_latest_comes_first_and_only_within():
    called = []
    with at_quit(lambda: called.append("outer")), at_quit(lambda: called.append("inner")):
        before_quitting()
    assert called == ["inner", "outer"]
    before_quitting()
    assert len(called) == 2


def test_one_that_fails_holds_up_no_other():
    called = []

    def fail():
        raise OSError("the disk is gone")

    with at_quit(lambda: called.append("outer")), at_quit(fail):
        before_quitting()
    assert called == ["outer"]


def test_it_is_taken_away_after_an_error():
    called = []
    with pytest.raises(KeyboardInterrupt), at_quit(lambda: called.append("never")):
        raise KeyboardInterrupt
    before_quitting()
    assert called == []
