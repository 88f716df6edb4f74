"""Late ticks: those of the policy, and those of a busy computer."""

import pytest

from bam_envs.core.timing import TickTimes

IN_TIME = (0.0001, 0, 0.0003, 0.00002)
BUSY = (0.060, 1, 0.0003, 0.00002)  # it was not woken in time
PREEMPTED = (0.030, 1, 0.0803, 0.00002)  # others had the CPU while it acted
SLOW = (0.030, 1, 0.075, 0.020)  # it needs 20 ms, for which it got the CPU within 75 ms
BOTH = (0.090, 1, 0.030, 0.020)  # it needs 20 ms, and would have been late without them too
SLOW_IN_TIME = (0.0, 0, 0.030, 0.020)


def times(*ticks):
    times = TickTimes(0.05)
    return times, [times.add(*tick) for tick in ticks]


@pytest.mark.parametrize(
    ("tick", "is_slow"),
    [(IN_TIME, False), (BUSY, False), (PREEMPTED, False), (SLOW, True), (BOTH, False), (SLOW_IN_TIME, False)],
)
def test_a_late_tick_is_the_policys_only_if_its_action_made_it_late(tick, is_slow):
    assert times(tick)[1] == [is_slow]


def test_without_deadlines_nothing_is_late():
    free = TickTimes(None)
    assert (free.add(*SLOW), free.excuse(by_time=True), free.computed) == (False, "", 0.0)


@pytest.mark.parametrize(
    ("ticks", "warning"),
    [
        ([BUSY] * 5 + [IN_TIME] * 95, ""),
        ([BUSY] * 99, ""),
        ([BUSY] * 6 + [IN_TIME] * 94, "6 {}, 0 of them because of the policy: end other programs"),
        ([SLOW] * 4 + [BUSY] * 3 + [IN_TIME] * 93, "7 {}, 4 of them because of the policy: use a faster policy"),
        ([SLOW] * 6 + [BUSY] * 5 + [IN_TIME] * 94, "6 {}, 1 of them because of the policy: end other programs"),
        ([BUSY] * 6 + [IN_TIME] * 100, ""),
    ],
)
def test_too_many_late_ticks_are_a_warning(ticks, warning):
    assert times(*ticks)[0].warning == warning.format("of the last 100 ticks missed their deadline")


LIGHT = "an action needs 0.02 ms of the CPU, and the period is 50 ms"


@pytest.mark.parametrize(
    ("ticks", "by_time", "excuse"),
    [
        ([IN_TIME] * 20, False, ""),
        ([IN_TIME] * 20, True, f"{LIGHT}: the computer or the link was late"),
        ([*[IN_TIME] * 19, BUSY], False, ""),
        (
            [*[IN_TIME] * 18, BUSY, PREEMPTED],
            False,
            f"2 of the last 20 ticks were disturbed, and {LIGHT}: the computer is busy",
        ),
        ([BUSY, BUSY, *[IN_TIME] * 20], False, ""),
        ([*[SLOW] * 15, BUSY, BUSY], True, ""),
        ([*[SLOW_IN_TIME] * 15, *[BOTH] * 5], False, ""),
    ],
    ids=["calm", "time", "once", "busy", "long ago", "slow", "slow and busy"],
)
def test_a_stop_is_the_computers_only_if_the_policy_is_light_and_the_computer_was_busy(ticks, by_time, excuse):
    assert times(*ticks)[0].excuse(by_time=by_time) == excuse
