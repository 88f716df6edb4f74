"""Deadlines, the pacer and the ticking thread; clocks are the test's."""

import math
import threading

import pytest

from bam_envs.core.timing import Deadline, Lateness, Pacer, Ticker


class Clock:
    """A clock that only moves when somebody sleeps or works."""

    def __init__(self, start=100.0, overshoot=0.0):
        self.time, self.overshoot, self.slept = start, overshoot, []

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.time += seconds + self.overshoot

    def work(self, seconds):
        self.time += seconds


def paced(clock, period=0.125):
    pacer = Pacer(period, now=clock.now, sleep=clock.sleep)
    pacer.start()
    return pacer


def starts(clock, pacer, works):
    """When each tick started, relative to the first, if tick i works for works[i] seconds."""
    times = []
    for work in works:
        pacer.wait()
        times.append(clock.time - 100.0)
        clock.work(work)
    return times


def test_deadlines_are_absolute():
    clock = Clock()
    pacer = paced(clock)
    assert starts(clock, pacer, [0.0625, 0.03125, 0.125, 0.0]) == [0.0, 0.125, 0.25, 0.375]
    assert clock.slept == [0.0625, 0.09375]
    assert pacer.lateness == Lateness(0.0, 0.0, 0.0)
    assert (pacer.ticks, pacer.missed, pacer.rate) == (4, 0, 8.0)


def test_a_wait_that_is_ended_early_begins_the_tick_and_a_new_grid():
    clock = Clock()
    pacer = Pacer(0.125, now=clock.now, sleep=lambda seconds: clock.sleep(0.03125) or True)
    pacer.start()
    assert starts(clock, pacer, [0.0, 0.0, 0.0]) == [0.0, 0.03125, 0.0625]
    assert pacer.slack == 0.125


def test_a_tick_that_is_hastened_is_due_half_a_period_after_the_last():
    clock = Clock()
    pacer = paced(clock)
    pacer.wait()
    pacer.hasten()
    assert pacer.slack == 0.0625
    pacer.wait()
    assert pacer.slack == 0.125
    clock.work(0.1)
    pacer.hasten()  # it is due already
    assert pacer.wait() == pytest.approx(0.0375)


def test_a_deadline_that_passes_while_it_is_looked_at_is_not_slept_for():
    clock, times = Clock(), iter([100.0, 100.0, 100.1249, 100.1251, 100.1252, 100.1253])
    pacer = Pacer(0.125, now=lambda: next(times), sleep=clock.sleep)  # time.sleep refuses negative times
    pacer.start()
    pacer.tick()
    assert pacer.wait() == pytest.approx(0.0002)
    assert clock.slept == [pytest.approx(0.0001)]


def test_late_sleeps_do_not_add_up():
    clock = Clock(overshoot=0.001)
    pacer = paced(clock)
    assert starts(clock, pacer, [0.0] * 4) == pytest.approx([0.0, 0.126, 0.251, 0.376])
    assert pacer.lateness.max == pytest.approx(0.001)
    assert pacer.missed == 0


@pytest.mark.parametrize(
    ("work", "expected", "missed", "closest"),
    [
        (0.1289, [0.0, 0.1289, 0.25, 0.375], 0, 0.96),  # little late: the next is on the grid again
        (0.15625, [0.0, 0.15625, 0.27625, 0.40125], 0, 0.96),  # a quarter late: the next comes 0.96 of a period later
        (0.1875, [0.0, 0.1875, 0.3075, 0.4325], 0, 0.96),
        (0.1875, [0.0, 0.1875, 0.25, 0.375], 0, 0.5),  # half a period late: a clock is on the grid again
        (0.21875, [0.0, 0.21875, 0.34375, 0.46875], 1, 0.96),  # three quarters late: one was missed
        (0.5, [0.0, 0.5, 0.625, 0.75], 3, 0.96),  # a long stall: no burst afterwards
        (1.0625, [0.0, 1.0625, 1.1875, 1.3125], 7, 0.5),
    ],
)
def test_no_burst_after_a_late_tick(work, expected, missed, closest):
    clock = Clock()
    pacer = Pacer(0.125, now=clock.now, sleep=clock.sleep, closest=closest)
    pacer.start()
    assert starts(clock, pacer, [work, 0.0, 0.0, 0.0]) == pytest.approx(expected)
    assert pacer.missed == missed
    assert pacer.lateness.max == pytest.approx(work - 0.125)


def test_lateness_percentiles():
    clock = Clock()
    pacer = paced(clock)
    starts(clock, pacer, [0.0] * 100 + [0.15625, 0.0])
    assert pacer.lateness.p50 == 0.0
    assert pacer.lateness.max == 0.03125
    assert 0.0 <= pacer.lateness.p99 < 0.03125


def test_each_episode_has_its_own_grid_and_pauses_do_not_count():
    clock = Clock()
    pacer = paced(clock)
    starts(clock, pacer, [0.0, 0.0])
    clock.work(7.03)  # the robot goes back to its start
    pacer.start()
    before = clock.time
    pacer.wait()
    assert clock.time == before
    pacer.wait()
    assert clock.time == before + 0.125
    assert pacer.rate == pytest.approx(8.0)
    assert pacer.missed == 0


def test_running_free_never_waits_and_is_never_late():
    clock = Clock()
    pacer = paced(clock, period=None)
    assert starts(clock, pacer, [0.25, 0.25, 0.25]) == [0.0, 0.25, 0.5]
    assert clock.slept == []
    assert (pacer.lateness, pacer.missed, pacer.rate, pacer.slack) == (None, 0, 4.0, math.inf)


def test_slack_is_the_time_to_the_next_deadline():
    clock = Clock()
    pacer = paced(clock)
    pacer.wait()
    clock.work(0.03125)
    assert pacer.slack == 0.09375


def test_nothing_is_known_before_the_first_tick():
    pacer = paced(Clock())
    assert (pacer.rate, pacer.lateness, pacer.ticks) == (None, None, 0)


def test_ticks_without_waiting():
    """Whoever waits elsewhere asks for the slack, and says when a tick starts."""
    clock = Clock()
    pacer = Pacer(0.125, now=clock.now)
    clock.work(3.0)
    assert (pacer.slack, pacer.tick()) == (0.0, 0.0)  # not started: the first tick is due when it comes
    assert pacer.slack == 0.125
    clock.work(0.03125)
    pacer.tick()  # more than half a period early
    assert pacer.slack == 0.125
    clock.work(0.09375)
    pacer.tick()  # a quarter early: the grid stays
    assert (pacer.slack, pacer.missed) == (0.15625, 0)


def test_a_deadline():
    clock = Clock()
    deadline = Deadline(0.5, clock.now)
    clock.work(0.25)
    assert (deadline.left, deadline.passed) == (0.25, False)
    clock.work(0.5)
    assert (deadline.left, deadline.passed) == (0.0, True)


def test_a_ticker_ticks_until_it_is_stopped():
    ticks = threading.Semaphore(0)
    ticker = Ticker(ticks.release, 0.001)
    assert not ticker.running
    ticker.start()
    assert all(ticks.acquire(timeout=10) for _ in range(5))
    assert ticker.running
    ticker.stop()
    ticker.stop()
    assert not ticker.running


def test_a_ticker_can_be_woken():
    ticks = threading.Semaphore(0)
    ticker = Ticker(ticks.release, 3600.0)
    ticker.start()
    assert ticks.acquire(timeout=10)
    ticker.wake()
    assert ticks.acquire(timeout=10)
    ticker.stop()


def test_a_ticker_can_be_stopped_from_within_and_before_it_starts():
    done = threading.Event()

    def tick():
        ticker.stop()
        done.set()

    ticker = Ticker(tick, 0.001)
    ticker.stop()
    ticker = Ticker(tick, 0.001)
    ticker.start()
    assert done.wait(10)
    ticker.stop()
    assert not ticker.running
