"""Steps before a robot moves: check that the environment fits the policy, show the limits, and ask for consent."""

import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym

from bam_envs.core.location import LiveRobot, Location, Remote
from bam_envs.core.robot import RobotSpec
from bam_envs.core.wording import listed
from bam_envs.safety.guard import is_base
from bam_train.agent.agent_states import State
from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import ask, can_ask, say
from bam_train.deploy.checkpoint_admission import bring_up, has_real_robot
from bam_train.environments import environment_of, make_env, require_fit
from bam_train.errors import SettingsError
from bam_train.signals import SignalMemory

LIVE = "bam_train.deploy.live_robot"
"""The module of what a live robot adds; it is imported only for one, with all of its link."""


def connected_env(
    checkpoint: Checkpoint | None,
    place: Location,
    signals: SignalMemory,
    *,
    who: str,
    episodes: int,
    yes: bool = False,
    render: bool | str = False,
    named: str | None = None,
    arm: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    admit: Callable[[gym.Env[Any, Any], Location, str], Sequence[str]] = lambda env, place, identity: (),
    motion: Path | None = None,
    wiggle: bool = False,
) -> gym.Env[Any, Any]:
    """Make the environment of a checkpoint, or of a person, connect its robot, and obtain consent to move it.

    Args:
        checkpoint: The checkpoint of the policy that will act; None: a person acts, in `named`.
        place: The place of the environment.
        signals: Raises a signal whose exception Python discarded again, before the robot moves.
        who: The program that will move the robot, for the question to the operator.
        episodes: Number of planned episodes; 0 if a person begins each.
        yes: Whether to skip the question before a real robot moves.
        render: Whether to show the simulation in a window; or the render mode.
        named: The environment that the user expects.
        arm: The description here that takes the place of the checkpoint's; None: the checkpoint's.
        env_kwargs: Arguments of the environment, which override the checkpoint's.
        admit: Called before the question with the connected environment, its place, and the identity of its robot
            (`Inspection.identity`); returns lines for the operator.
        motion: Recording of the live robot in which each axis must have moved as commanded.
        wiggle: Whether to move each axis of a live robot a little first, to check that it moves as commanded.

    Raises:
        ContractRefused: The live robot does not fit the checkpoint.
        CheckpointMismatch: An environment without a live robot does not fit.
    """
    env_id, saved = named or "", dict[str, Any]()
    if checkpoint is not None:
        env_id, saved = environment_of(checkpoint, named, elsewhere=isinstance(place, Remote), arm=arm)
    mode = "human" if render is True else render or None
    make = partial(make_env, env_id, {**saved, **(env_kwargs or {})}, render_mode=mode)

    live: Any = import_module(LIVE) if isinstance(place, LiveRobot) else None

    def examine(env: Any, place: Location) -> Any:
        if checkpoint is None:
            return None
        if live is not None:
            return live.required_contract(checkpoint, env, place, motion, say)
        return require_fit(checkpoint, env, place)

    env: gym.Env[Any, Any]
    env, place, contract = bring_up(make, place, examine, raise_again=signals.raise_again)
    try:
        known = "" if contract is None else contract.identity
        is_shadow = isinstance(place, LiveRobot) and place.stage == "shadow"
        plan = [*plan_lines(env, env_id, place.text, episodes, wiggle=wiggle), *admit(env, place, known)]
        if isinstance(place, LiveRobot) and place.stage == "trial" and not getattr(env.unwrapped, "says_success", True):
            asks = "nobody is asked (--yes), and no trial counts" if yes else "you are asked after each episode"
            plan.append(f"  {env_id} does not say whether an episode succeeded: {asks}")
        signals.raise_again()
        if not is_shadow:
            actor = "a person" if checkpoint is None else checkpoint.path
            require_consent(env, f"{who}: {actor}", yes=yes, plan=plan)
        signals.raise_again()
        if wiggle and contract is not None and contract.inspection is not None and not is_shadow:
            live.require_motion(env, f"{actor} and the robot at {place.text}", contract.inspection, say)
            signals.raise_again()
    except BaseException:
        env.close()  # type: ignore[no-untyped-call]
        raise
    return env


_MOTION = ("joint speed", "tool speed", "gripper speed", "base speed", "turn speed", "trial box")
"""Guards whose limits the operator sees before the robot moves."""


def guards_of(env: Any) -> dict[str, dict[str, Any]]:
    """The counts of the guards of an environment's live robot, by name; empty for a simulated one."""
    report = getattr(getattr(env.unwrapped, "robot", None), "report", None)
    return {} if report is None else dict(report())


def say_agent_rests(env: Any, who: str, url: str | None) -> None:
    """Say so if the live agent at `url`, which got its robot back from the closed `env`, rests until it is resumed.

    Args:
        env: The environment.
        who: The program that drove.
        url: Address of the agent, if the robot has one.
    """
    state = getattr(getattr(env.unwrapped, "robot", None), "agent_state", "")
    if state in (State.PAUSED.value, State.STOPPED.value):
        say(f"{who}: the live agent is {state} now; its policy drives again after: bam-agent resume {url}")


def plan_lines(env: Any, env_id: str, address: str, episodes: int, *, wiggle: bool = False) -> list[str]:
    """Lines for the operator about the planned episodes."""
    spec = getattr(getattr(env.unwrapped, "robot", None), "spec", None)
    few = {0: "a person begins each episode", 1: "1 episode"}
    planned = few.get(episodes, f"{episodes} episodes, one after the other without a pause")
    begin = "where the base stands"
    if isinstance(spec, RobotSpec) and not is_base(spec):
        gripper = "opening the gripper and " if "m" in spec.command.units else ""
        begin = f"by {gripper}going to the start pose"
    proof = getattr(getattr(env.unwrapped, "robot", None), "proof_plan", "")
    first = [f"  first {proof}"] if proof else []
    if wiggle:
        first = ["  first each axis moves a little and back, to check that it moves as commanded"]
    return [f"  address: {address}", *first, f"  {env_id}: {planned}", f"  each begins {begin}"]


def require_consent(env: Any, who: str, *, yes: bool, plan: Sequence[str] = ()) -> None:
    """Ask the operator once before the real robot of `env` moves, then enable it; any other is enabled only.

    Args:
        env: The environment, single or vector, with a connected robot.
        who: The program that will move the robot, for the first line.
        yes: Whether to show the lines without asking.
        plan: Lines about the planned episodes.

    Raises:
        SettingsError: The robot is not ready to move, the answer is not yes, or standard input is not a terminal.
    """
    robot: Any = getattr(env.unwrapped, "robot", None)
    enable = getattr(robot, "enable", lambda: None)
    if not has_real_robot(env):
        enable()
        return
    guards = guards_of(env)
    finite = [name for name in _MOTION if name in guards and math.isfinite(guards[name]["limit"])]
    limits = [f"{name} {guards[name]['limit']:.3g} {guards[name]['unit']}" for name in finite]
    off = [name for name, guard in guards.items() if guard["limit"] == math.inf]
    say(f"{who} will move {robot.info.text}:")
    for line in (*plan, f"  at most {', '.join(limits)}"):
        say(line)
    without = f", of which {listed(off)} {'is' if len(off) == 1 else 'are'} off" if off else ""
    say(f"  behind {len(guards)} guards{without}; bam-deploy --print-guards shows them")
    for warning in getattr(robot, "warnings", ()):
        say(f"  warning: {warning}")
    services = robot.enabling
    for one in services:
        say(f"  first {one.service} is called, which {one.does}")
    if not services:  # else it is not ready before they are called
        _require_ready(robot)
    if not yes:
        if not can_ask():
            raise SettingsError(
                "a real robot would move, and there is nobody to ask; give --yes to go on without asking"
            )
        question = "Is the robot clear of people, and a hand on its emergency stop? Type yes to go on: "
        if ask(question, partial(print, end="", file=sys.stderr, flush=True)) != "yes":
            raise SettingsError("the answer was not yes; nothing has moved")
    if services:
        enable()
        _require_ready(robot)


def _require_ready(robot: Any) -> None:
    if (why := robot.not_ready()) is not None:
        raise SettingsError(f"not ready: {why}; nothing has moved")


def require_screen(*, remote: bool) -> None:
    """Refuse ``--render`` without a simulation here, or without a screen."""
    if remote:
        raise SettingsError(
            "--render shows the simulation here, and there is none with --robot or --transport; leave it out"
        )
    if sys.platform == "linux" and not (os.environ.keys() & {"DISPLAY", "WAYLAND_DISPLAY"}):
        raise SettingsError(
            "--render needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set; "
            "leave it out, or make a video: bam-eval CHECKPOINT --video video.gif"
        )
