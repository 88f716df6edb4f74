"""What robo-gym's constructor options mean here: from its arguments to those of `bam_envs.make_env.make_env`.

Where an option means something else here, that is logged, once in a process.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Any

from bam_envs.core import registry
from bam_envs.core.env_options import in_our_words, require_kinds
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot_env import render_modes
from bam_envs.robo_gym.table import RoboGymId

_LOG = logging.getLogger(__name__)
_SAID: set[str] = set()
_MANAGER = ("ip", "lower_bound_port", "upper_bound_port", "server_manager_port")
"""Where robo-gym finds the Server Manager that starts Gazebo."""
_WINDOWS = ("gui", "gazebo_gui", "rviz_gui")
_SIMULATED = (*_MANAGER, *_WINDOWS)
PLACES = frozenset({*_SIMULATED, "rs_address"})
"""Options that say where an environment of robo-gym's ran, and nothing of what it is."""
_OTHER_TARGETS = "give the target itself: ee_target_pose=[x, y, z, roll, pitch, yaw], here or to each reset"
_OF_ENVIRONMENT = frozenset(registry.MAKE_OPTIONS) | {"max_episode_steps"}
_NOT_HERE = {
    "max_velocity_scale_factor": "the arm's speed belongs to the environment, which would be another one",
    "action_rate": "the rate belongs to the environment, which would be another one",
    "ee_rotation_matters": "bam/isaac-reach-v0 (IsaacReachURSim-v0) has targets with an orientation",
    "ee_rotation_threshold": "bam/isaac-reach-v0 (IsaacReachURSim-v0) has targets with an orientation",
    "ee_distance_threshold": "it has no target of the flange",
    "ee_target_pose": "it has no target of the flange",
    "ee_target_volume_bounding_box": _OTHER_TARGETS,
    "ee_rotation_pos_x_range": _OTHER_TARGETS,
    "ee_rotation_pos_y_range": _OTHER_TARGETS,
    "ee_rotation_pos_z_range": _OTHER_TARGETS,
    "ee_rotation_roll_range": _OTHER_TARGETS,
    "ee_rotation_pitch_range": _OTHER_TARGETS,
    "ee_rotation_yaw_range": _OTHER_TARGETS,
    "randomize_start": "give reset the start itself: options={'joint_positions': [...]}",
    "random_joint_offset": "give reset the start itself: options={'joint_positions': [...]}",
    "continue_on_success": "give reset the start itself: options={'joint_positions': [...]}",
    "continue_except_collision": "give reset the start itself: options={'joint_positions': [...]}",
}
"""Options of robo-gym's modular environments that are none of ours, and what to do instead."""


def translate(entry: RoboGymId, given: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `bam_envs.make_env.make_env` for `entry`; says once in a process what an option means here.

    Raises:
        UnknownName: Neither robo-gym nor we have such an option; it carries the closest match.
        InvalidValue: An option that is there and cannot be had, or is of the wrong kind; a live robot without an
            address, or a simulated one with one.
    """
    _require_known(entry, given)
    require_values(entry, given)
    options = {name: value for name, value in given.items() if name not in (*_SIMULATED, "rs_address")}
    address = _live_address(entry, given)
    if address is not None:
        options["robot"] = address
        _say_what_is_live(entry, given)
    else:
        _say_where_it_runs(given)
        options |= _window(given)
    if options.get("transport") is not None:
        return options
    _say_whose_trajectory(entry, given)
    return {**entry.defaults, **options}


def constructor_options(entry: RoboGymId) -> tuple[frozenset[str], frozenset[str]]:
    """What robo-gym's constructors take and ours do not: what is taken here too, and what is refused with a reason.

    Its other options are those of our tasks.
    """
    taken = frozenset({*_SIMULATED, "rs_address"} if entry.is_live else _SIMULATED)
    return taken, frozenset({"rs_address", *_NOT_HERE}) - taken - _task_options(entry).keys()


def require_values(entry: RoboGymId, given: Mapping[str, Any]) -> None:
    """Refuse options of the wrong kind.

    Raises:
        InvalidValue: A flag is neither True nor False, or a number is none.
    """
    said = {name: value for name, value in given.items() if value is not None or name not in _WINDOWS}
    require_kinds(entry.id, _task_options(entry) | dict.fromkeys(("randomize", *_WINDOWS), False), said)


def _task_options(entry: RoboGymId) -> dict[str, Any]:
    return registry.ENVIRONMENTS[entry.env_id].options()


def _require_known(entry: RoboGymId, given: Mapping[str, Any]) -> None:
    taken, refused = constructor_options(entry)
    known = {*_task_options(entry), *_OF_ENVIRONMENT, *taken} - {"env_id", "task_options"}
    for name in given:
        if name in refused and name in _NOT_HERE:
            raise InvalidValue(f"{name}= of {entry.id}: there is none here; {_NOT_HERE[name]}.")
        if name not in known | refused:
            raise UnknownName(f"argument of {entry.id}", name, known, meant=in_our_words(name))


def _live_address(entry: RoboGymId, given: Mapping[str, Any]) -> str | None:
    """Address of the live robot behind rosbridge; None for the simulated one.

    A ``Sim-v0`` takes ``robot=`` too: a policy that was trained in it is deployed in it.
    """
    robot, address = given.get("robot"), given.get("rs_address")
    if not entry.is_live:
        if address is not None:
            raise InvalidValue(f"rs_address={address!r} names a live robot; it belongs to {entry.twin}.")
        return robot
    if given.get("transport") is not None:
        return None
    if robot is not None and address is not None:
        raise InvalidValue(f"rs_address={address!r} and robot={robot!r} name the same thing; leave one out.")
    if robot is not None or address is not None:
        return _rosbridge_address(address) if robot is None else robot
    raise InvalidValue(
        f"{entry.id} is a live robot, and it has no address: give robot='ws://IP:PORT' of the rosbridge in front of "
        f"it (rs_address='IP:PORT' is the same), or use {entry.twin} for the simulated one."
    )


def _rosbridge_address(address: Any) -> str:
    """``"IP:PORT"`` as the address of a rosbridge server."""
    text = str(address)
    if text.startswith(("ws://", "wss://")):
        return text
    host, _, port = text.rpartition(":")
    if not host or set(host) & set(" /") or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InvalidValue(f"rs_address must be 'IP:PORT', such as '10.0.0.5:9090', not {address!r}.")
    url = f"ws://{text}"
    _say_once(
        "rs_address",
        f"rs_address={text!r} is read as robot={url!r}: the robot is reached through rosbridge (port 9090 unless it "
        "was given another), and not through a robot server of robo-gym's.",
    )
    return url


def _say_what_is_live(entry: RoboGymId, given: Mapping[str, Any]) -> None:
    """Of options for a simulation, given with a robot: scripts pass the same to both."""
    names = _first_told("live", [name for name in _SIMULATED if given.get(name)])
    if names:
        said = ", ".join(f"{name}={given[name]!r}" for name in names)
        _say_once(
            f"live {' '.join(names)}",
            f"{said}: accepted, and without effect. The robot of this {entry.id} is a live one: it has no window here, "
            "and no Server Manager.",
        )


def _say_where_it_runs(given: Mapping[str, Any]) -> None:
    """Of options for what is not there."""
    names = _first_told("simulated", [name for name in (*_MANAGER, "rviz_gui") if given.get(name)])
    if names:
        said = ", ".join(f"{name}={given[name]!r}" for name in names)
        _say_once(
            " ".join(names),
            f"{said}: accepted, and without effect. The robot is simulated in this process; there is no Server Manager "
            "and no Gazebo, and nothing to be started first.",
        )


def _say_whose_trajectory(entry: RoboGymId, given: Mapping[str, Any]) -> None:
    """Of parity without robo-gym's file, which is not ours to ship."""
    if given.get("parity") and "trajectory" in _task_options(entry) and given.get("trajectory") is None:
        _say_once(
            "trajectory",
            f"parity=True of {entry.id}: the trajectory is this package's own, up to 0.67 rad from robo-gym's; "
            "trajectory='.../robo_gym/envs/ur/robot_trajectories/trajectory_raad_2022.json' of an installed robo-gym "
            "is that one.",
        )


def _window(given: Mapping[str, Any]) -> dict[str, Any]:
    """``gui=True`` is a window of the simulated robot's, where there is a display."""
    names = [name for name in ("gui", "gazebo_gui") if given.get(name)]
    if not names or given.get("render_mode") is not None or given.get("transport") is not None:
        return {}
    if "human" not in render_modes():
        _say_once("no display", f"{names[0]}=True: no window, for there is no display; render_mode='rgb_array' draws.")
        return {}
    _say_once("gui", f"{names[0]}=True is render_mode='human': a window with the simulated robot.")
    return {"render_mode": "human"}


def _say_once(key: str, text: str) -> None:
    """Log `text` as a warning, unless something with this `key` was said before."""
    if key not in _SAID:
        _SAID.add(key)
        _LOG.warning("%s", text)


def _first_told(topic: str, names: Iterable[str]) -> list[str]:
    """Those of `names` that are told of for the first time under `topic`."""
    new = [name for name in names if f"{topic}: {name}" not in _SAID]
    _SAID.update(f"{topic}: {name}" for name in new)
    return new


def forget() -> None:
    """Say everything once more."""
    _SAID.clear()
