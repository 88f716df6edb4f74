"""`bam-doctor`: check a live robot step by step without moving it, and measure the link to it."""

from __future__ import annotations

import json as json_module
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import say, tell
from bam_train.cli.program import run_program
from bam_train.errors import ContractRefused
from bam_train.files.log_lines import counted
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bam_envs.core.location import LiveRobot
    from bam_envs.live.diagnosis import Diagnosis, DiagnosisStep, Findings
    from bam_envs.live.examination import Inspection
    from bam_train.checkpoint import Checkpoint
    from bam_train.cli.flags import DoctorConfig
    from bam_train.deploy.contract import Contract

CONTRACT, DESCRIPTION = "contract", "description"
"""Name of the last step, with a checkpoint, and without."""


def examine(config: DoctorConfig, signals: SignalMemory) -> int:
    """Run the program with its parsed flags; returns the exit status, also 1 if --measure wrote no file."""
    _require_valid(config)
    from bam_envs.core.location import LiveRobot, serving
    from bam_envs.live.diagnosis import STEPS, Diagnosis
    from bam_envs.robots.profile import described_spec, fitting_profile, profile_for
    from bam_envs.safety.guard import is_base

    place = LiveRobot(config.url, config.credentials, config.profile)
    contracts: list[Contract] = []  # one, once it was checked
    with ExitStack() as opened:
        robot, more = None, [(DESCRIPTION, lambda inspection: _description(config, inspection, contracts))]
        if config.checkpoint is not None:
            checkpoint, env = _opened(config, place)
            opened.callback(env.close)
            robot = env.unwrapped.robot
            place = replace(place, stand_in=serving(env.spec.id, env.spec.kwargs.get("robot_model")))
            more = [(CONTRACT, lambda inspection: _contract(checkpoint, env, inspection, contracts))]
        elif config.robot_model is not None:
            spec, named = described_spec(config.robot_model), config.profile
            place = replace(place, profile=profile_for(spec) if named is None else fitting_profile(named, spec))
            task = "bam/navigation" if is_base(spec) else "bam/pick"
            place = replace(place, stand_in=serving(task, config.robot_model))
        diagnosis = Diagnosis(place, robot, seconds=config.seconds)
        opened.callback(diagnosis.close)
        steps: list[DiagnosisStep] = []
        for step in _shown(diagnosis.steps(*more), config):
            steps.append(step)
            signals.raise_again()
    if contracts and not config.json:
        tell(*(f"  {line}" for line in contracts[0].lines()))
    names = [*STEPS, *(name for name, _ in more)]
    failed = next((step for step in steps if step.verdict == "failed"), None)
    measured = _write_measured(config, diagnosis)
    if config.json:
        report = {
            "address": config.url,
            "profile": None if diagnosis.profile is None else diagnosis.profile.name,
            "steps": [asdict(step) for step in steps],
            "not_tried": [] if failed is None else names[len(steps) :],
            "failed": None if failed is None else failed.name,
            "contract": contracts[0].to_json() if contracts else None,
            "measured": measured,
        }
        tell(json_module.dumps(report, allow_nan=False))
    if failed is None:
        return 1 if config.measure is not None and measured is None else 0
    say(f"bam-doctor: {failed.name} failed: {failed.found}")
    return ContractRefused.exit_status if contracts and contracts[0].refused else 1


def _opened(config: DoctorConfig, place: LiveRobot) -> tuple[Checkpoint, Any]:
    """The checkpoint of the flags, and its environment for the robot, not connected."""
    from bam_train.checkpoint import Checkpoint
    from bam_train.environments import environment_of, make_env

    checkpoint = Checkpoint.open(config.checkpoint or "")
    return checkpoint, make_env(*environment_of(checkpoint, config.env), place=place)


def _contract(checkpoint: Checkpoint, env: Any, inspection: Inspection, contracts: list[Contract]) -> Findings:
    """The last step, which fails if the checkpoint and the robot do not fit; adds the contract to `contracts`."""
    from bam_train.deploy.contract import contract_with

    return _required(contract_with(checkpoint, env, inspection), str(checkpoint.path), contracts)


def _description(config: DoctorConfig, inspection: Inspection, contracts: list[Contract]) -> Findings | None:
    """The last step without a checkpoint: the URDF of the robot is that of the arm of the flags, or of the profile.

    None for a base, and for a Universal Robots arm that no flag names: all of them have one profile.
    """
    from bam_envs.arms.description import ArmDescription
    from bam_envs.core.robot_models import Description, find_model, known_models
    from bam_envs.live.arm_checks import described_checks
    from bam_envs.live.building import profile_limits
    from bam_train.deploy.contract import Contract

    profile = inspection.profile
    name = config.robot_model or (profile.robot if profile.robot in known_models() else "")
    arm = find_model(name, Description) if name else None
    if not isinstance(arm, ArmDescription) or (config.robot_model is None and arm.geometry):
        return None
    margin = profile_limits(profile).position_margin
    checks = described_checks(arm.spec(with_object=False), arm.chain, margin, inspection)
    return _required(Contract(tuple(checks), inspection), f"the description of {arm.name}", contracts)


def _required(contract: Contract, whose: str, contracts: list[Contract]) -> Findings:
    """What a contract found, which is added to `contracts`; `NotReady` if it is refused."""
    from bam_envs.core.errors import NotReady
    from bam_envs.core.wording import listed

    contracts.append(contract)
    try:
        contract.require(f"{whose} and the robot")
    except ContractRefused as error:
        raise NotReady(str(error)) from error
    unknown = [line.what for line in contract.checks if line.verdict == "unknown"]
    return [counted(len(contract.checks), "line")], [f"unknown: {listed(unknown)}"] if unknown else []


def _shown(steps: Iterator[DiagnosisStep], config: DoctorConfig) -> Iterator[DiagnosisStep]:
    """The steps, each printed at once unless JSON is requested."""
    for step in steps:
        if not config.json:
            text = "" if step.verdict == "failed" else step.found  # a cause is printed last, on standard error
            lines = [f"{step.name:<16}{step.verdict:<9}{text}".rstrip()]
            tell(*lines, *(f"{'':<25}warning: {warning}" for warning in step.warnings))
        yield step


def _require_valid(config: DoctorConfig) -> None:
    from bam_train.errors import SettingsError
    from bam_train.files.atomic_file import require_writable

    if config.robot_model is not None and config.checkpoint is not None:
        raise SettingsError("--robot-model and --checkpoint each name an arm; give one of them")
    if config.env is not None and config.checkpoint is None:
        raise SettingsError("--env says what a checkpoint was trained on; give --checkpoint too, or leave it out")
    if config.measure is None:
        return
    if config.measure.suffix != ".json":
        raise SettingsError(f"--measure: expected a .json file, found {str(config.measure)!r}")
    require_writable(config.measure)


def _write_measured(config: DoctorConfig, diagnosis: Diagnosis) -> dict[str, Any] | None:
    """Write the link as a `LinkProfile`, and return it as JSON values; None if it was not measured or requested."""
    if config.measure is None:
        return None
    from bam_envs.core.errors import InvalidValue
    from bam_envs.live.examination import measured_link
    from bam_train.errors import OutputError
    from bam_train.files.atomic_file import replacing

    inspection, path = diagnosis.inspection, config.measure.expanduser()
    if inspection is None:
        say(f"bam-doctor: {path} was not written: the link was not measured")
        return None
    busy = f"; {inspection.busy}" if inspection.busy else ""
    about = f"{config.url}, {len(inspection.trips)} pings in {inspection.seconds:.1f} s{busy}"
    try:
        link = measured_link(inspection.trips, inspection.copies, next(iter(inspection.readings.values())), about)
        with replacing(path) as temporary:
            temporary.write_text(link.to_json() + "\n")
    except InvalidValue as error:
        say(f"bam-doctor: {path} was not written: {error}")
        return None
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
    if not config.json:
        then = (
            "end other programs, and measure again" if busy else f"try it with bam-deploy CHECKPOINT --rehearse {path}"
        )
        tell(f"{path}: the measured link{busy}; {then}")
    return asdict(link)


main = partial(run_program, "bam-doctor", "bam_train.cli.flags:DoctorConfig", examine)

if __name__ == "__main__":
    main()
