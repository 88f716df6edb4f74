"""The tables of ``bam-deploy --print-guards``: every guard, and every limit that ``--guard`` changes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.robot import RobotSpec
from bam_envs.safety.guard import BOUNDS, Limits, is_base, limits_of
from bam_train.errors import SettingsError
from bam_train.files.log_lines import aligned

OUTSIDE_THE_GATE = (
    "G1   contract, signature  compared and verified before a live robot moves (exit status 3 or 1)",
    "G6   heartbeat            a server that is silent for 1 s is a lost link",
    "G17  length               an episode ends at the environment's time limit, a deployment after --episodes",
    "G20  one in command       a served robot is commanded by one program at a time, with a lease of 2 s",
    "G21  latch                a stop lasts until a person decides: the program ends, or resume() is called",
    "G22  status code          each tick's is published on /bam/status and recorded; 0, or the number of the guard",
)
"""Protection that other parts provide."""


def in_force(guards: Sequence[Mapping[str, Any]], limits: Limits, spec: RobotSpec) -> dict[str, float | None]:
    """The value of each limit, also where `limits` leaves it to the robot; None if the robot has no such guard.

    Args:
        guards: The result of `SafeRobot.guards`.
        limits: The limits of the robot.
        spec: The robot.
    """
    floor = limits.table_height if "m" in spec.command.units and not is_base(spec) else None
    chosen = {guard["setting"]: guard["limit"] for guard in guards} | {"lag": spec.lag, "box_z_min": floor}
    values = {name: chosen.get(name) if value is None else value for name, value in asdict(limits).items()}
    useful = limits_of(guards)
    return {name: value if name in useful else None for name, value in values.items()}


def guard_lines(guards: Sequence[Mapping[str, Any]], limits: Mapping[str, float | None]) -> list[str]:
    """Both tables as text.

    Args:
        guards: The result of `SafeRobot.guards`.
        limits: The result of `in_force`.
    """
    rows = [["guard", "", "limit", "set by", "what it does"]]
    for guard in guards:
        lowest, highest = (f"{end(guard['each'] or [guard['limit'] or 0.0]):.3g}" for end in (min, max))
        limit = f"{highest if lowest == highest else f'{lowest} to {highest}'} {guard['unit']}"
        limit = "off" if guard["limit"] is None else limit
        names = guard["setting"].split(", ")
        by = names[0] if len(names) == 1 else f"{names[0].partition('_')[0]}_*"
        rows.append([guard["number"], guard["name"], limit, by or "-", guard["does"]])
    settings = [["--guard", "now", "least", "most", "unit"]]
    for name, (least, most, unit) in BOUNDS.items():
        value = limits[name]
        settings.append([name, "-" if value is None else f"{value:g}", f"{least:g}", f"{most:g}", unit])
    return [*aligned(rows), "", "outside the gate", *OUTSIDE_THE_GATE, "", *aligned(settings)]


def read_guards(texts: Iterable[str]) -> dict[str, float]:
    """Parse the texts of ``--guard NAME=VALUE``.

    Raises:
        SettingsError: A limit is unknown, repeated or outside its bounds, or two limits contradict each other.
    """
    values: dict[str, float] = {}
    for text in texts:
        name, _, typed = (part.strip() for part in text.partition("="))
        try:
            value = float(typed)
        except ValueError as error:
            example = "joint_speed=0.3"
            raise SettingsError(f"--guard {text}: expected NAME=NUMBER, such as --guard {example}") from error
        if name in values:
            raise SettingsError(f"--guard: {name} comes twice ({values[name]:g} and {value:g}); give it once")
        values[name] = value
    try:
        Limits().changed(values)
    except BamEnvsError as error:
        raise SettingsError(f"--guard: {error}") from error
    return values
