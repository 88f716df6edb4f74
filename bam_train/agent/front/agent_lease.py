"""The lease on the robot of a live agent: who has taken over, and until when."""

import math
import time
from collections.abc import Callable

from bam_envs.core.errors import NotInCommand
from bam_envs.remote.serve.command_lease import CommandLease
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Caller

CUT_LINK_TIMEOUT = 2.0
"""Time for which the lease of an owner stays whose link was cut [s]."""
SILENT_LINK_TIMEOUT = 3.0
"""Time without a sign of life, of which there is one a second, after which the link of an owner counts as cut [s]."""


class AgentLease(CommandLease):
    """The lease on the robot of a live agent: it ends without use, and outlives a cut link for a while.

    Args:
        seconds: Time without use after which it ends [s].
        clock: Monotonic clock [s].
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(seconds, clock)
        self._now, self._used = clock, 0.0
        self._cut: tuple[str, str, float] | None = None  # owner, name for people, end of the lease
        self._how = ""  # the link of that owner was lost

    def take(
        self, client: str, caller: Caller = UNKNOWN_CALLER, *, force: bool = False, shown: str | None = None
    ) -> bool:
        """A command of `client` came: it renews its lease, and never begins one, so that a stop or a pause holds."""
        if self.holder != client:
            reason = self.refusal() if self.owner else "its lease has ended, or never began. Reset to take over."
            raise NotInCommand(f"This program is not in command: {reason}")
        self.use()
        return False

    def grant(self, client: str, caller: Caller, *, force: bool = False, shown: str | None = None) -> bool:
        """See `CommandLease.take`; whoever has the lease keeps it until it ends, also while silent."""
        holder = self.holder
        if (holder not in (None, client) or self._cut is not None) and not force:
            raise NotInCommand(self.refusal())
        self._cut, self._used = None, self._now()
        return super().take(client, caller, force=force, shown=shown)

    def refusal(self) -> str:
        """Who drives, until when, and how to ask."""
        return (
            f"{self.owner} drives this robot; the lease ends {self.left:.1f} s after its last use. Ask for it to be "
            "handed back, or take it by force on the console, with a token of the role administer."
        )

    @property
    def owner(self) -> str | None:
        """Who drives, for people; None if the policy does."""
        return self._cut[1] if self._cut is not None else self._shown if self.holder is not None else None

    @property
    def left(self) -> float:
        """Time until the lease ends if it is not used [s]."""
        end = self._cut[2] if self._cut is not None else self._used + self.seconds
        return max(0.0, end - self._now())

    def use(self) -> None:
        """Begin the time without use anew."""
        self._used = self._now()

    def cut(self, client: str, shown: str, how: str = "was cut") -> None:
        """Keep the lease of a client for `CUT_LINK_TIMEOUT` [s], as `how` it lost its link."""
        self._cut, self._how = (client, shown, self._now() + CUT_LINK_TIMEOUT), how

    @property
    def is_silent(self) -> bool:
        """Whether there is an owner without a sign of life: frozen, or behind a network that is gone."""
        return self.holder is not None and SILENT_LINK_TIMEOUT < self.silence < math.inf

    @property
    def is_cut(self) -> bool:
        """Whether the owner's link was cut, and the lease has not ended yet."""
        return self._cut is not None

    def over(self) -> tuple[str, str] | None:
        """The owner of a lease that is over by itself, and why; it is to be released."""
        if self._cut is not None:
            client, shown, end = self._cut
            if self._now() >= end:
                self._cut = None
                return client, f"the lease of {shown} ended, {CUT_LINK_TIMEOUT:g} s after its link {self._how}"
        elif self.holder is not None and self._now() - self._used > self.seconds:
            client, shown = self.holder, self._shown or self.holder
            return client, f"the lease of {shown} ended: it was not used for {self.seconds:g} s"
        return None
