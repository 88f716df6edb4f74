"""The one table of environments: it registers them with Gymnasium, and other learners read the same entries.

Importing this imports neither a simulator nor a task; an entry's task and robot are strings, resolved when the
environment is made. The file is long for its table.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from bam_envs.core.env_options import constructor_options, require_kinds, require_known
from bam_envs.core.errors import InvalidValue, UnknownName

if TYPE_CHECKING:
    from bam_envs.core.robot import Robot
    from bam_envs.core.robot_env import RobotEnv, RobotVectorEnv
    from bam_envs.core.task import Task
    from bam_envs.remote.remote_env import RemoteVectorEnv

_NO_OPTIONS = {"env_id", "task_options"}
"""Arguments of `make_env` that nobody gives to `gymnasium.make`."""


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
    robot_options: tuple[str, ...] = ()
    """Arguments of the task that its robot takes too."""
    variants: dict[str, str] = field(default_factory=dict)
    """Flags that plug-ins add, such as ``parity``, and ``"module:Class"`` of the task that each of them makes.

    Such tasks end by themselves: so the time limit of an environment that has any is put around it here, and not by
    Gymnasium, which would do it in any case."""

    def options(self) -> dict[str, Any]:
        """The options of the task, flags of variants among them, with their defaults."""
        return constructor_options(resolve(self.task)) | dict.fromkeys(self.variants, False)

    def make_task(self, num_envs: int, given: Mapping[str, Any]) -> Task:
        """The task of so many environments.

        Raises:
            UnknownName: It has no such option.
            InvalidValue: An option cannot be what it is.
        """
        options = self.options()
        require_known(self.id, options, given, set(inspect.signature(make_env).parameters) - _NO_OPTIONS)
        require_kinds(self.id, options, given)
        flags = [flag for flag in self.variants if given.get(flag)]
        kind = resolve(self.variants[flags[0]] if flags else self.task)
        task: Task = kind(num_envs, **{name: value for name, value in given.items() if name not in self.variants})
        return task

    def make_robot(self, num_robots: int, randomize: bool, task_options: Mapping[str, Any]) -> Robot:
        """The simulated robot, or n of them.

        Raises:
            InvalidValue: `randomize` is neither True nor False.
        """
        require_kinds(self.id, {"randomize": False}, {"randomize": randomize})
        shared = {name: task_options[name] for name in self.robot_options if name in task_options}
        robot: Robot = resolve(self.robot)(num_robots, randomize=randomize, **shared)
        return robot


@dataclass(frozen=True)
class Alias:
    """Another id of an environment, which a plug-in adds."""

    env_id: str
    """Key of `ENVIRONMENTS`."""
    variant: str = ""
    """What the other id means where it is not quite the same environment; else empty."""


_ENTRIES = (
    EnvEntry(
        "bam/reach-v0",
        "move the tool of a UR5e to a point, with joint-space actions",
        "bam_envs.tasks.reach:ReachTask",
        "bam_envs.robots.physics.mujoco_arm:arm_scene",
        max_episode_steps=100,
    ),
    EnvEntry(
        "bam/pick-v0",
        "pick up a cube that lies anywhere in 30 x 40 cm with any yaw",
        "bam_envs.tasks.pick:PickTask",
        "bam_envs.robots.physics.mujoco_arm:cube_scene",
        max_episode_steps=100,
    ),
    EnvEntry(
        "bam/pick-place-v0",
        "pick up a cube and put it down within 2 cm of a goal",
        "bam_envs.tasks.pick_place:PickPlaceTask",
        "bam_envs.robots.physics.mujoco_arm:cube_scene",
        max_episode_steps=200,
    ),
    EnvEntry(
        "bam/mir100-navigation-v0",
        "drive a MiR100 to within 20 cm of a place, nothing in the way",
        "bam_envs.tasks.mir100_navigation:Mir100NavigationTask",
        "bam_envs.robots.physics.kinematic_base:open_floor",
        max_episode_steps=500,
        period=0.1,
    ),
    EnvEntry(
        "bam/mir100-avoidance-v0",
        "drive a MiR100 to a place on the other side of three boxes that only its lasers see",
        "bam_envs.tasks.mir100_avoidance:Mir100AvoidanceTask",
        "bam_envs.robots.physics.kinematic_base:lab",
        max_episode_steps=500,
        period=0.1,
    ),
    EnvEntry(
        "bam/ur-reach-v0",
        "bring the flange of a UR arm of any size within 10 cm of a point",
        "bam_envs.tasks.ur_reach:UrReachTask",
        "bam_envs.robots.physics.kinematic_arm:reach_arm",
        max_episode_steps=300,
        period=0.1,
        robot_options=("ur_model",),
    ),
    EnvEntry(
        "bam/ur-empty-v0",
        "a UR arm and nothing to do: for trying out actions",
        "bam_envs.tasks.ur_empty:UrEmptyTask",
        "bam_envs.robots.physics.kinematic_arm:empty_arm",
        max_episode_steps=300,
        robot_options=("ur_model",),
    ),
    EnvEntry(
        "bam/ur-avoidance-v0",
        "stay at a pose and out of the way of an obstacle that moves up and down",
        "bam_envs.tasks.ur_avoidance:UrAvoidanceTask",
        "bam_envs.robots.physics.kinematic_arm:obstacle_arm",
        max_episode_steps=1000,
        robot_options=("ur_model",),
    ),
    EnvEntry(
        "bam/ur-track-v0",
        "follow a recorded joint trajectory and make way for an obstacle that flies about",
        "bam_envs.tasks.ur_track:UrTrackTask",
        "bam_envs.robots.physics.kinematic_arm:obstacle_arm",
        max_episode_steps=1000,
        robot_options=("ur_model",),
    ),
    EnvEntry(
        "bam/isaac-reach-v0",
        "bring the flange of a UR10 to a pose, position and orientation, as in Isaac Lab's reach task",
        "bam_envs.tasks.isaac_reach:IsaacReachTask",
        "bam_envs.robots.physics.kinematic_arm:isaac_arm",
        max_episode_steps=600,
        period=1 / 30,
        robot_options=("ur_model",),
    ),
)
ENVIRONMENTS: dict[str, EnvEntry] = {entry.id: entry for entry in _ENTRIES}
ALIASES: dict[str, Alias] = {}
"""Ids of plug-ins."""


def register() -> None:
    """Register every environment with Gymnasium; idempotent. Plug-ins add their variants before."""
    for entry in ENVIRONMENTS.values():
        register_id(entry.id, "bam_envs.core.registry", None if entry.variants else entry.max_episode_steps)


def register_alias(env_id: str, alias: Alias, module: str) -> None:
    """Register an id of a plug-in, whose `module` has ``make_env`` and ``make_vector_env``."""
    ALIASES[env_id] = alias
    register_id(env_id, module, None)


def register_id(env_id: str, module: str, max_episode_steps: int | None) -> None:
    """Register an id with Gymnasium; `module` has the two functions that make it."""
    if env_id not in gym.registry:
        gym.register(
            env_id,
            entry_point=f"{module}:make_env",
            vector_entry_point=f"{module}:make_vector_env",
            max_episode_steps=max_episode_steps,
            kwargs={"env_id": env_id},
        )


def entry_of(env_id: str) -> EnvEntry | None:
    """The entry that `env_id` names, ours or a plug-in's, with or without ``module:``; None of anything else."""
    own = env_id.rpartition(":")[2]
    return ENVIRONMENTS.get(ALIASES[own].env_id if own in ALIASES else own)


def are_same(one: str, other: str) -> bool:
    """Whether two ids name one environment, as ours and a plug-in's do, but for the plug-in's variants of ours."""
    entry = entry_of(one)
    return one == other or (entry is not None and entry is entry_of(other) and _variant(one) == _variant(other))


def _variant(env_id: str) -> str:
    alias = ALIASES.get(env_id.rpartition(":")[2])
    return "" if alias is None else alias.variant


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
) -> gym.Env[Any, Any]:
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
    if robot is not None and transport is not None:
        raise InvalidValue("robot= and transport= exclude each other: the task runs here, or with the robot elsewhere.")
    if robot is None and profile is not None:
        raise InvalidValue(f"profile={profile!r} describes a live robot; give its address with robot= too.")
    _check_place(robot, transport, timeout, render_mode, randomize, task_options)
    if transport is not None:
        from bam_envs.remote.remote_env import make_remote_env

        return make_remote_env(env_id, transport, ca_file=ca_file, token_file=token_file, timeout=timeout)
    from bam_envs.core.robot_env import RobotEnv

    entry = ENVIRONMENTS[env_id]
    task = entry.make_task(1, task_options)
    simulated = entry.make_robot(1, randomize, task_options)
    if robot is None:
        return limited(RobotEnv(simulated, task, render_mode=render_mode), entry)
    from bam_envs.live.building import live_robot

    tool = getattr(simulated, "tool_position", None)  # forward kinematics of an arm that is no UR5e
    live = live_robot(
        robot, simulated.spec, profile=profile, tool_position=tool, ca_file=ca_file, token_file=token_file
    )
    return limited(RobotEnv(live, task, render_mode=render_mode), entry)


def limited(env: RobotEnv, entry: EnvEntry) -> gym.Env[Any, Any]:
    """`env` with the time limit that Gymnasium does not put around it."""
    if not entry.variants or getattr(env.task, "ends_by_itself", False) or _gymnasium_limits():
        return env
    return gym.wrappers.TimeLimit(env, entry.max_episode_steps)


def _gymnasium_limits() -> bool:
    """Whether `gymnasium.make`, which calls this, was told of a limit, or of -1 for none.

    It keeps its ``max_episode_steps`` to itself, and a limit within would cut what is to be longer. So its frame is
    asked; where there is none, nobody was told of a limit.
    """
    frame: Any = sys._getframe()
    while frame is not None and frame.f_code is not gym.make.__code__:
        frame = frame.f_back
    if frame is None:
        return False
    told, registered = frame.f_locals.get("max_episode_steps"), frame.f_locals.get("env_spec")
    return told is not None or getattr(registered, "max_episode_steps", None) is not None


def _check_place(
    robot: str | None,
    transport: object,
    timeout: float | None,
    render_mode: str | None,
    randomize: bool,
    task_options: Mapping[str, Any],
) -> None:
    """Refuse options of another place than the one where the environment runs."""
    if transport is None and timeout is not None:
        raise InvalidValue(f"timeout={timeout!r} is how long an answer of transport= is waited for; leave it out.")
    if transport is not None and task_options:
        names = ", ".join(task_options)
        raise InvalidValue(f"{names}: the task runs at {transport}; give its options to bam-serve there.")
    elsewhere = robot if transport is None else transport
    asked = [name for name, given in (("render_mode", render_mode is not None), ("randomize", randomize)) if given]
    if elsewhere is not None and asked:
        raise InvalidValue(f"{', '.join(asked)}: only the simulation here has that, and not {elsewhere}; leave it out.")


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

    With `transport`, one address or several, they run elsewhere: the environments of one server are one request.

    Raises:
        InvalidValue: Arguments that exclude each other, or environments that are not there.
    """
    from bam_envs.core.validation import PositiveInt, check

    check(num_envs, PositiveInt, "num_envs")
    if robot is not None:
        raise InvalidValue("A live robot is one environment, which nothing may reset unasked; use gymnasium.make.")
    _check_place(None, transport, timeout, render_mode, randomize, task_options)
    if transport is not None:
        from bam_envs.remote.remote_env import make_remote_vector_env

        return make_remote_vector_env(
            env_id, transport, num_envs, ca_file=ca_file, token_file=token_file, timeout=timeout
        )
    from bam_envs.core.robot_env import RobotVectorEnv

    entry = ENVIRONMENTS[env_id]
    task = entry.make_task(num_envs, task_options)
    if max_episode_steps is None and not getattr(task, "ends_by_itself", False):
        max_episode_steps = entry.max_episode_steps if entry.variants else None  # Gymnasium gives that of the others
    return RobotVectorEnv(
        entry.make_robot(num_envs, randomize, task_options),
        task,
        max_episode_steps=max_episode_steps,
        render_mode=render_mode,
    )
