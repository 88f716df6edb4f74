"""The table that ``bam-deploy --print-guards`` prints: every guard, and every limit that ``--guard`` changes."""

from collections.abc import Mapping, Sequence
from typing import Any

from bam_envs.safety.guard import BOUNDS, Limits

BESIDE = (
    "G1   contract, signature  compared and verified before a live robot moves (exit status 3 or 1)",
    "G6   heartbeat            a server that gives no sign of life for 1 s is a lost link",
    "G17  length               an episode ends at the environment's time limit, a deployment after --episodes",
    "G20  one in command       a served robot is commanded by one program at a time, with a lease of 2 s",
    "G21  latch                a stop lasts until a person decides: the program ends, or resume() is called",
    "G22  status code          each tick's is published on /bam/status and recorded; 0, or the number of the guard",
)
"""Protection of which the gate is not the place."""


def guard_lines(guards: Sequence[Mapping[str, Any]], limits: Limits) -> list[str]:
    """Lines for people.

    Args:
        guards: The guards, from `SafeRobot.guards`.
        limits: The limits of the robot.
    """
    rows = [["guard", "", "limit", "set by", "what it does"]]
    for guard in guards:
        limit = "off" if guard["limit"] is None else f"{guard['limit']:.3g} {guard['unit']}"
        rows.append([guard["number"], guard["name"], limit, guard["setting"] or "-", guard["does"]])
    settings = [["--guard", "now", "least", "most", "unit"]]
    for name, (least, most, unit) in BOUNDS.items():
        value = getattr(limits, name)
        settings.append([name, "-" if value is None else f"{value:g}", f"{least:g}", f"{most:g}", unit])
    return [*_aligned(rows), "", "beside the gate", *BESIDE, "", *_aligned(settings)]


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Each row as one line, its columns below those of the others."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]
