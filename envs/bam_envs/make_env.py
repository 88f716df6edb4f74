"""The entry points of `gymnasium.make` and `gymnasium.make_vec`: a robot and its task, simulated, live or remote.

Live robots, remote environments and Gymnasium's vector environments are imported on use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS, EnvEntry, entry_of, own_options
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
            `roslibpy.Ros` of the asyncio transport; see `live_robot`.
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
    if robot is not None and transport is not None:
        raise InvalidValue("robot= and transport= exclude each other: the task runs here, or with the robot elsewhere.")
    if robot is None:
        _refuse_for_simulations(profile, guards, trial, shadow, robot_name)
    if trial and shadow:
        raise InvalidValue("trial=True and shadow=True exclude each other: a shadow sends nothing. Give one of them.")
    _check_place(robot, transport, timeout, render_mode, randomize, link, action_delay, task_options)
    if transport is not None:
        from bam_envs.remote.remote_env import make_remote_env

        return make_remote_env(env_id, transport, ca_file=ca_file, token_file=token_file, timeout=timeout)
    from bam_envs.core.robot_env import RobotEnv

    entry, task_options = _named(env_id, task_options)
    _require_robot(entry, robot=robot, randomize=randomize or None, link=link, action_delay=action_delay)
    task = entry.make_task(1, task_options)
    simulated = entry.make_robot(1, randomize, task_options)
    if robot is None:
        return RobotEnv(_behind(link, simulated), _late(action_delay, task), render_mode=render_mode)
    from bam_envs.live.building import live_robot, shadow_robot

    where: dict[str, Any] = {"profile": profile, "guards": guards, "ca_file": ca_file, "token_file": token_file}
    where["robot_name"] = robot_name
    if shadow:
        return RobotEnv(shadow_robot(robot, simulated.spec, **where), task, render_mode=render_mode)
    tool = getattr(simulated, "tool_position", None)  # forward kinematics of an arm that is no UR5e
    straight = getattr(task, "moves_straight", False)
    live = live_robot(robot, simulated.spec, trial=trial, tool_position=tool, straight=straight, **where)
    return RobotEnv(live, task, render_mode=render_mode)


def _refuse_for_simulations(profile: object, guards: object, trial: bool, shadow: bool, robot_name: object) -> None:
    """Refuse options that only a live robot has."""
    if profile is not None:
        raise InvalidValue(f"profile={profile!r} describes a live robot; give its address with robot= too.")
    if robot_name:
        raise InvalidValue(f"robot_name={robot_name!r} names a live robot; give its address with robot= too.")
    if guards is not None:
        raise InvalidValue("guards= changes the limits of a live robot; give its address with robot= too.")
    if trial or shadow:
        name = "trial" if trial else "shadow"
        raise InvalidValue(f"{name}=True is for a live robot; give its address with robot= too.")


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
        raise InvalidValue(f"{entry.id} has no {kind}; leave out what is for one: {', '.join(names)}.")


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
    from bam_envs.tasks.wrappers.late_actions import LateActions, read_delay

    late: Any = LateActions(task, read_delay(action_delay))  # most members are the task's own
    return late  # type: ignore[no-any-return]


def _check_place(
    robot: str | Any | None,
    transport: object,
    timeout: float | None,
    render_mode: str | None,
    randomize: bool,
    link: object,
    action_delay: object,
    task_options: Mapping[str, Any],
) -> None:
    """Refuse options that do not apply where the environment runs."""
    if transport is None and timeout is not None:
        raise InvalidValue(f"timeout={timeout!r} limits the wait for an answer of transport=; leave it out.")
    if transport is not None and task_options:
        names = ", ".join(task_options)
        raise InvalidValue(f"{names}: the task runs at {transport}; give its options to bam-serve there.")
    elsewhere = robot if transport is None else transport
    given = {"render_mode": render_mode, "randomize": randomize or None, "link": link, "action_delay": action_delay}
    flags = [name for name, value in given.items() if value is not None]
    if elsewhere is not None and flags:
        raise InvalidValue(f"{', '.join(flags)}: only the simulation here has that, and not {elsewhere}; leave it out.")


def make_vector_env(
    env_id: str,
    num_envs: int = 1,
    *,
    max_episode_steps: int | None = None,
    render_mode: str | None = None,
    randomize: bool = False,
    link: Any = None,
    action_delay: Any = None,
    robot: str | None = None,
    transport: str | Sequence[str] | None = None,
    ca_file: str | None = None,
    token_file: str | None = None,
    timeout: float | None = None,
    **task_options: Any,
) -> RobotVectorEnv | RemoteVectorEnv:
    """Simulated robots and their task, stepped together; the entry point of `gymnasium.make_vec`.

    With `transport`, one address or several, they run elsewhere; each server steps its environments in one request.

    Raises:
        InvalidValue: Arguments that exclude each other, or environments that are not there.
    """
    check(num_envs, PositiveInt, "num_envs")
    if robot is not None:
        raise InvalidValue("A live robot is one environment, which nothing may reset unasked; use gymnasium.make.")
    _check_place(None, transport, timeout, render_mode, randomize, link, action_delay, task_options)
    if transport is not None:
        from bam_envs.remote.remote_env import make_remote_vector_env

        return make_remote_vector_env(
            env_id, transport, num_envs, ca_file=ca_file, token_file=token_file, timeout=timeout
        )
    from bam_envs.core.robot_env import RobotVectorEnv

    entry, task_options = _named(env_id, task_options)
    _require_robot(entry, randomize=randomize or None, link=link, action_delay=action_delay)
    return RobotVectorEnv(
        _behind(link, entry.make_robot(num_envs, randomize, task_options)),
        _late(action_delay, entry.make_task(num_envs, task_options)),
        max_episode_steps=max_episode_steps,
        render_mode=render_mode,
    )
