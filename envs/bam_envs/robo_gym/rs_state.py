"""Read wire states of robo-gym's robot servers: one wire state as a `RobotState` of one robot.

The inverse is ``task.rs_state(state)``. `read_mir_target` and `read_object` read a target, which no robot measures.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import RobotState
from bam_envs.core.robot_models import SHIPPED, read_description
from bam_envs.robots.base_description import base_model
from bam_envs.tasks.ur_arm import POSITIONS, VELOCITIES, frame_keys

Array = NDArray[np.float64]
MIR100 = base_model(read_description(SHIPPED / "mir100.toml"))
"""The base of robo-gym, as shipped."""
FOOTPRINT = (MIR100.footprint.length, MIR100.footprint.width)
"""Its length and width [m]."""
FRONT_RAYS, BACK_RAYS = (len(scanner.bearings) for scanner in MIR100.body.scanners)
"""Rays of its lasers: 501 and 511."""
_OBJECT, _FLANGE, _FOREARM = frame_keys("object_0"), frame_keys("ee"), frame_keys("forearm")
UR_KEYS = {
    "only_robot": (*POSITIONS, *VELOCITIES, *_FLANGE, "in_collision"),
    "1object": (*_OBJECT, *POSITIONS, *VELOCITIES, *_FLANGE, "in_collision"),
    "1moving2points": (*_OBJECT, *POSITIONS, *VELOCITIES, *_FLANGE, *_FOREARM, "in_collision"),
}
"""The keys of an arm's wire state by robo-gym's ``rs_mode``: 20, 27 and 34 of them."""
_POSE, _TWIST = slice(3, 6), slice(6, 8)
_FRONT = slice(8, 8 + FRONT_RAYS)
_BACK = slice(_FRONT.stop, _FRONT.stop + BACK_RAYS)
_COLLISION = _BACK.stop
MIR_LENGTH = _COLLISION + 1 + 9  # numbers of a base's wire state: 1030


def read_mir(wire: Sequence[float]) -> RobotState:
    """The state of a base: ``base_pose``, ``base_velocity``, ``f_scan``, ``b_scan``, and ``collision`` as truth.

    Args:
        wire: Target x, y, yaw; robot x, y, yaw (m, rad, map); forward and turning speed [m/s, rad/s]; 501 ranges of the
            front scanner and 511 of the back one [m]; contact (0 or 1); three obstacles x, y, yaw. NaN
            becomes 0, as in robo-gym, except in ranges, which the task handles.

    Raises:
        InvalidValue: It does not have 1030 numbers, or one is infinite.
    """
    row = _numbers(wire)
    signals = {"base_pose": np.nan_to_num(row[_POSE]), "base_velocity": np.nan_to_num(row[_TWIST])}
    return _state({**signals, "f_scan": row[_FRONT], "b_scan": row[_BACK]}, row[_COLLISION], 2)


def read_mir_target(wire: Sequence[float]) -> Array:
    """The target's x, y [m] and yaw [rad] of a base's wire state. Shape: (3,)."""
    return np.nan_to_num(_numbers(wire)[:3])


def _numbers(wire: Sequence[float]) -> Array:
    try:
        row = np.asarray(wire, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidValue(f"The wire state of a MiR100 must be {MIR_LENGTH} numbers: {error}.") from error
    if row.shape != (MIR_LENGTH,):
        raise InvalidValue(f"The wire state of a MiR100 has {MIR_LENGTH} numbers in a row; this has shape {row.shape}.")
    for place in np.flatnonzero(np.isinf(row)):
        raise InvalidValue(f"Number {place} of the wire state of a MiR100 must be finite, not {row[place]}.")
    return row


def read_ur(wire: Mapping[str, float]) -> RobotState:
    """The state of an arm: ``joint_position``, ``joint_velocity``, the object if there is one, ``collision`` as truth.

    The frames of flange and forearm are left out: they follow from the joints.

    Args:
        wire: Joint angles [rad] and speeds [rad/s], frames in ``base_link`` [m, quaternion x, y, z, w], and contact
            (0 or 1).

    Raises:
        InvalidValue: A key is missing or unknown, or its value is not finite; the error names the key.
    """
    mode = (
        "1moving2points" if wire.keys() & set(_FOREARM) else "1object" if wire.keys() & set(_OBJECT) else "only_robot"
    )
    keys = UR_KEYS[mode]
    for key in sorted(wire.keys() ^ set(keys)):
        what = f"lacks {key!r}" if key in keys else f"has {key!r}, which robo-gym's has not"
        raise InvalidValue(f"The wire state of a UR ({mode}: {len(keys)} keys) {what}; it has {len(wire)} keys.")
    signals = {"joint_position": _take(wire, POSITIONS), "joint_velocity": _take(wire, VELOCITIES)}
    if mode != "only_robot":
        signals["object_position"], signals["object_quaternion"] = read_object(wire)
    return _state(signals, _take(wire, ("in_collision",))[0], 6)


def read_object(wire: Mapping[str, float]) -> tuple[Array, Array]:
    """Target or obstacle of an arm's wire state in ``base_link``: position (3,) [m], quaternion w, x, y, z (4,)."""
    frame = _take(wire, _OBJECT)
    return frame[:3], frame[[6, 3, 4, 5]]


def _take(wire: Mapping[str, float], keys: Sequence[str]) -> Array:
    values = np.array([wire[key] for key in keys], dtype=np.float64)  # None is NaN
    for key, value in zip(keys, values, strict=True):
        if not np.isfinite(value):
            raise InvalidValue(f"{key} of the wire state of a UR must be finite, not {wire[key]}.")
    return values


def _state(signals: Mapping[str, Array], collision: float, commands: int) -> RobotState:
    """A wire state has no time stamp and no command."""
    batch = {name: np.array(values)[None] for name, values in signals.items()}
    return RobotState(batch, np.zeros(1), np.zeros((1, commands)), {"collision": np.array([collision == 1])})
