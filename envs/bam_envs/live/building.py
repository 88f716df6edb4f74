"""The one function that builds a live robot: a `RosbridgeRobot` behind the guards of a `SafeRobot`."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import RobotSpec
from bam_envs.live.rosbridge_robot import RosbridgeRobot
from bam_envs.live.shadow_robot import ShadowRobot
from bam_envs.robots.profile import load_profile, profile_for
from bam_envs.ros.profile_tables import RobotProfile
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Limits, ToolPosition, limits_of


def live_robot(
    url: str | Any,
    spec: RobotSpec | None = None,
    *,
    profile: RobotProfile | str | Path | None = None,
    limits: Limits | None = None,
    guards: Mapping[str, float] | None = None,
    trial: bool = False,
    tool_position: ToolPosition | None = None,
    straight: bool = False,
    command: str | None = None,
    ca_file: str | None = None,
    token_file: str | None = None,
    robot_name: str = "",
) -> SafeRobot:
    """A live robot behind its guards. Nothing is connected yet.

    Args:
        url: ``ws://host:port`` or ``wss://host:port``, followed by the namespace of its topics, if any. Or a connected
            `roslibpy.Ros` of the asyncio transport: states and commands go over it, halts and images over connections
            of their own to its server.
        spec: Signals and commands that the task needs; None: all of the profile that are not optional.
        profile: The profile of its topics: a shipped name or a file. None: the shipped one with the commands of `spec`.
        limits: The limits of the guards; None: those of the profile.
        guards: Some of them by name, which override the others, such as ``{"joint_speed": 0.3}``.
        trial: Whether it is on trial: slow, and in a box around its start; see `Limits.on_trial`.
        tool_position: Forward kinematics of an arm other than a UR5e, (n, k) [rad] to (n, 3) [m].
        straight: Whether the commands move the tool along straight lines, so that singularities count.
        command: Command mode, such as ``"trajectory"``; None: the profile's default.
        ca_file: PEM file of the authorities to trust instead of the system's.
        token_file: File with the server's shared secret.
        robot_name: Name of the robot, where it does not tell its serial number or a name; connecting to a robot that
            tells another one is refused.

    Raises:
        InvalidValue: The address is not that of a robot, a file cannot be read, or the profile lacks a signal or
            command of `spec`; or a limit is outside its bounds, contradicts another one, or changes no guard.
        UnknownName: There is no such profile, command mode or limit.
    """
    endpoint, ros = _server(url, ca_file, token_file, robot_name)
    chosen = _chosen(profile, spec)
    robot = RosbridgeRobot(endpoint, chosen, spec=spec, command=command, ros=ros)
    chosen_limits = limits or profile_limits(chosen)
    if guards is not None:
        chosen_limits = chosen_limits.changed(guards)
    if trial:
        chosen_limits = chosen_limits.on_trial(base=chosen.kind == "base")
    safe = SafeRobot(robot, limits=chosen_limits, tool_position=tool_position, straight=straight)
    require_effect(safe, guards or {})
    return safe


def shadow_robot(
    url: str | Any,
    spec: RobotSpec | None = None,
    *,
    profile: RobotProfile | str | Path | None = None,
    guards: Mapping[str, float] | None = None,
    ca_file: str | None = None,
    token_file: str | None = None,
    robot_name: str = "",
) -> ShadowRobot:
    """A live robot that somebody else drives: its states are read, and nothing is sent. Arguments: see `live_robot`."""
    endpoint, ros = _server(url, ca_file, token_file, robot_name)
    chosen = _chosen(profile, spec)
    limits = profile_limits(chosen).changed({} if guards is None else guards)
    return ShadowRobot(endpoint, chosen, spec=spec, limits=limits, ros=ros)


def _server(
    robot: str | Any, ca_file: str | None, token_file: str | None, robot_name: str
) -> tuple[Endpoint, Any | None]:
    """The server of a robot, by its address or by a `roslibpy.Ros`, and the latter."""
    if isinstance(robot, str):
        require_robot_address(robot)
        return Endpoint.with_token_file(robot, ca_file=ca_file, token_file=token_file, robot_name=robot_name), None
    if ca_file is not None or token_file is not None:
        raise InvalidValue("ca_file= and token_file= are for an address; a roslibpy.Ros has made its connection.")
    from bam_envs.rosbridge.user_ros import endpoint_of

    return endpoint_of(robot, robot_name), robot


def _chosen(profile: RobotProfile | str | Path | None, spec: RobotSpec | None) -> RobotProfile:
    """The profile that is named, or the one for `spec`."""
    if profile is None and spec is not None:
        return profile_for(spec)
    return profile if isinstance(profile, RobotProfile) else load_profile("ur5e" if profile is None else profile)


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
