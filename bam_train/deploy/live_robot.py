"""What a live robot adds to a deployment: its contract is required, its axes are proved, its cameras are recorded.

`bam_train.cli` imports it by name where the robot is live, so that a deployment with a simulated robot, on a computer
that knows no robot, imports nothing of `bam_envs.live` and `bam_envs.rosbridge`.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.location import LiveRobot
from bam_envs.live.arm_checks import measured_joints
from bam_envs.live.camera import LiveCamera
from bam_envs.live.examination import Inspection
from bam_envs.robots.profile import load_profile
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.safety.guard import is_base
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.contract import Contract, check_contract
from bam_train.deploy.wiggle import recorded_motion, wiggle
from bam_train.recording.recorder import Recorder

Say = Callable[[str], None]
"""Shows one line to the operator."""


def required_contract(checkpoint: Checkpoint, env: Any, place: LiveRobot, motion: Path | None, say: Say) -> Contract:
    """The contract of a checkpoint with a live robot, shown in short if it is real or refused; moves nothing.

    With `motion`, a recording of the robot, each axis must have moved in it as commanded.

    Raises:
        ContractRefused: They do not fit; the table is shown.
    """
    contract = check_contract(checkpoint, env, place)
    info = None if contract.inspection is None else contract.inspection.info
    shown = contract.lines(whole=False) if contract.refused or info is None or not info.simulated else []
    if motion is not None:
        moved = Contract(tuple(recorded_motion(motion, env.unwrapped.robot.spec, place.text, contract.identity)))
        contract = replace(contract, checks=(*contract.checks, *moved.checks))
        shown += moved.lines()
    for line in shown:
        say(line)
    contract.require(f"{checkpoint.path} and the robot at {place.text}")
    return contract


def require_motion(env: Any, who: str, inspection: Inspection, say: Say) -> None:
    """Move each axis a little; raises `ContractRefused` if an axis does not move as commanded."""
    robot = env.unwrapped.robot
    joints = None if is_base(robot.spec) else measured_joints(inspection, robot.spec)
    moved = Contract(tuple(wiggle(robot, None if joints is None else joints[-1])))
    for line in moved.lines():
        say(line)
    moved.require(who, "the robot has moved a little, and was halted")


def watch_cameras(recorder: Recorder, place: LiveRobot) -> Iterator[str]:
    """Connect and record the cameras of the profile that a user gave; yields a warning for each camera left out."""
    sources = () if place.profile is None else load_profile(place.profile).cameras
    for source in (one for one in sources if not one.optional):
        camera = LiveCamera(Endpoint.of(place), source)
        try:
            camera.connect()
        except BamEnvsError as error:
            yield f"camera {source.name} is not recorded: {error}"
            continue
        recorder.watch(camera)
        if camera.file() is None:
            yield f"camera {source.name} sends no PNG or JPEG, and is not recorded"
