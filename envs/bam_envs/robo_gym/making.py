"""robo-gym's environments: the entry points of `gymnasium.make` and `gymnasium.make_vec` for its ids and options.

An option with another meaning than in robo-gym is logged, once per process.
"""

import logging
from collections.abc import Mapping
from functools import cache
from typing import Any

import gymnasium as gym

from bam_envs import make_env as ours
from bam_envs.aliases import ROBO_GYM, RoboGymId
from bam_envs.core.env_options import in_our_words, require_kinds
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS, MAKE_OPTIONS
from bam_envs.core.robot_env import RobotEnv, render_modes

_LOG = logging.getLogger(__name__)
_MANAGER = ("ip", "lower_bound_port", "upper_bound_port", "server_manager_port")
"""Address of robo-gym's Server Manager, which starts Gazebo."""
_WINDOWS = ("gui", "gazebo_gui", "rviz_gui")
_SIMULATED = (*_MANAGER, *_WINDOWS)
PLACES = frozenset({*_SIMULATED, "rs_address"})
"""Options for the place where an environment of robo-gym ran, not for the environment itself."""
_RANGES = [f"ee_rotation_{one}_range" for one in ("pos_x", "pos_y", "pos_z", "roll", "pitch", "yaw")]
_NOT_HERE = {
    "max_velocity_scale_factor": "the arm's speed belongs to the environment, which would be another one",
    "action_rate": "the rate belongs to the environment, which would be another one",
    **dict.fromkeys(
        ["ee_rotation_matters", "ee_rotation_threshold"],
        "bam/isaac-reach-v0 (IsaacReachURSim-v0) has targets with an orientation",
    ),
    **dict.fromkeys(["ee_distance_threshold", "ee_target_pose"], "it has no target of the flange"),
    **dict.fromkeys(
        ["ee_target_volume_bounding_box", *_RANGES],
        "give the target itself: ee_target_pose=[x, y, z, roll, pitch, yaw], here or to each reset",
    ),
    **dict.fromkeys(
        ["randomize_start", "random_joint_offset", "continue_on_success", "continue_except_collision"],
        "give reset the start itself: options={'joint_positions': [...]}",
    ),
}
"""Options of robo-gym's modular environments that do not exist here -> alternative."""


def make_env(env_id: str, **options: Any) -> gym.Env[Any, Any]:
    """One robot and its task, with robo-gym's `options` for that id and those of `bam_envs`. See `translate`."""
    entry = ROBO_GYM[env_id]
    arguments = translate(entry, options)
    if arguments.get("transport") is not None:
        return ours.make_env(env_id, **arguments)
    made: Any = ours.make_env(entry.env_id, **arguments).unwrapped
    env = RoboGymEnv(made.robot, made.task, made.render_mode)
    env.is_live = arguments.get("robot") is not None
    # robo-gym's ids have no limit at Gymnasium: with parity the task itself terminates at the last step.
    return env if options.get("parity") else gym.wrappers.TimeLimit(env, ENVIRONMENTS[entry.env_id].max_episode_steps)


def make_vector_env(env_id: str, num_envs: int = 1, **options: Any) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Simulated robots and their task, stepped together; infos have ``rs_state`` only with ``rs_state_to_info``."""
    entry = ROBO_GYM[env_id]
    if entry.is_live and options.get("transport") is None:
        raise InvalidValue(
            f"{env_id}: a live robot is one environment, which nothing may reset unasked; use gymnasium.make."
        )
    arguments = translate(entry, options)
    if arguments.get("transport") is not None:
        return ours.make_vector_env(env_id, num_envs, **arguments)
    if "rs_state_to_info" not in options:
        arguments.pop("rs_state_to_info", None)
    if not options.get("parity"):
        arguments.setdefault("max_episode_steps", ENVIRONMENTS[entry.env_id].max_episode_steps)
    return ours.make_vector_env(entry.env_id, num_envs, **arguments)


class RoboGymEnv(RobotEnv):
    """A `RobotEnv` under one of robo-gym's ids, with the methods that robo-gym's environments add."""

    is_live = False
    """Whether the robot is live, not simulated."""

    def get_rs_state(self) -> dict[str, float] | list[float] | None:
        """The newest wire state: of an arm by key, of a base a list of 1030 numbers; None before the first `reset`."""
        task: Any = self.task
        return None if self.last_state is None else task.rs_state(self.last_state)[0]

    def kill_sim(self) -> None:
        """End the simulation and free its memory; the next `reset` starts it again.

        Raises:
            InvalidValue: The robot is live.
        """
        if self.is_live:
            raise InvalidValue(
                "kill_sim(): the robot is live, and there is no simulation to end; close() drops the link."
            )
        self.close()

    def restart_sim(self) -> None:
        """`kill_sim`, then start the simulation again; call `reset` next."""
        self.kill_sim()
        self.robot.connect()


def translate(entry: RoboGymId, given: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `bam_envs.make_env.make_env` for `entry`; logs once per process how an option is interpreted.

    A ``Sim-v0`` takes ``robot=`` too, to deploy a policy in the environment in which it was trained.

    Raises:
        UnknownName: Neither robo-gym nor `bam_envs` has such an option; the error carries the closest match.
        InvalidValue: An option of robo-gym that is not supported, or of the wrong kind; a live robot without an
            address, or a simulated one with an address.
    """
    taken, refused = taken_and_refused(entry)
    known = {*_task_options(entry), *MAKE_OPTIONS, "max_episode_steps", *taken}
    for name in given:
        if name in refused and name in _NOT_HERE:
            raise InvalidValue(f"{name}= of {entry.id}: there is none here; {_NOT_HERE[name]}.")
        if name not in known | refused:
            raise UnknownName(f"argument of {entry.id}", name, known, meant=in_our_words(name))
    require_values(entry, given)
    options = {name: value for name, value in given.items() if name not in PLACES}
    robot, transport = _robot(entry, given), given.get("transport")
    if robot is not None:
        options["robot"] = robot
        why = f"The robot of this {entry.id} is a live one: it has no window here, and no Server Manager."
    else:
        why = (
            "The robot is simulated in this process; there is no Server Manager and no Gazebo, and nothing to be "
            "started first."
        )
    without_effect = (*_MANAGER, "rviz_gui") if robot is None else _SIMULATED
    ignored = ", ".join(f"{name}={given[name]!r}" for name in without_effect if given.get(name))
    if ignored:
        say_once(f"{ignored}: accepted, and without effect. {why}")
    if transport is not None:
        return options
    if given.get("parity") and "trajectory" in _task_options(entry) and given.get("trajectory") is None:
        say_once(
            "parity=True: the trajectory is this package's own, up to 0.67 rad from robo-gym's; "
            "trajectory='.../robo_gym/envs/ur/robot_trajectories/trajectory_raad_2022.json' of an installed robo-gym "
            "is that one."
        )
    return {**entry.defaults, **options, **(_window(given) if robot is None else {})}


def _robot(entry: RoboGymId, given: Mapping[str, Any]) -> Any:
    """The address of the live robot, if there is one."""
    robot, address = given.get("robot"), given.get("rs_address")
    if address is not None and not entry.is_live:
        raise InvalidValue(f"rs_address={address!r} names a live robot; it belongs to {entry.twin}.")
    if not entry.is_live or given.get("transport") is not None:
        return robot
    if robot is not None and address is not None:
        raise InvalidValue(f"rs_address={address!r} and robot={robot!r} name the same thing; leave one out.")
    if robot is None and address is None:
        raise InvalidValue(
            f"{entry.id} is a live robot, and it has no address: give robot='ws://IP:PORT' of the rosbridge in "
            f"front of it (rs_address='IP:PORT' is the same), or use {entry.twin} for the simulated one."
        )
    text = str(address)
    if robot is not None or text.startswith(("ws://", "wss://")):
        return text if robot is None else robot
    host, _, port = text.rpartition(":")
    if not host or set(host) & set(" /") or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InvalidValue(f"rs_address must be 'IP:PORT', such as '10.0.0.5:9090', not {address!r}.")
    say_once(
        f"rs_address={text!r} is read as robot='ws://{text}': the robot is reached through rosbridge (port 9090 unless "
        "it was given another), and not through a robot server of robo-gym's."
    )
    return f"ws://{text}"


def taken_and_refused(entry: RoboGymId) -> tuple[frozenset[str], frozenset[str]]:
    """Options of robo-gym's constructors that the tasks lack: those accepted, and those refused with a reason."""
    taken = frozenset({*_SIMULATED, "rs_address"} if entry.is_live else _SIMULATED)
    return taken, frozenset({"rs_address", *_NOT_HERE}) - taken - _task_options(entry).keys()


def require_values(entry: RoboGymId, given: Mapping[str, Any]) -> None:
    """`require_kinds` for robo-gym's options; windows may be None."""
    values = {name: value for name, value in given.items() if value is not None or name not in _WINDOWS}
    require_kinds(entry.id, _task_options(entry) | dict.fromkeys(("randomize", *_WINDOWS), False), values)


def _task_options(entry: RoboGymId) -> dict[str, Any]:
    """The options of the task; robo-gym's ids name their robot."""
    options = ENVIRONMENTS[entry.env_id].options()
    return {name: value for name, value in options.items() if name != "robot_model"}


def _window(given: Mapping[str, Any]) -> dict[str, Any]:
    """The render mode of ``gui=True``: a window with the simulated robot, if there is a display."""
    names = [name for name in ("gui", "gazebo_gui") if given.get(name)]
    if not names or given.get("render_mode") is not None:
        return {}
    if "human" not in render_modes():
        say_once(f"{names[0]}=True: no window, for there is no display; render_mode='rgb_array' draws.")
        return {}
    say_once(f"{names[0]}=True is render_mode='human': a window with the simulated robot.")
    return {"render_mode": "human"}


@cache
def say_once(text: str) -> None:
    """Log `text` as a warning, once per process."""
    _LOG.warning("%s", text)
