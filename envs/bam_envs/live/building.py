"""The one function that builds a live robot: a `RosbridgeRobot` behind the guards of a `SafeRobot`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bam_envs.arms.description import ArmDescription, robot_model
from bam_envs.core.errors import InvalidValue
from bam_envs.core.location import NO_CREDENTIALS, LiveRobot, require_real
from bam_envs.core.robot import RobotSpec
from bam_envs.core.robot_models import DEFAULT_ARM, known_models
from bam_envs.live.rosbridge_robot import RosbridgeRobot
from bam_envs.live.shadow_robot import ShadowRobot
from bam_envs.robots.profile import fitting_profile, load_profile, profile_for
from bam_envs.ros.profile_tables import RobotProfile
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Limits, ToolPosition, limits_of


def live_robot(
    at: LiveRobot | str | Any,
    spec: RobotSpec | None = None,
    *,
    limits: Limits | None = None,
    tool_position: ToolPosition | None = None,
    straight: bool = False,
    command: str | None = None,
    **options: Any,
) -> SafeRobot:
    """A live robot behind its guards. Nothing is connected yet.

    Args:
        at: Where it is; or its address, or a connected `roslibpy.Ros`, to which `options` belong.
        spec: Signals and commands that the task needs; None: all of the profile that are not optional.
        limits: The limits of the guards; None: those of the profile.
        tool_position: Forward kinematics of an arm other than a UR5e, (n, k) [rad] to (n, 3) [m]; None: those of the
            described arm of the profile.
        straight: Whether the commands move the tool along straight lines, so that singularities count.
        command: Command mode, such as ``"trajectory"``; None: the profile's default.
        options: Fields of `LiveRobot`, such as ``guards={"joint_speed": 0.3}``.

    Raises:
        InvalidValue: The address is not that of a robot, a file cannot be read, or the profile lacks a signal or
            command of `spec`; or a limit is outside its bounds, contradicts another one, or changes no guard.
        UnknownName: There is no such profile, command mode or limit.
    """
    place = at if isinstance(at, LiveRobot) else LiveRobot(at, **options)
    endpoint, ros = _server(place)
    chosen = _chosen(place.profile, spec)
    if tool_position is None and chosen.robot != DEFAULT_ARM and chosen.robot in known_models(ArmDescription):
        tool_position = robot_model(chosen.robot).arm.tool_position
    robot = RosbridgeRobot(endpoint, chosen, spec=spec, command=command, ros=ros)
    chosen_limits = limits or profile_limits(chosen)
    if place.guards != {}:
        chosen_limits = chosen_limits.changed(place.guards)
    if place.stage == "trial":
        chosen_limits = chosen_limits.on_trial(base=chosen.kind == "base")
    safe = SafeRobot(robot, limits=chosen_limits, tool_position=tool_position, straight=straight)
    require_effect(safe, place.guards)
    return safe


def shadow_robot(at: LiveRobot, spec: RobotSpec | None = None) -> ShadowRobot:
    """A live robot that somebody else drives: its states are read, and nothing is sent. Arguments: see `live_robot`."""
    endpoint, ros = _server(at)
    chosen = _chosen(at.profile, spec)
    return ShadowRobot(endpoint, chosen, spec=spec, limits=profile_limits(chosen).changed(at.guards), ros=ros)


def _server(at: LiveRobot) -> tuple[Endpoint, Any | None]:
    """The server of a robot, by its address or by a `roslibpy.Ros`, and the latter."""
    if isinstance(at.url, str):
        require_robot_address(at.url)
        return Endpoint.of(at), None
    if at.credentials != NO_CREDENTIALS:
        raise InvalidValue("ca_file= and token_file= are for an address; a roslibpy.Ros has made its connection.")
    from bam_envs.rosbridge.user_ros import endpoint_of

    return endpoint_of(at.url, at.robot_name), at.url


def _chosen(profile: RobotProfile | str | Path | None, spec: RobotSpec | None) -> RobotProfile:
    """The profile that is named, or the one for `spec`."""
    if profile is None and spec is not None:
        return profile_for(spec)
    if isinstance(profile, RobotProfile):
        return profile
    name = "ur5e" if profile is None else profile
    return load_profile(name) if spec is None else fitting_profile(name, spec)


def profile_limits(profile: RobotProfile) -> Limits:
    """The limits of the guards for a robot of `profile`."""
    return Limits.of({"max_age": profile.max_age, **profile.limits})


def require_effect(robot: SafeRobot, limits: Iterable[str]) -> None:
    """`InvalidValue` if a guard that one of the `limits` changes is not among those of `robot`, or is off."""
    useful = limits_of(robot.guards())
    for name in limits:
        if name not in useful:
            raise InvalidValue(
                f"The limit {name} would change nothing: {robot.spec.name} has no guard for it in this task. Leave it "
                "out; bam-deploy --print-guards lists the guards."
            )


def require_robot_address(url: str) -> None:
    """Check the form of a live robot's address; `InvalidValue` names the expected form."""
    require_real(url)
    scheme, separator, rest = url.partition("://")
    if separator and scheme in ("ws", "wss"):
        return
    expected = "A live robot's address is ws://host:port or wss://host:port"
    if scheme in ("tcp", "ros2"):
        raise InvalidValue(
            f"{expected}; {url!r} is that of a whole environment. Give it as transport={url!r} (--transport)."
        )
    address = rest if separator else url
    if not address:
        raise InvalidValue(f"{expected}, such as ws://10.0.0.5:9090, not {url!r}.")
    raise InvalidValue(f"{expected}, not {url!r}. Did you mean {f'ws://{address}'!r}?")
