"""Compare two policies episode by episode: an interval of the difference that may be looked at as often as one likes.

A pair is one seed, or one start, with the outcome of both policies. It scores +1 where only the candidate succeeds, -1
where only the champion does, and 0 otherwise; its mean is the difference of the success rates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

Verdict = Literal["better", "not worse", "worse", "undecided"]
ERROR = 0.05
"""Share of comparisons whose interval may miss the true difference at any of the looks; half of it on each side."""
_BETS = np.geomspace(0.004, 0.99, 24)
"""Shares of the stake that are bet, with equal weights; small ones for long comparisons, large ones for few losses."""


@dataclass(frozen=True)
class Pairs:
    """Counts of the outcomes of pairs."""

    wins: int = 0
    """Only the candidate succeeded."""
    ties: int = 0
    losses: int = 0
    """Only the champion succeeded."""

    def __len__(self) -> int:
        return self.wins + self.ties + self.losses

    def __add__(self, other: Pairs) -> Pairs:
        return Pairs(self.wins + other.wins, self.ties + other.ties, self.losses + other.losses)

    @property
    def difference(self) -> float:
        """Mean score; 0 without pairs."""
        return (self.wins - self.losses) / max(1, len(self))

    def interval(self, error: float = ERROR) -> tuple[float, float]:
        """Interval of the true difference that covers it at all looks together with probability 1 - `error`.

        The difference is at most m as long as nobody could have grown rich by betting against that: a stake that wins
        ``b (x - m) / (1 + m)`` of itself with each score x is a supermartingale if the mean of x is m or less, so that
        it exceeds 2 / `error` with probability `error` / 2 at most (Ville). Waudby-Smith and Ramdas, Estimating means
        of bounded random variables by betting (2024), section 4; here the stake is spread over fixed bets b.
        """
        low = _least(self.wins, self.ties, self.losses, error / 2)
        return low, -_least(self.losses, self.ties, self.wins, error / 2)

    def verdict(self, margin: float) -> Verdict:
        """What the interval says; see `verdict_of`."""
        return verdict_of(self.interval(), margin)

    def is_decided(self, margin: float) -> bool:
        """Whether more pairs would hardly change the verdict: better, worse, or equal but for the margin."""
        is_equal = self._is_more_than(-margin) and self._is_less_than(margin)
        return is_equal or self._is_more_than(0.0) or self._is_less_than(0.0)

    def _is_more_than(self, mean: float) -> bool:
        """Whether all of the interval is above `mean`."""
        return _is_refuted(self.wins, self.ties, self.losses, mean, ERROR / 2)

    def _is_less_than(self, mean: float) -> bool:
        return _is_refuted(self.losses, self.ties, self.wins, -mean, ERROR / 2)


def _is_refuted(wins: int, ties: int, losses: int, mean: float, error: float) -> bool:
    """Whether the bets against a true mean of `mean` or less have won 1 / `error` times the stake."""
    bet = _BETS / (1 + mean)
    wealth = wins * np.log1p(bet * (1 - mean)) + ties * np.log1p(-bet * mean) + losses * np.log1p(-_BETS)
    return bool(np.logaddexp.reduce(wealth) >= math.log(len(_BETS) / error))


def _least(wins: int, ties: int, losses: int, error: float) -> float:
    """The least mean that is not refuted at level `error`."""
    low, high = -1.0, 1.0
    for _ in range(30):  # wealth falls as the mean that is bet against grows
        mean = (low + high) / 2
        if _is_refuted(wins, ties, losses, mean, error):
            low = mean
        else:
            high = mean
    return low


def verdict_of(interval: tuple[float, float], margin: float) -> Verdict:
    """The verdict on a candidate by the interval of its difference from the champion.

    Better: all of the interval is above 0. Worse: all of it is below 0. Not worse: all of it is above -`margin`.
    """
    low, high = interval
    if low > 0:
        return "better"
    if high < 0:
        return "worse"
    return "not worse" if low > -margin else "undecided"
