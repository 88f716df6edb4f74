import threading

import pytest

from bam_envs.remote.serve.clock import Clock, Deadlines


class Hands:
    """A clock that is set by hand."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def hands():
    return Hands()


def test_ticks_are_on_a_grid_whatever_they_take(hands):
    deadlines = Deadlines(0.01, hands)
    assert deadlines.left() == 0.0
    for took in (0.002, 0.009, 0.0):
        deadlines.advance()
        hands.now += took
        hands.now += deadlines.left()
    assert hands.now == pytest.approx(100.03, abs=1e-12)
    assert deadlines.missed == 0


def test_what_is_missed_is_skipped_and_not_caught_up(hands):
    deadlines = Deadlines(0.01, hands)
    deadlines.advance()
    hands.now += 0.035
    assert deadlines.left() == 0.0
    deadlines.advance()
    assert deadlines.missed == 2
    assert deadlines.left() == pytest.approx(0.005)


def test_two_ticks_are_at_least_half_a_period_apart(hands):
    deadlines = Deadlines(0.01, hands)
    deadlines.advance()
    hands.now += 0.016
    deadlines.advance()
    assert deadlines.missed == 1
    assert deadlines.left() == pytest.approx(0.014)


def test_a_tick_that_ends_on_the_next_deadline_misses_none(hands):
    deadlines = Deadlines(0.01, hands)
    deadlines.advance()
    hands.now += 0.01
    deadlines.advance()
    assert deadlines.missed == 0
    assert deadlines.left() == pytest.approx(0.01)


def test_a_tick_out_of_turn_moves_no_deadline(hands):
    deadlines = Deadlines(0.01, hands)
    deadlines.advance()
    hands.now += 0.004
    deadlines.advance()
    assert deadlines.left() == pytest.approx(0.006)


def test_the_clock_ticks_until_it_is_stopped():
    ticks = threading.Semaphore(0)
    clock = Clock(ticks.release, 0.001)
    assert not clock.running
    clock.start()
    assert all(ticks.acquire(timeout=10) for _ in range(5))
    assert clock.running
    clock.stop()
    clock.stop()
    assert not clock.running


def test_it_can_be_woken():
    ticks = threading.Semaphore(0)
    clock = Clock(ticks.release, 3600.0)
    clock.start()
    assert ticks.acquire(timeout=10)
    clock.wake()
    assert ticks.acquire(timeout=10)
    clock.stop()


def test_it_can_be_stopped_from_within():
    done = threading.Event()

    def tick():
        clock.stop()
        done.set()

    clock = Clock(tick, 0.001)
    clock.start()
    assert done.wait(10)
    clock.stop()
    assert not clock.running


def test_a_clock_that_never_ran_can_be_stopped():
    Clock(lambda: None, 1.0).stop()
