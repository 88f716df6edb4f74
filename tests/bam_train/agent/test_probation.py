"""Promotion and roll-back: the reasons, and how often a good policy is rolled back."""

import numpy as np
import pytest

from bam_train.agent.probation import Judgement, Probation, Shortfall
from bam_train.deploy.trials import ALPHA, Evidence
from bam_train.errors import SettingsError


def until_judged(rates, seed, **settings):
    """Number of the episode after which a policy with these success rates, one an episode, is rolled back, or None."""
    probation = Probation(**settings)
    for episode, success in enumerate(np.random.default_rng(seed).random(len(rates)) < rates, 1):
        if probation.ended(bool(success)) is not None:
            return episode
    return None


def test_enough_trials_promote():
    probation = Probation()
    for trials in range(1, 33):
        assert probation.ended(True, trials=Evidence(trials, trials, 0.9)) is None
    text = "33 of 33 trials succeeded, which shows more than 90 % (error probability at most 5 %)"
    assert probation.ended(True, trials=Evidence(33, 33, 0.9)) == Judgement("promote", text)
    for judged in (None, "roll back"):  # which precedes a promotion
        trials = Evidence(100, 100, 0.9) if judged else None
        end = probation.ended(True, stopped_by="tool speed (G8)", trials=trials)
        assert (end and end.decision) == judged


def test_stops_are_counted_among_the_last_episodes():
    probation = Probation()
    assert [probation.ended(None, stopped_by="joint speed (G7)"), probation.ended(None)] == [None, None]
    reason = "guards stopped it 2 times in the last 3 episodes, the last was tool speed (G8)"
    assert probation.ended(None, stopped_by="tool speed (G8)") == Judgement("roll back", reason)
    probation = Probation(guard_stops=3, window=10)
    ends = [probation.ended(None, stopped_by="tilt (G9)" if k % 5 == 0 else "") for k in range(100)]
    assert set(ends) == {None}
    probation.ended(None, stopped_by="tilt (G9)")
    reason = "guards stopped it 3 times in the last 7 episodes, the last was tilt (G9)"
    assert probation.ended(None, stopped_by="tilt (G9)") == Judgement("roll back", reason)


def test_late_ticks_roll_back_few_do_not_and_old_ones_are_forgotten():
    probation = Probation()
    assert probation.ended(True, slow=50, ticks=99) is None  # too few to tell
    reason = "its actions took so long that 57 of 300 ticks were late, and at most 5 % may be"
    assert probation.ended(True, slow=7, ticks=201) == Judgement("roll back", reason)
    probation = Probation()
    assert {probation.ended(True, slow=5, ticks=100) for _ in range(30)} == {None}
    assert probation.ended(True, slow=6, ticks=100).decision == "roll back"
    probation = Probation()
    assert probation.ended(True, slow=99, ticks=99) is None
    assert {probation.ended(True) for _ in range(19)} == {None}
    assert probation.ended(True, slow=5, ticks=100) is None


def test_a_fault_of_the_policy_rolls_back():
    reason = "a fault of the policy: action: expected shape (4,), found (3,)"
    assert Probation().failed("action: expected shape (4,),\n found (3,)") == Judgement("roll back", reason)


def test_failures_roll_back_with_the_counts():
    probation = Probation()
    assert [probation.ended(False) for _ in range(2)] == [None, None]
    reason = "0 of 3 episodes succeeded, which shows less than 90 % (error probability at most 5 %)"
    assert probation.ended(False) == Judgement("roll back", reason)


def test_earlier_successes_do_not_protect_a_policy_that_became_worse():
    probation = Probation()
    assert {probation.ended(True) for _ in range(10_000)} == {None}
    judged = [probation.ended(False) for _ in range(12)]
    assert judged[:-1] == [None] * 11
    assert judged[-1].reason == (
        "10000 of 10012 episodes succeeded, 8 of the last 20, "
        "which shows less than 90 % (error probability at most 5 %)"
    )


# The test


@pytest.mark.parametrize("bound", [0.5, 0.9, 0.99])
def test_the_evidence_is_a_martingale_at_the_bound_and_falls_above_it(bound):
    for history in ([], [True], [False], [False, True, True, False]):
        now = [Shortfall(bound) for _ in range(3)]
        for one in now:
            for success in history:
                one.add(success)
        before = now[0].value
        now[1].add(True)
        now[2].add(False)
        assert bound * now[1].value + (1 - bound) * now[2].value == pytest.approx(before, rel=1e-12)
        higher = (1 + bound) / 2
        assert higher * now[1].value + (1 - higher) * now[2].value < before


def test_a_policy_is_seldom_rolled_back_wrongly_and_a_bad_one_soon():
    """400 policies of each kind, 300 episodes."""
    failing = Shortfall(0.9)
    for _ in range(10_000):
        failing.add(False)
    assert (bool(np.isfinite(failing.value)), failing.is_enough) == (True, True)

    def rolled_back(*rates):
        found = [until_judged(np.repeat(rates, 300 // len(rates)), seed) for seed in range(400)]
        return [episode for episode in found if episode is not None]

    assert len(rolled_back(0.9)) / 400 <= ALPHA
    assert len(rolled_back(0.95)) / 400 <= 0.01
    assert len(rolled_back(0.6)) == 400
    assert np.median(rolled_back(0.6)) <= 15
    broken = [episode - 150 for episode in rolled_back(0.97, 0.5)]
    assert len(broken) >= 396
    assert np.median(broken) <= 25


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"bound": 1.0}, "the success rate for a roll-back must be between 0 and 1, found 1"),
        (
            {"guard_stops": 0},
            "the number of stops by guards .* must be from 1 to that of the episodes, found 0 and 100",
        ),
        ({"guard_stops": 5, "window": 4}, "found 5 and 4"),
    ],
)
def test_settings_out_of_range_are_refused(settings, text):
    with pytest.raises(SettingsError, match=text):
        Probation(**settings)
