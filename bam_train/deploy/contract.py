"""The contract between a checkpoint and a live robot, checked before anything moves.

The checkpoint's environment, spaces, signals and period are compared with the environment as made; its topics, units,
ranges, rates and kinematics with the messages of the robot, which is sent no command.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from bam_envs.core.robot import RobotSpec
from bam_envs.live.bringup import TIMEOUT
from bam_envs.live.inspection import Inspection, inspect_robot
from bam_envs.robots.profile import load_profile, profile_for
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.safety.guard import is_base
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.arm_checks import arm_checks, geometry_of
from bam_train.deploy.contract_table import Check, Contract, check
from bam_train.deploy.robot_checks import robot_checks
from bam_train.env_location import EnvLocation
from bam_train.environments import first_difference, fit_pairs, short_json


def check_contract(
    checkpoint: Checkpoint, env: Any, place: EnvLocation, *, listen: float | None = None, timeout: float = TIMEOUT
) -> Contract:
    """Compare a checkpoint with the live robot at `place`; sends nothing, moves nothing.

    Args:
        checkpoint: The checkpoint of the policy that would act.
        env: Its environment, made for `place`; it need not be connected.
        place: The address and the profile of the robot.
        listen: Time for which messages are collected [s]; None: derived from the ages that the profile allows.
        timeout: Longest wait for a silent topic [s].

    Raises:
        NoServer: There is no usable server at the address.
        LinkLost: The link dropped.
        InvalidValue: The robot is another one than `place` names.
    """
    spec: RobotSpec = env.unwrapped.robot.spec
    profile = profile_for(spec) if place.profile is None else load_profile(place.profile)
    endpoint = Endpoint.with_token_file(
        place.robot or "", ca_file=place.ca_file, token_file=place.token_file, robot_name=place.robot_name
    )
    inspection = inspect_robot(endpoint, profile, spec, listen=listen, timeout=timeout)
    return Contract((*fit_checks(checkpoint, env), *live_checks(env, profile, inspection)), inspection)


def live_checks(env: Any, profile: Any, inspection: Inspection) -> Iterator[Check]:
    """The lines about the robot itself: `inspection` against the robot and the task of `env`."""
    robot = env.unwrapped.robot
    yield from robot_checks(profile, robot.spec, inspection)
    geometry = geometry_of(env)
    if not is_base(robot.spec) and geometry is not None:
        yield from arm_checks(robot.spec, geometry, robot.limits.position_margin, inspection)


def fit_checks(checkpoint: Checkpoint, env: Any) -> Iterator[Check]:
    """The lines about the environment: its spaces, signals and period as the checkpoint has them."""
    env_id = env.spec.id if env.spec is not None else checkpoint.manifest.env
    yield check("environment", checkpoint.manifest.env, env_id, fits=True)
    for name, saved, present in fit_pairs(checkpoint, env):
        what, difference = name.replace("_", " "), first_difference(saved, present, "")
        if difference is None:
            yield check(what, _in_short(saved), _in_short(present), fits=True)
        else:
            at, expected, found = difference
            yield check(f"{what}{at}", short_json(expected), short_json(found), fits=False)


def _in_short(value: Any) -> str:
    """Short text: type and shape of a space, number of signals, or a number."""
    if not isinstance(value, Mapping):
        return f"{value:g}"
    if "type" in value:
        return f"{value['type']} {value.get('shape', value.get('n', ''))}".rstrip()
    return f"{sum(map(len, value.values()))} names and units"
