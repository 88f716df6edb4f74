"""The resident half of `bam-agent`: it makes a live agent of the flags, and runs it until a signal."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bam_train.files.log_lines import begin_log
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from bam_train.agent.agent_options import AgentOptions
    from bam_train.cli.flags import AgentConfig

FOR_ANY_ROBOT = ("robot_name", "stage", "i_know", "keys", "allow_unsigned", "unusual")
"""Flags of a robot that the simulated one of an agent has too."""


def run_agent(config: AgentConfig, signals: SignalMemory) -> int:
    """Run the program with its parsed flags; returns 128 + the signal that ended it."""
    from bam_train.agent.agent_messages import Front
    from bam_train.agent.audit import Audit
    from bam_train.agent.child_processes import FrontLink, SimulatedBox, go_first
    from bam_train.agent.resident import COMMAND_LIFETIME, Resident
    from bam_train.agent.versions import Versions
    from bam_train.checkpoint import Checkpoint
    from bam_train.deploy.deployment import Stopped
    from bam_train.environments import environment_of
    from bam_train.settings import read_named
    from bam_train.signals import handled

    if config.record is not None:
        import pyarrow  # noqa: F401 - it is needed when a recording ends
    options = options_of(config)
    tell = begin_log("bam-agent")
    with ExitStack() as stack:
        new = [
            one for one in (options.folder / "versions", options.folder, *options.folder.parents) if not one.exists()
        ]
        versions = Versions(options.folder / "versions")
        stack.enter_context(versions.held())
        refused = stack.enter_context(ExitStack())  # a start that is refused changes nothing
        refused.callback(_remove, new, options.folder)
        ran_before = (options.folder / "audit.jsonl").exists()
        if config.policy is not None:
            environment_of(Checkpoint.open(config.policy.expanduser()), config.env)  # before it becomes the champion
        refused.callback(versions.undo())
        active = versions.first(config.policy)
        env_id, env_kwargs = environment_of(Checkpoint.open(active.path), config.env)
        if config.robot is None:
            kwargs = {**env_kwargs, **read_named(config.set, "randomize=true")}
            box = SimulatedBox(env_id, kwargs, options.robot.robot_name)
            stack.callback(box.close)
            box.start()
            options = replace(options, robot=replace(options.robot, url=box.url))
        go_first()  # not the simulated robot
        audit = Audit(options.folder / "audit.jsonl")
        stack.callback(audit.close)
        resident: Resident
        front = FrontLink(
            Front(env_id, env_kwargs, options, COMMAND_LIFETIME),
            lambda message: resident.take(message),
            lambda: resident.front_died(),
        )
        resident = Resident(
            options,
            versions,
            audit,
            send=front.send,
            tell=tell,
            admit=partial(_admit, config, signals),
            is_running=not (config.paused or ran_before),
        )
        stack.callback(front.close)
        front.start()
        refused.pop_all()
        begun = f"bam-agent {version('bam-train')} (process {os.getpid()}) at {options.robot.text}"
        audit.write("started", begun, who="the agent", digest=active.digest)
        stack.callback(audit.write, "ended", f"process {os.getpid()}", who="the agent")
        scheme = "wss" if options.cert else "ws"
        at = f"{options.bind}:{front.port}"
        tell(f"listens on {scheme}://{at}; the console is at {scheme.replace('ws', 'http')}://{at}")
        if options.warning is not None:
            tell(options.warning)
        if ran_before and not config.paused:
            tell(f"it ran before in {options.folder}, so it starts paused")
        with handled(resident.switch, ignored_too=True):
            resident.switch.came += signals.came
            try:
                resident.run()
            except Stopped:
                tell("interrupted: the robot is halted, and nobody drives it")
                return 128 + resident.switch.came[0]
    return 0


def _remove(new: Sequence[Path], folder: Path) -> None:
    """Remove the `new` folders: those of the agent at `folder` with what is in them, and others if they are empty."""
    for one in new:  # the innermost first
        if one == folder or folder in one.parents:
            shutil.rmtree(one, ignore_errors=True)
        else:
            with suppress(OSError):
                one.rmdir()


def _admit(config: AgentConfig, signals: SignalMemory, env: Any, lines: Sequence[str]) -> None:
    """Ask the operator once before a real robot moves."""
    from bam_train.cli.consent import require_consent

    signals.raise_again()
    plan = [*lines, "  episode after episode, until it is paused or taken over"]
    require_consent(env, "bam-agent", yes=config.yes, plan=plan)
    signals.raise_again()


def options_of(config: AgentConfig) -> AgentOptions:
    """The options of the agent by its flags; invalid flags are refused."""
    from bam_envs.core.location import is_loopback
    from bam_train.agent.agent_options import AgentOptions
    from bam_train.errors import SettingsError

    if config.robot is None:
        config.location(*FOR_ANY_ROBOT)
    elif config.set:
        raise SettingsError("--set changes the simulated robot, and --robot names another one; leave one of them out")
    if not is_loopback(config.bind) and config.token_file is None:
        raise SettingsError(
            f"anybody who reaches {config.bind} could drive the robot: give --token-file, or leave out --bind"
        )
    if config.cert is None and config.key is not None:
        raise SettingsError("--key means something only with --cert")
    given = {name: getattr(config, name) for name in AgentOptions.__dataclass_fields__}
    given = {name: value.expanduser() if isinstance(value, Path) else value for name, value in given.items()}
    robot = config.location("i_know", robot=config.robot or "")
    return AgentOptions(**{**given, "robot": robot, "unusual": config.unusual or "warn"})
