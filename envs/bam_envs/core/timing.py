"""Time: deadlines on the monotonic clock, the pacer of every loop that runs at a fixed rate, and a ticking thread.

Also whose fault a late tick is.
"""

import math
import threading
import time
from array import array
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

KEPT = 65536
"""Ticks whose lateness is kept, to limit the memory: 55 minutes at 20 Hz."""
SLOW = 0.1
"""Share of the period from which on the CPU time of an action counts: a tenth."""
CLOSEST = 0.96
"""Least time from one command to the next, as a share of the period."""
RECENT = 20
"""Number of the last ticks that show whether the computer is busy."""
BUSY = 0.05
"""Share of these that may be disturbed, and of the ticks of a policy that may be late."""
WINDOW = 100
"""Fewest ticks that show that a policy is late too often."""
_LATE_BY, _JITTER = 0.1, 0.005
"""A tick is disturbed if it starts this share of a period too late; at least the lateness of a sleeping process [s]."""


class Deadline:
    """A time limit.

    Args:
        timeout: Time until it passes [s].
        now: The clock [s]; monotonic.
    """

    def __init__(self, timeout: float, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._at = now, now() + timeout

    @property
    def left(self) -> float:
        """Time left [s]; 0 once it has passed."""
        return max(0.0, self._at - self._now())

    @property
    def passed(self) -> bool:
        """Whether no time is left."""
        return self._now() >= self._at


@dataclass(frozen=True)
class Lateness:
    """Delays of the ticks after their deadlines [s]."""

    p50: float
    p99: float
    max: float


class Pacer:
    """Deadlines one period apart, with statistics of the lateness.

    A late tick starts at once, and the next deadline is a period after the last one, or the share `closest` of a period
    after this tick if that is later: what moves a robot must not come soon after a late tick. The deadlines that passed
    before a tick that is late by more than half a period are counted as missed, and none is caught up.

    Args:
        period: Time between two ticks [s]; None runs as fast as possible, without deadlines.
        now: The clock [s]; monotonic.
        sleep: Waits for a time [s]; if it returns True, the tick starts now.
        closest: Least time from a tick to the next deadline, as a share of the period; 0.5 for a clock, whose lateness
            must not add up.
    """

    def __init__(
        self,
        period: float | None,
        *,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], bool | None] = time.sleep,
        closest: float = CLOSEST,
    ) -> None:
        self.period, self._now, self._sleep, self._closest = period, now, sleep, closest
        self.ticks = 0
        """Ticks started, over all episodes."""
        self.missed = 0
        """Deadlines that passed without a tick."""
        self._late = array("d")  # of the last KEPT ticks, in no order
        self._latest = 0.0
        self._seconds, self._intervals = 0.0, 0  # between the ticks of an episode
        self._previous: float | None = None
        self._due: float | None = None  # None: the first tick is due when it starts

    def start(self) -> None:
        """Begin an episode: its first tick is due now."""
        self._due, self._previous = self._now(), None

    def hasten(self) -> None:
        """Let the next tick be due half a period after the last one, if it would be due later."""
        if self._due is not None and self._previous is not None and self.period is not None:
            self._due = min(self._due, self._previous + self.period / 2)

    def wait(self) -> float:
        """Wait until the next tick is due and start it; returns its lateness [s], 0 without a period."""
        while self.period is not None and (slack := self.slack) > 0:
            if self._sleep(slack):
                break
        return self.tick()

    def tick(self) -> float:
        """Start the next tick now, and set the deadline after it; returns its lateness [s], 0 without a period."""
        now = self._now()
        if self._previous is not None:
            self._seconds += now - self._previous
            self._intervals += 1
        self._previous = now
        self.ticks += 1
        if self.period is None:
            return 0.0
        due = now if self._due is None else self._due
        late = max(0.0, now - due)
        # Rounding must not make a tick that is late by exactly half a period begin a new grid.
        missed = math.ceil(late / self.period - 0.5 - 1e-9)
        self.missed += missed
        begins = missed or due - now > self.period / 2
        self._due = now + self.period if begins else max(due + self.period, now + self._closest * self.period)
        self._latest = max(self._latest, late)
        if len(self._late) < KEPT:
            self._late.append(late)
        else:
            self._late[self.ticks % KEPT] = late
        return late

    @property
    def slack(self) -> float:
        """Time left to the next deadline [s]; negative once it has passed, infinite without a period."""
        if self.period is None:
            return math.inf
        return 0.0 if self._due is None else self._due - self._now()

    @property
    def rate(self) -> float | None:
        """Ticks per second within episodes [Hz]; None before the second tick."""
        return self._intervals / self._seconds if self._seconds > 0 else None

    @property
    def lateness(self) -> Lateness | None:
        """Percentiles over the last `KEPT` ticks, the maximum over all; None without a period or before a tick."""
        if not self._late:
            return None
        p50, p99 = np.percentile(np.frombuffer(self._late), [50, 99])
        return Lateness(float(p50), float(p99), self._latest)


def least_lateness(period: float) -> float:
    """The delay [s] above which a tick is late, and shows that the computer was busy; `period` is in s."""
    return max(_LATE_BY * period, _JITTER)


class TickTimes:
    """The times of the last ticks of a deployment.

    An action needs CPU time, which load does not change much, and it takes longer than that where others use the CPU
    too. A late tick is the policy's if it would have been in time without its action, and the action needed a share of
    the period that matters. Any other late tick is the computer's.

    Args:
        period: Time between two ticks [s]; None: there are no deadlines.
    """

    def __init__(self, period: float | None) -> None:
        self.period = period
        self.late = self.slow = 0
        """Ticks that missed a deadline, and how many of these the policy made late."""
        self._last: deque[tuple[bool, bool]] = deque(maxlen=WINDOW)  # whether each was late, and its policy made it so
        self._disturbed: deque[bool] = deque(maxlen=RECENT)
        self._computed: deque[float] = deque(maxlen=RECENT)

    def add(self, late: float, missed: int, acted: float, computed: float) -> bool:
        """Add a tick; whether its policy made it miss a deadline.

        Args:
            late: Delay after its deadline [s].
            missed: Deadlines that passed without a tick.
            acted: Duration of the action before it [s].
            computed: CPU time of that action [s].
        """
        if self.period is None:
            return False
        self._computed.append(computed)
        is_policy = late <= acted and computed >= SLOW * self.period
        self._disturbed.append(late > least_lateness(self.period) and not is_policy)
        is_late, is_slow = missed > 0, missed > 0 and is_policy
        self._last.append((is_late, is_slow))
        self.late, self.slow = self.late + is_late, self.slow + is_slow
        return is_slow

    @property
    def warning(self) -> str:
        """That more of the last ticks were late than may be of those of a trial; "" if not."""
        late, slow = map(sum, zip(*self._last or [(False, False)], strict=True))
        if len(self._last) < WINDOW or late <= BUSY * WINDOW:
            return ""
        remedy = "use a faster policy" if 2 * slow > late else "end other programs"
        return (
            f"{late} of the last {WINDOW} ticks missed their deadline, {slow} of them because of the policy: {remedy}"
        )

    @property
    def computed(self) -> float:
        """CPU time of an action, the median of the last ones [s]; 0 before the first."""
        return sorted(self._computed)[len(self._computed) // 2] if self._computed else 0.0

    def excuse(self, *, by_time: bool) -> str:
        """Why a stop of a guard is not due to the policy, in one line; "" if it may be.

        Args:
            by_time: Whether that guard looks at when states, answers and commands come, and not at what the robot does.
        """
        if self.period is None or self.computed >= SLOW * self.period:
            return ""
        light = f"an action needs {1e3 * self.computed:.2g} ms of the CPU, and the period is {1e3 * self.period:g} ms"
        disturbed = sum(self._disturbed)
        if disturbed > BUSY * RECENT:
            return f"{disturbed} of the last {RECENT} ticks were disturbed, and {light}: the computer is busy"
        return f"{light}: the computer or the link was late" if by_time else ""


class Ticker:
    """A thread that calls `tick` every `period`, and whenever it is woken, until it is stopped.

    Args:
        tick: The function to call. An exception in it ends the thread, and goes to `threading.excepthook`.
        period: Time between two calls [s].
    """

    def __init__(self, tick: Callable[[], None], period: float) -> None:
        self.period = period
        self._tick, self._wake, self._stopped = tick, threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="bam-ticker", daemon=True)

    @property
    def running(self) -> bool:
        """Whether the thread is alive."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread; the first call is immediate."""
        self._thread.start()

    def wake(self) -> None:
        """Call `tick` now, before its next time."""
        self._wake.set()

    def _run(self) -> None:
        pacer = Pacer(self.period, closest=0.5)
        pacer.start()
        while True:
            self._wake.wait(max(0.0, pacer.slack))
            self._wake.clear()
            if self._stopped:
                return
            if pacer.slack <= 0:  # else it was woken
                pacer.tick()
            self._tick()

    def stop(self) -> None:
        """End the thread; waits for a running call. Idempotent."""
        self._stopped = True
        self._wake.set()
        if self.running and self._thread is not threading.current_thread():
            self._thread.join()
