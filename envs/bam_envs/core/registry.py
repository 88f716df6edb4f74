"""The table of environments: Gymnasium registers them from it, and RLlib reads the same entries.

Importing this imports neither a simulator nor a task: an entry names its task and robot as text, resolved when the
environment is made. Most of the file is the table.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from bam_envs.core.env_options import CAMERA_OPTIONS, constructor_options, read_cameras, require_kinds, require_known
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.location import SIMULATED, WHERE
from bam_envs.core.robot import CameraSpec

if TYPE_CHECKING:
    from bam_envs.core.robot import Robot
    from bam_envs.core.task import Task

MAKE_OPTIONS = ("render_mode", *SIMULATED, *WHERE, "timeout")
"""Arguments of `gymnasium.make` for every environment here, besides the options of its task."""


NO_ROBOT = "bam_envs.local.local_task:NoRobot"
"""The robot of an environment that has none."""


@dataclass(frozen=True)
class EnvEntry:
    """One environment."""

    id: str
    """Gymnasium's id, with its version."""
    summary: str
    """The task, in one line."""
    task: str
    """``"module:Class"`` of the task."""
    robot: str
    """``"module:function"`` that makes the simulated robot, or `NO_ROBOT`."""
    max_episode_steps: int
    """Steps after which an episode is truncated; 1 where every episode ends in its first step by itself."""
    period: float = 0.05
    """Time between two actions [s]."""
    robot_options: tuple[str, ...] = ()
    """Arguments of the task that its robot takes too."""
    cameras: tuple[str, ...] = ()
    """Cameras of its robot, whose images its observations can have."""
    shows: tuple[str, ...] = ()
    """Those that they have unless the option ``camera`` says otherwise."""
    simulated_only: bool = False
    """Whether no live robot can take the place of its simulated one."""
    variants: dict[str, str] = field(default_factory=dict)
    """Flags that plug-ins add, such as ``parity`` -> ``"module:Class"`` of the task with that flag."""

    @property
    def time_limit(self) -> int | None:
        """Steps after which an episode is truncated; None where it never is."""
        return self.max_episode_steps if self.max_episode_steps > 1 else None

    @property
    def has_robot(self) -> bool:
        """Whether it moves a robot, which may be a live one."""
        return self.robot != NO_ROBOT and not self.simulated_only

    def options(self) -> dict[str, Any]:
        """The options of the task, flags of variants and cameras among them, with their defaults."""
        images = {**CAMERA_OPTIONS, "camera": list(self.shows) or None} if self.cameras else {}
        return constructor_options(resolve_name(self.task)) | images | dict.fromkeys(self.variants, False)

    def read_cameras(self, given: Mapping[str, Any]) -> tuple[CameraSpec, ...]:
        """The cameras that these options ask for; raises the errors of `bam_envs.core.env_options.read_cameras`."""
        given = {"camera": list(self.shows) or None, **given}
        return read_cameras(self.id, self.cameras, given) if self.cameras else ()

    def make_task(self, num_envs: int, given: Mapping[str, Any]) -> Task:
        """The task of `num_envs` environments, with the options `given`.

        Raises:
            UnknownName: It has no such option.
            InvalidValue: An option has a value of the wrong kind.
        """
        options = self.options()
        require_known(self.id, options, given, MAKE_OPTIONS)
        require_kinds(self.id, options, given)
        flags = [flag for flag in self.variants if given.get(flag)]
        kind = resolve_name(self.variants[flags[0]] if flags else self.task)
        images = CAMERA_OPTIONS if self.cameras else {}
        own = {name: value for name, value in given.items() if name not in self.variants and name not in images}
        task: Task = kind(num_envs, **own)
        cameras = self.read_cameras(given)
        if cameras:
            task = resolve_name("bam_envs.tasks.task_wrappers:CameraTask")(task, cameras)
        return task

    def make_robot(self, num_robots: int, randomize: bool, task_options: Mapping[str, Any]) -> Robot:
        """The simulated robot, or n of them.

        Raises:
            InvalidValue: `randomize` is neither True nor False.
        """
        require_kinds(self.id, {"randomize": False}, {"randomize": randomize})
        shared = {name: task_options[name] for name in self.robot_options if name in task_options}
        cameras = self.read_cameras(task_options)
        if cameras:
            shared |= {"cameras": cameras, "looks": task_options.get("looks", CAMERA_OPTIONS["looks"])}
        robot: Robot = resolve_name(self.robot)(num_robots, randomize=randomize, **shared)
        return robot


@dataclass(frozen=True)
class Alias:
    """Another id of an environment, which a plug-in adds."""

    env_id: str
    """Key of `ENVIRONMENTS`."""
    variant: str = ""
    """Variant of the environment that the other id names; "" for the environment itself."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Other name of an option of the task -> its own."""


_CAMERAS = ("front", "wrist")
_ENTRIES = (
    EnvEntry(
        "bam/reach-v0",
        "move the tool of an arm to a point, with joint-space actions",
        "bam_envs.tasks.reach:ReachTask",
        "bam_envs.robots.physics.mujoco_arm:arm_scene",
        max_episode_steps=100,
        robot_options=("robot_model",),
        cameras=_CAMERAS,
    ),
    EnvEntry(
        "bam/pick-v0",
        "pick up a cube that lies anywhere in the arm's work area with any yaw",
        "bam_envs.tasks.pick:PickTask",
        "bam_envs.robots.physics.mujoco_arm:cube_scene",
        max_episode_steps=100,
        robot_options=("robot_model",),
        cameras=_CAMERAS,
    ),
    EnvEntry(
        "bam/pick-place-v0",
        "pick up a cube and put it down within 2 cm of a goal",
        "bam_envs.tasks.pick_place:PickPlaceTask",
        "bam_envs.robots.physics.mujoco_arm:cube_scene",
        max_episode_steps=200,
        robot_options=("robot_model",),
        cameras=_CAMERAS,
    ),
    EnvEntry(
        "bam/joints-v0",
        "follow positions of an arm's joints, for policies of others",
        "bam_envs.tasks.reach:JointsTask",
        "bam_envs.robots.physics.mujoco_arm:arm_scene",
        max_episode_steps=600,
        robot_options=("robot_model", "rate"),
        cameras=_CAMERAS,
    ),
    EnvEntry(
        "bam/navigation-v0",
        "drive a wheeled base to within 20 cm of a place, nothing in the way",
        "bam_envs.tasks.navigation:NavigationTask",
        "bam_envs.robots.physics.kinematic_base:open_floor",
        max_episode_steps=500,
        period=0.1,
        robot_options=("robot_model",),
    ),
    EnvEntry(
        "bam/avoidance-v0",
        "drive a wheeled base to a place on the other side of three boxes that only its lasers see",
        "bam_envs.tasks.avoidance:AvoidanceTask",
        "bam_envs.robots.physics.kinematic_base:lab",
        max_episode_steps=500,
        period=0.1,
        robot_options=("robot_model",),
    ),
    *(
        EnvEntry(
            f"bam/{name}-v0",
            summary,
            f"bam_envs.tasks.{task}",
            f"bam_envs.robots.physics.kinematic_arm:{scene}",
            max_episode_steps=steps,
            period=period,
            robot_options=("ur_model",),
        )
        for name, task, scene, steps, period, summary in (
            (
                *("ur-reach", "ur_reach:UrReachTask", "reach_arm", 300, 0.1),
                "bring the flange of a UR arm of any size within 10 cm of a point",
            ),
            (
                *("ur-empty", "ur_arm:UrEmptyTask", "empty_arm", 300, 0.05),
                "a UR arm and nothing to do: for trying out actions",
            ),
            (
                *("ur-avoidance", "ur_avoidance:UrAvoidanceTask", "obstacle_arm", 1000, 0.05),
                "stay at a pose and out of the way of an obstacle that moves up and down",
            ),
            (
                *("ur-track", "ur_track:UrTrackTask", "obstacle_arm", 1000, 0.05),
                "follow a recorded joint trajectory and make way for an obstacle that flies about",
            ),
            (
                *("isaac-reach", "isaac_reach:IsaacReachTask", "isaac_arm", 600, 1 / 30),
                "bring the flange of a UR10 to a pose, position and orientation, as in Isaac Lab's reach task",
            ),
        )
    ),
    *(
        EnvEntry(f"bam/{name}-v0", summary, f"bam_envs.local.{task}", NO_ROBOT, steps, period=0.1)
        for name, task, steps, summary in (
            ("grid-world", "grid_world:GridWorld", 100, "walk to a target on a square board"),
            ("classic-bandit", "bandits:ClassicBandit", 1, "pull the arm that wins most often"),
            (
                *("context-bandit", "bandits:ContextBandit", 1),
                "pull the arm that wins most often in the context that is shown",
            ),
            ("image-bandit", "bandits:ImageBandit", 1, "pull the arm that gives most for the picture that is shown"),
            ("digits", "picture_tasks:Digits", 1, "tell which digit a picture of 8 x 8 pixels shows"),
            ("mnist", "picture_tasks:Mnist", 1, "tell which digit a picture of MNIST shows"),
            ("grasp-xy", "picture_tasks:GraspXY", 1, "touch one of five circles in a picture"),
        )
    ),
    EnvEntry(
        "bam/obs-v0",
        "look through the cameras of a UR5e; nothing moves",
        "bam_envs.tasks.observe:ObserveTask",
        "bam_envs.robots.physics.mujoco_arm:cube_scene",
        max_episode_steps=100,
        cameras=_CAMERAS,
        shows=_CAMERAS,
        simulated_only=True,
    ),
    *(
        EnvEntry(
            f"bam/grasp-{name}-v0",
            summary,
            f"bam_envs.tasks.grasping.grasp_tasks:{task}",
            "bam_envs.robots.physics.grasp_cell:GraspCell",
            max_episode_steps=1,
            period=1.0,
            robot_options=("objects", "grasps", "size"),
            simulated_only=True,
        )
        for name, task, summary in (
            ("xyr", "GraspXYR", "grasp an object: choose a place of a picture from above, and a rotation"),
            ("xyrw", "GraspXYRW", "grasp an object: choose place, rotation and width of the gripper from a picture"),
            ("6d", "Grasp6D", "grasp an object from any direction: choose the gripper's pose and width from a picture"),
        )
    ),
)
ENVIRONMENTS: dict[str, EnvEntry] = {entry.id: entry for entry in _ENTRIES}
NEED_DATA = {
    "bam/dataset-v0": EnvEntry(
        "bam/dataset-v0",
        "do what was done in one step of a data set",
        "bam_train.data.data_set_task:DataSetTask",
        NO_ROBOT,
        max_episode_steps=1,
        period=0.1,
    )
}
"""Environments that cannot be made without an option, since their spaces are those of a data set."""
ALIASES: dict[str, Alias] = {}
"""Ids of plug-ins."""


def register() -> None:
    """Register every environment with Gymnasium; idempotent. Plug-ins must add their variants before."""
    for entry in (*ENVIRONMENTS.values(), *NEED_DATA.values()):
        register_id(entry.id, "bam_envs.make_env", entry.time_limit)


def register_alias(env_id: str, alias: Alias, module: str, max_episode_steps: int | None = None) -> None:
    """Register an id of a plug-in, whose `module` has ``make_env`` and ``make_vector_env``."""
    ALIASES[env_id] = alias
    register_id(env_id, module, max_episode_steps)


def register_id(env_id: str, module: str, max_episode_steps: int | None) -> None:
    """Register an id with Gymnasium; `module` has the two functions that make its environments."""
    if env_id not in gym.registry:
        gym.register(
            env_id,
            entry_point=f"{module}:make_env",
            vector_entry_point=f"{module}:make_vector_env",
            max_episode_steps=max_episode_steps,
            kwargs={"env_id": env_id},
        )


def entry_of(env_id: str) -> EnvEntry | None:
    """The entry of `env_id`, an id of the table or of a plug-in, with or without ``module:``; None if there is none."""
    bare = env_id.rpartition(":")[2]
    return ENVIRONMENTS.get(ALIASES[bare].env_id if bare in ALIASES else bare, NEED_DATA.get(bare))


def own_options(env_id: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """The options `given` to an environment, each under its own name."""
    own = ALIASES[env_id].options if env_id in ALIASES else {}
    return {own.get(name, name): value for name, value in given.items()}


def are_same(one: str, other: str) -> bool:
    """Whether two ids name the same environment in the same variant, such as an id of the table and a plug-in's."""
    entry = entry_of(one)
    return one == other or (entry is not None and entry is entry_of(other) and _variant(one) == _variant(other))


def _variant(env_id: str) -> str:
    alias = ALIASES.get(env_id.rpartition(":")[2])
    return "" if alias is None else alias.variant


def resolve_id(name: str) -> str:
    """The registered id of `name`, with its version added if missing; ``module:Env-v0`` keeps its module.

    Raises:
        UnknownName: No such environment is registered; the error carries the closest match.
        InvalidValue: The module of ``module:Env-v0`` is not installed.
    """
    module, _, bare = name.rpartition(":")
    if module:
        _import_for(module, name)
    versions = [spec for spec in gym.registry.values() if bare and bare in (spec.id, spec.id.rpartition("-v")[0])]
    if not versions:
        raise UnknownName("environment", name, gym.registry, examples=[*ENVIRONMENTS, "another of Gymnasium's"])
    newest = max(versions, key=lambda spec: spec.version or 0).id
    return f"{module}:{newest}" if module else newest


def _import_for(module: str, name: str) -> None:
    """Import `module`, which should register the environment `name`."""
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module exists, but one of its imports does not
        raise InvalidValue(
            f"Environment {name!r} needs the module {module!r}, which is neither installed nor in this folder. "
            "Install it, or run in the folder that has it."
        ) from error
