"""Whether a policy on a live agent is promoted or rolled back: pure logic, which is told how each episode ended.

A policy is promoted once its trials are enough (`bam_train.deploy.trials`). It is rolled back when guards stopped it
too often, when it made too many ticks late (`bam_envs.core.timing.TickTimes`), when it had a fault of its own, or when
its success rate has been shown to be below a bound. That test is valid after every episode, as that of the trials, and
for the same reason: it is a test martingale (J. Ville, 1939).
While the success rate is at least the bound b, each factor

    failure: m / (b + m (1 - b)),    success: 1 / (b + m (1 - b)),    for any m > 1,

has an expectation of at most 1; with it, the odds of a failure are m times those at the bound. A policy may become
worse after a long time, such as with a gripper that wears out, and its earlier successes should not protect it. So a
product of factors begins before each episode k = 1, 2, ..., with the weight 1 / (k (k + 1)); these weights add up to 1,
and products that have not begun are 1. A weighted sum of martingales is one too (H. Robbins, 1970, calls this the
method of mixtures): for a policy whose success rate is never below b, it ever reaches 1 / alpha with a probability of
at most alpha. The mean over several m is sensitive just below the bound and far below it.
"""

from collections import deque
from dataclasses import dataclass
from typing import Literal

from bam_envs.core.timing import BUSY, WINDOW
from bam_train.deploy.trials import ALPHA, Evidence
from bam_train.errors import SettingsError
from bam_train.files.log_lines import counted

_ODDS = (2.0, 4.0, 16.0)
"""The alternatives m."""
_SHOWN = 20
"""Number of the last episodes that a reason mentions."""


@dataclass(frozen=True)
class Judgement:
    """What follows for the policy."""

    decision: Literal["promote", "roll back"]
    reason: str
    """In one line."""


class Shortfall:
    """Evidence that a success rate is, or has become, lower than `bound`; constant memory.

    Attributes:
        bound: Between 0 and 1, exclusive.
        episodes: Number of episodes so far.
        value: Value of the test martingale: 1 at first; from 1 / `ALPHA` on, the rate is below the bound.
    """

    def __init__(self, bound: float) -> None:
        self.bound, self.episodes, self.value = bound, 0, 1.0
        self._sums = [0.0] * len(_ODDS)

    def add(self, success: bool) -> None:
        """Take one more episode into account."""
        self.episodes += 1
        begins = 1 / (self.episodes * (self.episodes + 1))
        for place, odds in enumerate(_ODDS):
            factor = (1.0 if success else odds) / (self.bound + odds * (1 - self.bound))
            self._sums[place] = min((self._sums[place] + begins) * factor, 1e300)
        self.value = sum(self._sums) / len(_ODDS) + 1 / (self.episodes + 1)

    @property
    def is_enough(self) -> bool:
        """Whether the success rate is below the bound, with an error probability of at most `ALPHA`."""
        return self.value >= 1 / ALPHA


class Probation:
    """Watches one policy, on trial or in service.

    Args:
        bound: Success rate below which the policy is rolled back, between 0 and 1, exclusive.
        guard_stops: Number of episodes that a guard stopped after which it is rolled back.
        window: Number of the last episodes among which these are counted.

    Raises:
        SettingsError: A number is out of its range.
    """

    def __init__(self, bound: float = 0.9, guard_stops: int = 2, window: int = 100) -> None:
        if not 0 < bound < 1:
            raise SettingsError(f"the success rate for a roll-back must be between 0 and 1, found {bound:g}")
        if guard_stops < 1 or window < guard_stops:
            text = "the number of stops by guards for a roll-back must be from 1 to that of the episodes"
            raise SettingsError(f"{text}, found {guard_stops} and {window}")
        self._shortfall, self._guard_stops, self._window = Shortfall(bound), guard_stops, window
        self._episodes = self._successes = 0
        self._recent: deque[bool] = deque(maxlen=_SHOWN)
        self._stops: deque[int] = deque(maxlen=guard_stops)  # number of the episode of each stop
        self._ticks: deque[tuple[int, int]] = deque(maxlen=_SHOWN)  # late ones of the policy, and all

    def ended(
        self,
        success: bool | None,
        stopped_by: str = "",
        trials: Evidence | None = None,
        *,
        slow: int = 0,
        ticks: int = 0,
    ) -> Judgement | None:
        """Judge the policy after an episode.

        Args:
            success: Whether it succeeded; None if the environment does not say, which counts for nothing.
            stopped_by: The guard that stopped it, such as ``"tool speed (G8)"``; "" if none did, or for no fault of it.
            trials: The evidence of the trials so far, if the policy is on trial.
            slow: Number of ticks that it made late.
            ticks: Number of all ticks.
        """
        self._episodes += 1
        self._ticks.append((slow, ticks))
        slow, ticks = map(sum, zip(*self._ticks, strict=True))
        if ticks >= WINDOW and slow > BUSY * ticks:
            most = f"at most {100 * BUSY:g} % may be"
            return self._back(f"its actions took so long that {slow} of {ticks} ticks were late, and {most}")
        if stopped_by:
            self._stops.append(self._episodes)
            if len(self._stops) == self._guard_stops and self._stops[0] > self._episodes - self._window:
                among = f"in the last {self._episodes - self._stops[0] + 1} episodes"
                return self._back(f"guards stopped it {self._guard_stops} times {among}, the last was {stopped_by}")
        if success is not None:
            self._successes += success
            self._recent.append(success)
            self._shortfall.add(success)
        if self._shortfall.is_enough:
            return self._back(self._too_few)
        return Judgement("promote", trials.text) if trials is not None and trials.is_enough else None

    def failed(self, why: str) -> Judgement:
        """Judge the policy after a fault of its own, such as an action that is NaN or of a wrong shape."""
        return self._back(f"a fault of the policy: {' '.join(why.split())}")

    @property
    def _too_few(self) -> str:
        number, last = self._shortfall.episodes, len(self._recent)
        recent = f", {sum(self._recent)} of the last {last}" if last < number else ""
        shown = f"less than {100 * self._shortfall.bound:g} % (error probability at most {100 * ALPHA:g} %)"
        return f"{self._successes} of {counted(number, 'episode')} succeeded{recent}, which shows {shown}"

    def _back(self, reason: str) -> Judgement:
        return Judgement("roll back", reason)
