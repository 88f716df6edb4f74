"""The table of a contract: each line has its subject, the expected and the found value, and a verdict."""

from dataclasses import dataclass, field
from typing import Any, Literal

from bam_envs.live.inspection import Inspection
from bam_train.errors import ContractRefused

Verdict = Literal["ok", "refused", "unknown"]
_WIDEST = 60
"""Maximum width of a column, so that a long text does not widen the table [characters]."""


@dataclass(frozen=True)
class Check:
    """One line of the table."""

    what: str
    expected: str
    found: str
    verdict: Verdict
    """``"unknown"`` if the robot's messages do not decide the line, which then does not refuse the robot."""
    passes: bool = False
    """Whether a busy computer or network changes the line, so that another look may find another value."""


def check(what: str, expected: str, found: str, *, fits: bool | None, passes: bool = False) -> Check:
    """One line; `fits` is None for an unknown result."""
    return Check(what, expected, found, "unknown" if fits is None else "ok" if fits else "refused", passes)


@dataclass(frozen=True)
class Contract:
    """The comparison of a checkpoint with a robot."""

    checks: tuple[Check, ...]
    inspection: Inspection | None = field(default=None, repr=False)
    """The messages of the robot that were compared."""

    @property
    def refused(self) -> tuple[Check, ...]:
        """The lines that do not fit; a robot moves only if there are none."""
        return tuple(line for line in self.checks if line.verdict == "refused")

    def lines(self, *, whole: bool = True) -> list[str]:
        """The table as text, with a header.

        With `whole`, only refused lines are never shortened. Without, lines that fit are counted, and no other is
        shortened.
        """
        shown = [line for line in self.checks if whole or line.verdict != "ok"]
        rows = [("what", "expected", "found", "verdict")] if shown else []
        rows += [(line.what, line.expected, line.found, line.verdict) for line in shown]
        fit = len(self.checks) - len(shown)
        rest = [f"{fit} lines fit; bam-deploy --print-contract shows them"] if fit else []
        if not rows:
            return rest
        widths = [min(_WIDEST, max(len(row[column]) for row in rows)) for column in range(3)]

        def cell(text: str, width: int, *, whole: bool) -> str:
            return text.ljust(width) if len(text) <= width or whole else f"{text[: width - 3]}..."

        never = ("refused",) if whole else ("refused", "unknown")
        lines = [
            "  ".join([*(cell(row[i], widths[i], whole=row[3] in never) for i in range(3)), row[3]]) for row in rows
        ]
        return [*lines, *rest]

    def to_json(self) -> list[dict[str, Any]]:
        """The lines as plain values."""
        return [{name: value for name, value in vars(line).items() if name != "passes"} for line in self.checks]

    def require(self, who: str, moved: str = "nothing has moved") -> None:
        """Raise `ContractRefused`, which names the first refused line, if a line is refused.

        Args:
            who: Checkpoint and robot, for the message.
            moved: Motion of the robot so far, for the message.
        """
        if self.refused:
            first, *others = self.refused
            more = f" (and {len(others)} more)" if others else ""
            text = f"{first.what}: expected {first.expected}, found {first.found}{more}"
            text = f"{who} do not fit: {text}; correct the robot or its profile; {moved}"
            raise ContractRefused(first.what, text, passes=all(line.passes for line in self.refused))
