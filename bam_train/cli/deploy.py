"""`bam-deploy`: drive a robot with a checkpoint's frozen policy, at the environment's own rate, without torch.

A signal ends it at any moment; a signal whose exception Python discarded, as in callbacks of an import, is raised again
before the robot moves.
"""

from __future__ import annotations

import json as json_module
import math
import pkgutil
from contextlib import nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import can_ask, can_draw, make_console, say, tell
from bam_train.cli.program import run_program
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from collections.abc import Mapping

    import gymnasium as gym

    from bam_envs.core.location import Location
    from bam_train.checkpoint import Checkpoint
    from bam_train.cli.flags import DeployConfig
    from bam_train.data.recorded_episode import DataSetInfo
    from bam_train.deploy.checkpoint_admission import Admission
    from bam_train.deploy.deployment import Deployment
    from bam_train.policy.policy_link import PolicyLink
    from bam_train.recording.recorder import Recorder


FIRST_SEED = 1_000_000
"""Seed of the first episode by default, as in bam-eval."""
ANY_ROBOT = "ws://127.0.0.1:9090"
"""Address for showing the guards of a robot whose address is not given; nothing is connected."""


def deploy_checkpoint(config: DeployConfig, signals: SignalMemory) -> int:
    """Run the program with its parsed flags; a signal whose exception was lost ends it before the robot moves."""
    if config.rehearse is not None:
        return _dry_run("rehearse", config, config.rehearse)
    place = _checked_place(config)
    from bam_envs.core.timing import Pacer
    from bam_train.checkpoint import Checkpoint
    from bam_train.checkpoint.detector import DETECTOR
    from bam_train.cli.consent import connected_env
    from bam_train.deploy.checkpoint_admission import Admission
    from bam_train.deploy.deployment import Deployment
    from bam_train.deploy.journal import Journal
    from bam_train.errors import SettingsError

    checkpoint = Checkpoint.open(config.checkpoint)
    if config.print_guards:
        return _dry_run("print_guards", config, checkpoint, place)
    if config.print_contract:
        return _dry_run("print_contract", config, checkpoint, place)
    if config.unusual is not None and not checkpoint.has(DETECTOR):
        remedy = f"Add one: bam-eval {checkpoint.path} --add-detector"
        raise SettingsError(f"--unusual: {checkpoint.path} has no detector of unusual observations. {remedy}")
    trust = config.keys, config.allow_unsigned, config.trials, config.i_know
    admission = Admission(checkpoint, *trust, policy_server(config))
    options: Any = {"episodes": config.episodes, "yes": config.yes, "render": config.render, "named": config.env}
    options |= {"wiggle": config.wiggle, "motion": config.motion, "arm": config.robot_model}
    env = connected_env(checkpoint, place, signals, who="bam-deploy", admit=admission, **options)
    try:
        seed = config.seed if config.seed is not None else FIRST_SEED
        if config.seed is None and admission.trials is not None:
            seed = admission.trials.next_seed(FIRST_SEED)
        pacer = Pacer(_period(config, checkpoint, env))
        if config.unusual is not None:
            env.unwrapped.robot.react(config.unusual)  # type: ignore[attr-defined]
        facts = {"seed": seed, "address": place.text, "identity": admission.identity}
        recorder = _recorder(config, checkpoint, place, env, {**facts, "marks": ", ".join(admission.marks)})
    except BaseException:
        env.close()  # type: ignore[no-untyped-call]
        raise
    if admission.trials is not None and recorder is not None:
        admission.trials.facts["recording"] = recorder.path.name
    journal = Journal(config.episodes, marks=admission.marks)
    deployment = Deployment(env, admission.policy, pacer, journal, recorder=recorder, trials=admission.trials)
    return _run(config, checkpoint, place, deployment, signals, admission, seed)


def _dry_run(name: str, config: DeployConfig, *arguments: Any) -> int:
    """Run a function of `bam_train.cli.live.dry_runs`, by name: a deployment needs nothing of it."""
    return int(pkgutil.resolve_name(f"bam_train.cli.live.dry_runs:{name}")(config, *arguments))


def _run(
    config: DeployConfig,
    checkpoint: Checkpoint,
    place: Location,
    deployment: Deployment,
    signals: SignalMemory,
    admission: Admission,
    seed: int,
) -> int:
    """Run the deployment and report it, also after a signal; returns the exit status."""
    from bam_envs.core.robot_env import robot_of
    from bam_train.cli.consent import guards_of, say_agent_rests
    from bam_train.cli.deploy_display import PlainDeployment, live_display
    from bam_train.deploy.journal import DeployReport

    env, journal, pacer = deployment.env, deployment.journal, deployment.pacer
    title = f"{checkpoint.path} on {checkpoint.manifest.env}{place.text and f' at {place.text}'}{journal.marked}"
    with deployment.handles_signals():  # a second Ctrl-C must not lose the report
        deployment.switch.came += signals.came  # after a lost exception, the deployment ends before it begins
        plain = nullcontext(PlainDeployment(journal, say))
        with live_display(make_console(), env, title, journal) if can_draw() else plain as watcher:
            if not config.yes and can_ask():
                deployment.judge = watcher.judge
            ending = deployment.run(watcher, seed=seed)
        if ending.status:
            say(f"bam-deploy: {ending.reason}")
        where = place.text or "simulated here"
        facts: Any = {"guards": guards_of(env), "trials": deployment.trials, "recorder": deployment.recorder}
        facts |= {"shadow": admission.shadow, "identity": admission.identity}
        facts |= {"agent_guards": getattr(robot_of(env), "agent_guards", {})}
        report = DeployReport(checkpoint, seed, ending, journal, pacer, where, **facts)
        for warning in (one for one in report.warnings() if not watcher.has_written(one)):
            say(f"bam-deploy: warning: {warning}")
        tell(*([json_module.dumps(report.to_json(), allow_nan=False)] if config.json else report.lines()))
        say_agent_rests(env, "bam-deploy", config.robot)
        _add_to_data_set(config, checkpoint, env, deployment.recorder)
    return ending.status


def _add_to_data_set(
    config: DeployConfig, checkpoint: Checkpoint, env: gym.Env[Any, Any], recorder: Recorder | None
) -> None:
    """Add the recorded episodes to the data set of ``--record``; the recording stays, whatever happens."""
    if recorder is None or config.record is None:
        return
    from bam_train.data.recordings import add_recording, is_data_set
    from bam_train.errors import BamTrainError, kind_of
    from bam_train.recording.recording import Recording

    if not is_data_set(str(config.record)):
        return
    try:
        recording = Recording.open(recorder.path)
        found, notes = add_recording(recording, config.record, _info(config, checkpoint, env))
    except BamTrainError as error:
        again = f"bam-data import {config.record} {recorder.path}"
        raise BamTrainError(f"{error}. The recording is whole: run {again}", kind=kind_of(error)) from error
    for note in notes:
        say(f"bam-deploy: note: {note}")
    say(f"bam-deploy: {recorder.path} {f'is in {config.record} now' if found else 'has no whole episode to add'}")


def _info(config: DeployConfig, checkpoint: Checkpoint, env: gym.Env[Any, Any]) -> DataSetInfo:
    """What all recorded episodes have in common."""
    from bam_train.data.record_dataset import info_of

    manifest = checkpoint.manifest
    return info_of(env, config.env or manifest.env, manifest.env_kwargs, manifest.period)


def policy_server(config: DeployConfig) -> PolicyLink | None:
    """The link to the policy server of the flags, connected."""
    from bam_train.errors import SettingsError

    files = config.policy_ca_file, config.policy_token_file
    if config.policy_server is not None:
        from bam_envs.core.location import Credentials
        from bam_train.policy.policy_link import PolicyLink

        return PolicyLink(config.policy_server, Credentials.of(*files))
    if any(files):
        raise SettingsError("--policy-token-file and --policy-ca-file are for --policy-server; give its address too")
    return None


def _checked_place(config: DeployConfig) -> Location:
    """The place of the environment by the flags; invalid flags are refused before anything is loaded."""
    from bam_train.errors import SettingsError

    if config.robot_model is not None and config.transport is not None:
        raise SettingsError("--robot-model is about an arm that this computer drives, and --transport has its own")
    if config.print_guards and config.transport is not None:
        raise SettingsError("--print-guards shows the guards of a live robot, and --transport has none; leave it out")
    if config.print_contract and (config.robot is None or config.print_guards):
        raise SettingsError(
            "--print-contract is about a live robot: give its address with --robot, and not --print-guards"
        )
    if config.print_guards and config.shadow:
        raise SettingsError("--print-guards shows what limits commands, and --shadow sends none; give one of the two")
    if config.record is not None and config.no_record:
        raise SettingsError("--record and --no-record exclude each other; give one of the two")
    if config.record is not None:
        _require_recordable(config.record)
    if config.rate is not None and config.fast:
        raise SettingsError("--fast does not wait for deadlines, so --rate has no meaning with it; give one of the two")
    place = config.location(robot=ANY_ROBOT if config.print_guards and config.robot is None else config.robot)
    if config.render:
        from bam_train.cli.consent import require_screen

        require_screen(remote=bool(place.text))
    return place


def _require_recordable(place: str) -> None:
    """Refuse a place that is neither an .mcap file nor a data set, and a data set that cannot be written here."""
    from bam_train.data.recordings import is_data_set
    from bam_train.errors import SettingsError

    if is_data_set(place):
        import pyarrow  # noqa: F401 - it is needed when the deployment has ended
    elif Path(place).suffix != ".mcap":
        raise SettingsError(
            f"--record: expected an .mcap file or a data set, a folder or a name without a suffix, found {place}"
        )


def _recorder(
    config: DeployConfig, checkpoint: Checkpoint, place: Location, env: gym.Env[Any, Any], facts: Mapping[str, Any]
) -> Recorder | None:
    """The recorder that the flags ask for, started; None for none."""
    if config.record is None and (config.no_record or config.robot is None):
        return None
    from bam_envs.core.location import LiveRobot
    from bam_train.cli.consent import LIVE
    from bam_train.data.recordings import is_data_set, require_addable
    from bam_train.deploy.checkpoint_admission import has_real_robot
    from bam_train.deploy.flight import deployment_facts, flight_recorder, recording_names

    if config.record is not None and is_data_set(str(config.record)):
        require_addable(config.record, _info(config, checkpoint, env))
    if config.record is None or is_data_set(str(config.record)):
        path, *others = recording_names(checkpoint.manifest.env)
    else:
        path, others = Path(config.record).expanduser(), []
    recorder = flight_recorder(path, env, {**deployment_facts(checkpoint, env), **facts}, others)
    recorder.start()
    if has_real_robot(env):
        recorder.event("nobody was asked before the robot moves (--yes)" if config.yes else "the operator lets it move")
    if isinstance(place, LiveRobot):
        for warning in import_module(LIVE).watch_cameras(recorder, place):
            say(f"bam-deploy: warning: {warning}")
    return recorder


def _period(config: DeployConfig, checkpoint: Checkpoint, env: gym.Env[Any, Any]) -> float | None:
    """Time between two actions [s], by the flags, the environment or the checkpoint; None for no waiting."""
    from bam_train.environments import control_period
    from bam_train.errors import SettingsError

    if config.fast:
        return None
    usual = control_period(env) or checkpoint.manifest.period
    if config.rate is None and usual is None:
        raise SettingsError(f"{checkpoint.manifest.env} does not say its rate; give --rate HZ, or --fast not to wait")
    if config.rate is not None and usual is not None and not math.isclose(config.rate * usual, 1.0, rel_tol=1e-6):
        say(f"bam-deploy: warning: {config.rate:g} Hz is requested, and the policy was made for {1 / usual:g} Hz")
    return usual if config.rate is None else 1 / config.rate


main = partial(run_program, "bam-deploy", "bam_train.cli.flags:DeployConfig", deploy_checkpoint)

if __name__ == "__main__":
    main()
