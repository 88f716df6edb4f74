"""The one table of environments: it registers them with Gymnasium, and other learners read the same rows.

Importing this imports neither a simulator nor a task; a row's task and robot are strings, resolved when the
environment is made.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from bam_envs.errors import InvalidValue, UnknownName

if TYPE_CHECKING:
    from bam_envs.remote_env import RemoteEnv, RemoteVectorEnv
    from bam_envs.robot_env import RobotEnv, RobotVectorEnv
    from bam_envs.robots.robot import Robot


@dataclass(frozen=True)
class EnvEntry:
    """One environment."""

    id: str
    """Gymnasium's id, with its version."""
    summary: str
    """What the robot is asked to do, in one line."""
    task: str
    """``"module:Class"`` of the task."""
    robot: str
    """``"module:function"`` that makes the simulated robot."""
    max_episode_steps: int
    """Steps after which an episode is truncated."""
    period: float = 0.05
    """Time between two actions [s]."""


_ENTRIES = (
    EnvEntry(
        "bam/reach-v0",
        "move the tool of a UR5e to a point, with joint-space actions",
        "bam_envs.tasks.reach:ReachTask",
        "bam_envs.robots.simulated.arm:arm_scene",
        max_episode_steps=100,
    ),
    EnvEntry(
        "bam/pick-v0",
        "pick up a cube that lies anywhere in 30 x 40 cm with any yaw",
        "bam_envs.tasks.pick:PickTask",
        "bam_envs.robots.simulated.arm:cube_scene",
        max_episode_steps=100,
    ),
    EnvEntry(
        "bam/pick-place-v0",
        "pick up a cube and put it down within 2 cm of a goal",
        "bam_envs.tasks.pick_place:PickPlaceTask",
        "bam_envs.robots.simulated.arm:cube_scene",
        max_episode_steps=200,
    ),
)
ENVIRONMENTS: dict[str, EnvEntry] = {entry.id: entry for entry in _ENTRIES}


def register() -> None:
    """Register every row with Gymnasium; doing it twice is once."""
    for entry in ENVIRONMENTS.values():
        if entry.id not in gym.registry:
            gym.register(
                entry.id,
                entry_point="bam_envs.registry:make_env",
                vector_entry_point="bam_envs.registry:make_vector_env",
                max_episode_steps=entry.max_episode_steps,
                kwargs={"env_id": entry.id},
            )


def resolve_id(name: str) -> str:
    """The id that `name` means: with its version added, ours or Gymnasium's, ``module:Env-v0`` as it is.

    Raises:
        UnknownName: Nothing of that name is registered; it carries the closest match.
        InvalidValue: The module of ``module:Env-v0`` is not installed.
    """
    module, _, bare = name.rpartition(":")
    if module:
        _import_for(module, name)
    versions = [spec for spec in gym.registry.values() if bare and bare in (spec.id, spec.id.rpartition("-v")[0])]
    if not versions:
        raise UnknownName("environment", name, gym.registry, examples=ENVIRONMENTS)
    newest = max(versions, key=lambda spec: spec.version or 0).id
    return f"{module}:{newest}" if module else newest


def _import_for(module: str, name: str) -> None:
    """Import `module`, which is to register the environment `name`."""
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there, and one that it imports is not
        raise InvalidValue(
            f"Environment {name!r} needs the module {module!r}, which is neither installed nor in this folder."
        ) from error


def resolve(reference: str) -> Any:
    """The object that ``"module:name"`` names."""
    module, _, name = reference.partition(":")
    return getattr(importlib.import_module(module), name)


def make_env(
    env_id: str,
    *,
    render_mode: str | None = None,
    randomize: bool = False,
    robot: str | None = None,
    transport: str | None = None,
    profile: str | None = None,
    ca_file: str | None = None,
    token_file: str | None = None,
    timeout: float | None = None,
    **task_options: Any,
) -> RobotEnv | RemoteEnv:
    """One robot and its task; what `gymnasium.make` calls.

    Args:
        env_id: Key of `ENVIRONMENTS`.
        render_mode: Of the simulated robot.
        randomize: Of the simulated robot.
        robot: Address of a live robot behind rosbridge, such as ``"ws://10.0.0.5:9090"``, instead of the simulated one.
            The task runs here. A path puts a namespace before the robot's topics.
        transport: Address of a whole environment that runs elsewhere, such as ``"ws://10.0.0.5:9090/bam_001"`` or
            ``"tcp://10.0.0.5:9091"``; there is no robot and no task here.
        profile: What the live robot's topics are: a shipped name or a file; by default that of the simulated robot.
        ca_file: Certificates that ``wss://`` trusts instead of the system's.
        token_file: File with the token that the server asks for.
        timeout: Longest that an answer of `transport` is waited for [s]; 30 by default.
        task_options: Arguments of the task.

    Raises:
        InvalidValue: Arguments that exclude each other.
    """
    _require_one_place(robot, transport, profile, task_options)
    _require_simulation(robot or transport, render_mode, randomize)
    _require_answers(transport, timeout)
    if transport is not None:
        from bam_envs.remote_env import make_remote_env

        return make_remote_env(env_id, transport, ca_file=ca_file, token_file=token_file, timeout=timeout)
    from bam_envs.robot_env import RobotEnv

    entry = ENVIRONMENTS[env_id]
    task = resolve(entry.task)(1, **task_options)
    simulated: Robot = resolve(entry.robot)(1, randomize=randomize)
    if robot is None:
        return RobotEnv(simulated, task, render_mode=render_mode)
    from bam_envs.robots.live.building import live_robot

    live = live_robot(robot, simulated.spec, profile=profile, ca_file=ca_file, token_file=token_file)
    return RobotEnv(live, task, render_mode=render_mode)


def _require_simulation(elsewhere: object, render_mode: str | None, randomize: bool) -> None:
    """What only a simulation has is not asked of anything else."""
    asked = [name for name, given in (("render_mode", render_mode is not None), ("randomize", randomize)) if given]
    if elsewhere is not None and asked:
        raise InvalidValue(f"{', '.join(asked)}: only the simulation here has that, and not {elsewhere}; leave it out.")


def _require_answers(transport: object, timeout: float | None) -> None:
    if transport is None and timeout is not None:
        raise InvalidValue(f"timeout={timeout!r} is how long an answer of transport= is waited for; leave it out.")


def _require_one_place(
    robot: str | None, transport: str | None, profile: str | None, task_options: Mapping[str, Any]
) -> None:
    """The environment runs in one place, and each option belongs to one."""
    if robot is not None and transport is not None:
        raise InvalidValue("robot= and transport= exclude each other: the task runs here, or with the robot elsewhere.")
    if transport is not None and task_options:
        names = ", ".join(task_options)
        raise InvalidValue(f"{names}: the task runs at {transport}; give its options to bam-serve there.")
    if robot is None and profile is not None:
        raise InvalidValue(f"profile={profile!r} describes a live robot; give its address with robot= too.")


def make_vector_env(
    env_id: str,
    num_envs: int = 1,
    *,
    max_episode_steps: int | None = None,
    render_mode: str | None = None,
    randomize: bool = False,
    robot: str | None = None,
    transport: str | Sequence[str] | None = None,
    ca_file: str | None = None,
    token_file: str | None = None,
    timeout: float | None = None,
    **task_options: Any,
) -> RobotVectorEnv | RemoteVectorEnv:
    """Simulated robots and their task, stepped together; what `gymnasium.make_vec` calls.

    With `transport`, one address or several, they run elsewhere: the rows of one server are one request.

    Raises:
        InvalidValue: Arguments that exclude each other, or rows that are not there.
    """
    if num_envs < 1:
        raise InvalidValue(f"num_envs must be at least 1, not {num_envs}.")
    if robot is not None:
        raise InvalidValue("A live robot is one environment, which nothing may reset unasked; use gymnasium.make.")
    _require_answers(transport, timeout)
    if transport is not None:
        from bam_envs.remote_env import make_remote_rows

        _require_one_place(None, str(transport), None, task_options)
        _require_simulation(transport, render_mode, randomize)
        return make_remote_rows(env_id, transport, num_envs, ca_file=ca_file, token_file=token_file, timeout=timeout)
    from bam_envs.robot_env import RobotVectorEnv

    entry = ENVIRONMENTS[env_id]
    return RobotVectorEnv(
        resolve(entry.robot)(num_envs, randomize=randomize),
        resolve(entry.task)(num_envs, **task_options),
        max_episode_steps=max_episode_steps,
        render_mode=render_mode,
    )
