"""Every exception that `bam_envs` raises on purpose.

::

    BamEnvsError
    ├── UnknownName            a name that is not in a table; carries the closest match
    ├── InvalidValue           a value that is not allowed; names it, and what was expected
    ├── MissingExtra           an optional dependency is not installed; carries the pip command
    ├── ResetNeeded            `step` before `reset`, or after the episode ended
    └── RobotFault             the robot or the link to it failed; never an episode's end
        ├── PhysicsDiverged    the simulated state is not finite
        ├── LinkLost           the link is down: nothing was sent, and nothing is queued
        │   ├── NoServer       no usable server: refused, silent, certificate, token
        │   └── StaleState     the link is up, and no fresh state came in time
        ├── ProtocolError      the other end broke the protocol: which field, expected, found
        ├── RemoteError        the other end refused or failed; carries its text
        │   └── NotInCommand   another client is in command
        ├── NotReady           the robot reports that it cannot move now: a protective stop, a paused program
        ├── StartNotReached    the start pose was not reached in time; carries the joints
        └── SafetyStop         a guard stopped the robot; latched until a person resumes; carries the guard

Third-party errors are converted to these, with the cause kept by ``from``.
"""

import re
from collections.abc import Iterable

from bam_envs.core.wording import closest, did_you_mean

_STOPPED_BY = re.compile(r"The robot (?:was|is still) stopped by ([^:(]+?) \(")


class BamEnvsError(Exception):
    """Base class. Its text is one line: what went wrong, why, and what to do."""


class UnknownName(BamEnvsError, ValueError):  # noqa: N818 - named for the cause
    """A name that is not in its table.

    Attributes:
        kind: Kind of the name, e.g. ``"environment"``.
        name: The unknown name.
        choices: All names in the table, sorted.
        closest: The most similar choice, or None.

    Args:
        kind: See above.
        name: See above.
        choices: See above.
        examples: Names to suggest if none is similar; every choice by default.
        similar: Least similarity of a suggested choice, from 0 to 1.
        meant: The name in the spelling of the table, to find the most similar choice; by default `name`.
        remedy: A sentence that follows: how else to go on.
    """

    def __init__(
        self,
        kind: str,
        name: str,
        choices: Iterable[str],
        examples: Iterable[str] | None = None,
        similar: float = 0.65,
        meant: str | None = None,
        remedy: str = "",
    ) -> None:
        self.kind, self.name, self.choices = kind, name, sorted(choices)
        self.closest = closest(meant or name, self.choices, similar)
        hint = did_you_mean(meant or name, self.choices, similar, examples)
        super().__init__(f"Unknown {kind} {name!r}. {hint}{remedy and f' {remedy}'}")


class InvalidValue(BamEnvsError, ValueError):  # noqa: N818
    """A value that is not allowed: the text names it, what was expected and what was found."""


class MissingExtra(BamEnvsError, ImportError):  # noqa: N818
    """An optional dependency is missing.

    Attributes:
        package: The import that failed.
        extra: The extra of `bam-train` that installs it.
    """

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        self.package, self.extra = package, extra
        super().__init__(f'{purpose} needs {package}, which is not installed. Run: pip install "bam-train[{extra}]"')


class ResetNeeded(BamEnvsError, RuntimeError):  # noqa: N818
    """`step` was called without a running episode."""


class RobotFault(BamEnvsError, RuntimeError):  # noqa: N818
    """The robot, or the link to it, failed."""


class PhysicsDiverged(RobotFault):
    """The simulated state is no longer finite; the text names the environments."""


class LinkLost(RobotFault):
    """The link is down. Nothing was sent, and nothing is queued."""


class NoServer(LinkLost):
    """No usable server at an address: the text gives the reason, and how to start one.

    Attributes:
        url: The address.
    """

    def __init__(self, url: str, message: str) -> None:
        self.url = url
        super().__init__(f"{url}: {message}")


class StaleState(LinkLost):
    """No fresh state came in time.

    Attributes:
        age: Age of the newest state [s]; infinite if there was none.
        limit: Maximum age [s].
    """

    def __init__(self, message: str, age: float = float("inf"), limit: float = 0.0) -> None:
        self.age, self.limit = age, limit
        super().__init__(message)


class ProtocolError(RobotFault):
    """The other end broke the protocol: the text names the topic or field, what was expected and what was found."""


class RemoteError(RobotFault):
    """The other end refused a request or failed; the text is that of the other end."""


class NotInCommand(RemoteError):  # noqa: N818
    """Another client is in command of the robot or environment."""


class NotReady(RobotFault):
    """The robot reports that it cannot move now; the text gives its reason."""


class StartNotReached(RobotFault):
    """The start pose was not reached in time.

    Attributes:
        joints: The joints that are not at the start pose, with their remaining distance [rad].
    """

    def __init__(self, message: str, joints: dict[str, float]) -> None:
        self.joints = joints
        super().__init__(message)


class SafetyStop(RobotFault):
    """A guard stopped the robot. It stays stopped until a person resumes it.

    Attributes:
        guard: Name of the guard.
    """

    def __init__(self, guard: str, message: str) -> None:
        self.guard = guard
        super().__init__(message)

    @classmethod
    def told(cls, text: str) -> "SafetyStop | None":
        """The stop of a guard at the robot's side, as a text from there tells it; None if it tells of none."""
        found = _STOPPED_BY.search(text)
        return None if found is None else cls(found[1], text[found.start() :])
