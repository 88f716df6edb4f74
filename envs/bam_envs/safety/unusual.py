"""The guard of observations that are unusual for the policy (G19), by a score of the program that runs it."""

import math

from bam_envs.core.errors import InvalidValue
from bam_envs.safety.guard import Guard, Tick

REACTIONS = ("warn", "hold", "stop")


class UnusualObservations(Guard):
    """The policy's observations, and how the robot answers, are as in training; else it warns, holds or stops."""

    number, name, unit, limit_value = "G19", "unusual observations", "of the bound", 1.0

    def __init__(self) -> None:
        self._reaction, self._reason = "warn", ""

    def react(self, reaction: str) -> None:
        """Warn, hold until the episode ends, or stop the robot; `InvalidValue` for anything else."""
        if reaction not in REACTIONS:
            raise InvalidValue(f"The guard {self.title} can {', '.join(REACTIONS)}, not {reaction!r}.")
        self._reaction, self.patience = reaction, 1 if reaction == "stop" else math.inf

    def told(self, reason: str) -> None:
        """Take the reason why a score is above 1, which is kept until the episode ends; "" ends one that only warns."""
        if reason or self._reaction == "warn":
            self.warning = reason and (self.warning or reason)

    def forgive(self) -> None:
        """Forget the reason, when an episode begins or a person resumes the robot."""
        self.warning = ""

    def fault(self, tick: Tick) -> str | None:
        """Report an unusual observation, unless it is only warned of."""
        return self.warning if self.warning and self._reaction != "warn" and not tick.approach else None
