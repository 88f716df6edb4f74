"""The contract between a checkpoint and a live robot, checked before anything moves.

The checkpoint's environment, spaces, signals and period are compared with the environment as made; its topics, units,
ranges, rates and kinematics with what the robot shows to a client that only listens.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from bam_envs.core.robot import RobotSpec
from bam_envs.live.bringup import TIMEOUT
from bam_envs.live.evidence import Evidence, gather
from bam_envs.robots.profile import load_profile, profile_for
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.safety.guard import is_base
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.arm_checks import arm_checks, geometry_of
from bam_train.deploy.contract_table import Check, Contract, check, joined
from bam_train.deploy.robot_checks import robot_checks
from bam_train.env_location import Place
from bam_train.environments import first_difference, fit_pairs, short_json


def check_contract(
    checkpoint: Checkpoint, env: Any, place: Place, *, listen: float | None = None, timeout: float = TIMEOUT
) -> Contract:
    """Compare a checkpoint with the live robot at `place`; sends nothing, moves nothing.

    Args:
        checkpoint: The checkpoint of the policy that would act.
        env: Its environment, made for `place`; it need not be connected.
        place: The address and the profile of the robot.
        listen: Time for which messages are collected [s]; None: by the ages that the profile allows.
        timeout: Longest wait for a silent topic [s].

    Raises:
        NoServer: There is no usable server at the address.
        LinkLost: The link dropped.
    """
    spec: RobotSpec = env.unwrapped.robot.spec
    profile = profile_for(spec) if place.profile is None else load_profile(place.profile)
    endpoint = Endpoint.with_token_file(place.robot or "", ca_file=place.ca_file, token_file=place.token_file)
    evidence = gather(endpoint, profile, spec, listen=listen, timeout=timeout)
    return replace(joined(fit_checks(checkpoint, env), live_checks(env, profile, evidence)), evidence=evidence)


def live_checks(env: Any, profile: Any, evidence: Evidence) -> Iterator[Check]:
    """The lines about the robot itself: `evidence` against the robot and the task of `env`."""
    robot = env.unwrapped.robot
    yield from robot_checks(profile, robot.spec, evidence)
    geometry = geometry_of(env)
    if not is_base(robot.spec) and geometry is not None:
        yield from arm_checks(robot.spec, geometry, robot.limits.position_margin, evidence)


def fit_checks(checkpoint: Checkpoint, env: Any) -> Iterator[Check]:
    """The lines about the environment: its spaces, signals and period as the checkpoint has them."""
    made = env.spec.id if env.spec is not None else checkpoint.manifest.env
    yield check("environment", checkpoint.manifest.env, made, fits=True)
    for name, theirs, ours in fit_pairs(checkpoint, env):
        what, difference = name.replace("_", " "), first_difference(theirs, ours, "")
        if difference is None:
            yield check(what, _in_short(theirs), _in_short(ours), fits=True)
        else:
            at, expected, found = difference
            yield check(f"{what}{at}", short_json(expected), short_json(found), fits=False)


def _in_short(value: Any) -> str:
    """A space by its type and shape, signals by their number."""
    if not isinstance(value, Mapping):
        return f"{value:g}"
    if "type" in value:
        return f"{value['type']} {value.get('shape', value.get('n', ''))}".rstrip()
    return f"{sum(map(len, value.values()))} names and units"
