"""The entry points of `gymnasium.make` and `gymnasium.make_vec`: a robot and its task, simulated, live or remote.

Live robots, remote environments and Gymnasium's vector environments are imported on use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.location import Credentials, LiveRobot, Location, Remote, location_of
from bam_envs.core.registry import ENVIRONMENTS, MAKE_OPTIONS, EnvEntry, entry_of, own_options
from bam_envs.core.validation import PositiveInt, check

if TYPE_CHECKING:
    from bam_envs.core.robot import Robot
    from bam_envs.core.robot_env import RobotVectorEnv
    from bam_envs.core.task import Task
    from bam_envs.remote.remote_env import RemoteVectorEnv


def make_env(
    env_id: str,
    *,
    render_mode: str | None = None,
    randomize: bool = False,
    link: Any = None,
    action_delay: Any = None,
    robot: str | Any | None = None,
    transport: str | None = None,
    profile: str | None = None,
    guards: Mapping[str, float] | None = None,
    trial: bool = False,
    shadow: bool = False,
    robot_name: str = "",
    ca_file: str | None = None,
    token_file: str | None = None,
    timeout: float | None = None,
    **task_options: Any,
) -> gym.Env[Any, Any]:
    """One robot and its task; the entry point of `gymnasium.make`.

    Args:
        env_id: Key of `ENVIRONMENTS` or of `ALIASES`.
        render_mode: Render mode of the simulated robot.
        randomize: Whether the physics of the simulated robot is randomized.
        link: The link that the simulated robot is behind: ``"wifi"``, ``"lte"``, ``"bad"``, a JSON file or a table of
            `LinkProfile`; None for no link.
        action_delay: Steps by which the actions of a simulation are late, or the least and the greatest number of
            them, drawn for each episode.
        robot: Address of a live robot behind rosbridge, such as ``"ws://10.0.0.5:9090"``, instead of the simulated one.
            The task runs in this process. A path in the address is the namespace of the robot's topics. Or a connected
            `roslibpy.Ros` of the asyncio transport; or a `LiveRobot` with all that the next five arguments say.
        transport: Address of a whole environment that runs elsewhere, such as ``"ws://10.0.0.5:9090/bam_001"`` or
            ``"tcp://10.0.0.5:9091"``; then this process has no robot and no task.
        profile: Profile of the live robot: a shipped name or a file; by default that of the simulated robot.
        guards: Limits of the live robot's guards that differ from its profile's, such as ``{"joint_speed": 0.3}``.
        trial: Whether the live robot is on trial: slow, and in a box around its start.
        shadow: Whether somebody else drives the live robot: its states are read, and nothing is sent.
        robot_name: Name of the live robot, where it does not tell its serial number or a name.
        ca_file: Certificates that ``wss://`` trusts instead of the system's.
        token_file: File with the server's token.
        timeout: Longest wait for an answer of `transport` [s]; 30 by default.
        task_options: Arguments of the task.

    Raises:
        InvalidValue: Arguments that exclude each other.
    """
    where = {"robot": robot, "transport": transport, "profile": profile, "guards": guards, "robot_name": robot_name}
    where |= {"trial": trial, "shadow": shadow, "timeout": timeout, "ca_file": ca_file, "token_file": token_file}
    where |= {"render_mode": render_mode, "randomize": randomize, "link": link, "action_delay": action_delay}
    place = _location(where, task_options)
    if isinstance(place, Remote):
        from bam_envs.remote.remote_env import make_remote_env

        return make_remote_env(env_id, place)
    from bam_envs.core.robot_env import RobotEnv

    entry, task_options = _named(env_id, task_options)
    _require_robot(entry, robot=robot, randomize=randomize or None, link=link, action_delay=action_delay)
    task = entry.make_task(1, task_options)
    simulation = entry.make_robot(1, randomize, task_options)
    if not isinstance(place, LiveRobot):
        return RobotEnv(_behind(link, simulation), _late(action_delay, task), render_mode=render_mode)
    if place.stage == "shadow":
        return RobotEnv(resolve_name("bam_envs.live:shadow_robot")(place, simulation.spec), task)
    tool = getattr(simulation, "tool_position", None)  # forward kinematics of an arm that is no UR5e
    straight = getattr(task, "moves_straight", False)
    return RobotEnv(
        resolve_name("bam_envs.live:live_robot")(place, simulation.spec, tool_position=tool, straight=straight), task
    )


def _location(options: Mapping[str, Any], task_options: Mapping[str, Any]) -> Location:
    """Where the `MAKE_OPTIONS` of an environment put it; a task elsewhere takes no options from here."""
    place = location_of(options, Credentials(options["ca_file"], options["token_file"]))
    if isinstance(place, Remote) and task_options:
        names = ", ".join(task_options)
        raise InvalidValue(f"{names}: the task runs at {place.text}; give its options to bam-serve there.")
    return place


def _named(env_id: str, options: Mapping[str, Any]) -> tuple[EnvEntry, dict[str, Any]]:
    """The entry of an environment and its options, under their own names.

    Raises:
        UnknownName: There is no such environment.
    """
    entry = entry_of(env_id)
    if entry is None:
        raise UnknownName("environment", env_id, ENVIRONMENTS)
    return entry, own_options(env_id, options)


def _require_robot(entry: EnvEntry, **given: object) -> None:
    """Refuse the options of a robot where there is none."""
    kind, differs = ("live robot", "randomize") if entry.simulated_only else ("robot", "")
    names = [name for name, value in given.items() if value is not None and name != differs]
    if names and not entry.has_robot:
        raise InvalidValue(f"{entry.id} has no {kind}: leave out {', '.join(names)}.")


def _behind(link: Any, robot: Robot) -> Robot:
    """The simulated robots behind `link`, or as they are."""
    if link is None:
        return robot
    from bam_envs.robots.linked import LinkedRobot, link_profile

    return LinkedRobot(robot, link_profile(link))


def _late(action_delay: Any, task: Task) -> Task:
    """The task with late actions, or as it is."""
    if action_delay is None:
        return task
    from bam_envs.tasks.task_wrappers import LateActions, read_delay

    late: Any = LateActions(task, read_delay(action_delay))  # most members are the task's own
    return late  # type: ignore[no-any-return]


def make_vector_env(
    env_id: str,
    num_envs: int = 1,
    *,
    max_episode_steps: int | None = None,
    robot: str | None = None,
    transport: str | Sequence[str] | None = None,
    **options: Any,
) -> RobotVectorEnv | RemoteVectorEnv:
    """Simulated robots and their task, stepped together; the entry point of `gymnasium.make_vec`.

    With `transport`, one address or several, they run elsewhere; each server steps its environments in one request. The
    other `options` are those of `make_env`.

    Raises:
        InvalidValue: Arguments that exclude each other, or environments that are not there.
    """
    check(num_envs, PositiveInt, "num_envs")
    if robot is not None:
        raise InvalidValue("A live robot is one environment, which nothing may reset unasked; use gymnasium.make.")
    given = {name: options.pop(name, None) for name in MAKE_OPTIONS}
    place = _location({**given, "transport": transport}, options)
    if isinstance(place, Remote):
        from bam_envs.remote.remote_env import make_remote_vector_env

        return make_remote_vector_env(env_id, place, num_envs)
    from bam_envs.core.robot_env import RobotVectorEnv

    entry, task_options = _named(env_id, options)
    link, action_delay, randomize = given["link"], given["action_delay"], given["randomize"] or False
    _require_robot(entry, randomize=randomize or None, link=link, action_delay=action_delay)
    return RobotVectorEnv(
        _behind(link, entry.make_robot(num_envs, randomize, task_options)),
        _late(action_delay, entry.make_task(num_envs, task_options)),
        max_episode_steps=max_episode_steps,
        render_mode=given["render_mode"],
    )
