"""The table of a contract: what was compared, what was expected, what was found, and the verdict."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from bam_envs.live.evidence import Evidence
from bam_train.errors import ContractRefused

Verdict = Literal["ok", "refused", "not told"]
_WIDEST = 60
"""Most characters of a column other than the last, so that a long text does not widen the table."""


@dataclass(frozen=True)
class Check:
    """One line of the table."""

    what: str
    expected: str
    found: str
    verdict: Verdict
    """``"not told"`` if the robot does not report it."""


def check(what: str, expected: str, found: str, *, fits: bool | None) -> Check:
    """One line; `fits` is None for what the robot does not report."""
    return Check(what, expected, found, "not told" if fits is None else "ok" if fits else "refused")


@dataclass(frozen=True)
class Contract:
    """What was compared between a checkpoint and a robot."""

    checks: tuple[Check, ...]
    evidence: Evidence | None = field(default=None, repr=False)
    """What the robot showed."""

    @property
    def refused(self) -> tuple[Check, ...]:
        """The lines that do not fit; a robot moves only if there are none."""
        return tuple(line for line in self.checks if line.verdict == "refused")

    def lines(self) -> list[str]:
        """The table for people, with its head; what was refused comes with the whole text."""
        rows = [("what", "expected", "found", "verdict")]
        rows += [(line.what, line.expected, line.found, line.verdict) for line in self.checks]
        widths = [min(_WIDEST, max(len(row[column]) for row in rows)) for column in range(3)]

        def cell(text: str, width: int, *, whole: bool) -> str:
            return text.ljust(width) if len(text) <= width or whole else f"{text[: width - 3]}..."

        return [
            "  ".join([*(cell(row[i], widths[i], whole=row[3] == "refused") for i in range(3)), row[3]]) for row in rows
        ]

    def to_json(self) -> list[dict[str, Any]]:
        """The lines as plain values."""
        return [asdict(line) for line in self.checks]

    def require(self, who: str, moved: str = "nothing has moved") -> None:
        """Raise `ContractRefused`, which names the first refused line, if there are any.

        Args:
            who: The two parties, for the message.
            moved: What the robot has done until now.
        """
        if self.refused:
            first, *others = self.refused
            more = f" (and {len(others)} more)" if others else ""
            text = f"{first.what}: expected {first.expected}, found {first.found}{more}"
            raise ContractRefused(first.what, f"{who} do not fit: {text}; correct the robot or its profile; {moved}")


def joined(*groups: Iterable[Check]) -> Contract:
    """The contract with the lines of all groups, in order."""
    return Contract(tuple(line for group in groups for line in group))
