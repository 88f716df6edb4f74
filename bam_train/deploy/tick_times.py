"""Whether a tick was late because of its policy, or because the computer is busy with something else."""

from collections import deque

SLOW = 0.1
"""Share of the period from which on the CPU time of an action counts: a tenth."""
RECENT = 20
"""Number of the last ticks that show whether the computer is busy."""
BUSY = 0.05
"""Share of these that may be disturbed."""
_LATE_BY, _JITTER = 0.1, 0.005
"""A tick is disturbed if it starts this share of a period too late; at least the lateness of a sleeping process [s]."""


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
        self.late += missed > 0
        if self.period is None:
            return False
        self._computed.append(computed)
        is_policy = late <= acted and computed >= SLOW * self.period
        self._disturbed.append(late > max(_LATE_BY * self.period, _JITTER) and not is_policy)
        self.slow += (is_slow := missed > 0 and is_policy)
        return is_slow

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
