from __future__ import annotations

import copy
import ctypes
import signal
import threading

import pytest

from bam_train.signals import (
    SignalMemory,
    Terminated,
    at_quit,
    before_quitting,
    handled,
    interrupt,
    reinstalled,
    waiting,
)


def test_each_signal_reaches_the_handler_and_afterwards_the_one_before():
    came, before = [], signal.getsignal(signal.SIGTERM)
    with handled(came.append):
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert came == [signal.SIGTERM, signal.SIGINT, signal.SIGINT]
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_signal_that_timeout_sends_twice_is_one_also_for_the_handler_around():
    outer, inner = [], []
    with handled(outer.append):
        with handled(inner.append):
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
    assert (outer, inner) == ([], [signal.SIGTERM])


def test_a_handler_that_foreign_code_has_reset_is_installed_again():
    came, ignore = [], 1
    with handled(came.append, [signal.SIGUSR1]):
        with reinstalled(signal.SIGUSR1):
            ctypes.CDLL(None).signal(signal.SIGUSR1, ignore)
            signal.raise_signal(signal.SIGUSR1)
        assert came == []
        signal.raise_signal(signal.SIGUSR1)
    assert came == [signal.SIGUSR1]


def test_what_is_ignored_stays_ignored_unless_it_is_asked_for():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    came = []
    try:
        with handled(came.append):
            signal.raise_signal(signal.SIGHUP)
        assert came == []
        with handled(came.append, ignored_too=True):
            signal.raise_signal(signal.SIGHUP)
        assert came == [signal.SIGHUP]
    finally:
        signal.signal(signal.SIGHUP, before)


def test_another_thread_handles_nothing():
    before, seen = signal.getsignal(signal.SIGINT), []

    def run():
        with handled(print):
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [before]


def test_signals_can_wait():
    done = []

    def run():
        with waiting():
            signal.raise_signal(signal.SIGINT)
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        run()
    assert done == [True]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_whose_exception_was_lost_is_raised_again(number):
    before = signal.getsignal(number)
    with SignalMemory() as signals:
        signals.raise_again()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
        with pytest.raises(KeyboardInterrupt) as caught:
            signals.raise_again()
    assert isinstance(caught.value, Terminated) == (number == signal.SIGTERM)
    assert signal.getsignal(number) is before


def test_an_interruption_can_travel():
    """Ray and concurrent.futures make exceptions anew out of their arguments."""
    with pytest.raises(Terminated) as caught:
        interrupt(signal.SIGTERM)
    assert copy.copy(caught.value).signal == signal.SIGTERM


def test_before_a_program_quits_at_once_the_latest_call_comes_first():
    """One that fails holds up no other, and all are gone after their block, also after an error."""
    called = []

    def fail():
        raise OSError("the disk is gone")

    with at_quit(lambda: called.append("outer")), at_quit(fail), at_quit(lambda: called.append("inner")):
        before_quitting()
    assert called == ["inner", "outer"]
    with pytest.raises(KeyboardInterrupt), at_quit(lambda: called.append("never")):
        raise KeyboardInterrupt
    before_quitting()
    assert len(called) == 2
