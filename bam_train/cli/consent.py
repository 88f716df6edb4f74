"""Asking a person before a real robot moves."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from bam_train.cli.console import say

_QUESTION = "Is the robot clear of people, and a hand on its emergency stop? Type yes to go on: "


def guards_of(env: Any) -> dict[str, dict[str, Any]]:
    """What the guards of an environment's live robot did; empty for a simulated one."""
    report = getattr(getattr(env.unwrapped, "robot", None), "report", None)
    return {} if report is None else dict(report())


def limit_lines(guards: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """One line for each guard that has a limit, such as ``  joint speed (G8): 1 rad/s``."""
    limited = [(name, row) for name, row in guards.items() if row["limit"] not in (None, "")]
    return [f"  {name} ({row['number']}): {row['limit']:.3g} {row['unit']}".rstrip() for name, row in limited]


def plan_lines(env: Any, env_id: str, address: str, episodes: int) -> list[str]:
    """What a person should know of the episodes to come.

    Args:
        env: The environment, single, with a live robot or none.
        env_id: What it is called.
        address: Where the robot is.
        episodes: How many.
    """
    from bam_envs.core.robot import RobotSpec
    from bam_envs.safety.guard import is_base

    spec = getattr(getattr(env.unwrapped, "robot", None), "spec", None)
    count = "1 episode" if episodes == 1 else f"{episodes} episodes, one after the other without a pause"
    begin = "where the base stands"
    if isinstance(spec, RobotSpec) and not is_base(spec):
        gripper = "opening the gripper and " if "m" in spec.command.units else ""
        begin = f"by {gripper}going to the start pose"
    return [f"  address: {address}", f"  {env_id}: {count}", f"  each begins {begin}"]


def require_consent(env: Any, who: str, *, yes: bool, plan: Sequence[str] = ()) -> None:
    """Ask once before a real robot moves; it is connected, and stands still.

    Args:
        env: The environment, single or vector; without a real robot nobody is asked.
        who: What will move it, as the first line begins.
        yes: Show it, and do not ask.
        plan: Lines that say what it will do.

    Raises:
        SettingsError: The robot says that it cannot move now, the answer is not yes, or there is nobody to ask.
    """
    from bam_train.errors import SettingsError

    robot = getattr(env.unwrapped, "robot", None)
    info = getattr(robot, "info", None)
    if robot is None or info is None or info.simulated:
        return
    what = [f"{who} will move {info.text}:", *plan, "within"] if plan else [f"{who} will move {info.text}, within"]
    for line in (*what, *limit_lines(guards_of(env))):
        say(line)
    why = robot.not_ready()
    if why is not None:
        raise SettingsError(f"not ready: {why}; nothing has moved")
    if yes:
        return
    if not sys.stdin.isatty():
        raise SettingsError("a real robot would move, and there is nobody to ask; give --yes to go on without asking")
    print(_QUESTION, end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() != "yes":
        raise SettingsError("the answer was not yes; nothing has moved")
