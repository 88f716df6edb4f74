"""The state of UR arms under robo-gym's names, one plain dict of floats a row: what ``rs_state_to_info`` hands out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.kinematics import LINKS, quaternions
from bam_envs.core.robot import RobotState
from bam_envs.core.task import Array
from bam_envs.robots.ur import UrModel
from bam_envs.tasks.ur_control import WIRE_JOINTS, collisions

POSITIONS = tuple(f"{joint}_joint_position" for joint in WIRE_JOINTS)
VELOCITIES = tuple(f"{joint}_joint_velocity" for joint in WIRE_JOINTS)
FOREARM = LINKS.index("forearm_link")


def frame_keys(frame: str) -> tuple[str, ...]:
    """Seven keys of a frame's pose: translation x, y, z, rotation x, y, z, w."""
    return (
        *(f"{frame}_to_ref_translation_{axis}" for axis in "xyz"),
        *(f"{frame}_to_ref_rotation_{axis}" for axis in "xyzw"),
    )


def wire_states(
    model: UrModel,
    state: RobotState,
    object_position: Array | None = None,
    *,
    with_forearm: bool = False,
) -> list[dict[str, float]]:
    """One dict a row: 20 keys, 7 more with an object, 7 more with the forearm.

    Args:
        model: Which arm.
        state: What was measured.
        object_position: Where the target or obstacle is [m]; its orientation is that of ``base_link``. Shape: (n, 3).
        with_forearm: Whether the pose of ``forearm_link`` is in it.
    """
    joints = state.signals["joint_position"]
    keys = [*POSITIONS, *VELOCITIES]
    columns = [joints, state.signals["joint_velocity"]]
    if object_position is not None:
        keys += frame_keys("object_0")
        columns += [object_position, np.tile([0.0, 0.0, 0.0, 1.0], (len(joints), 1))]
    positions, rotations = model.geometry.link_poses(joints)
    for frame, link in (("ee", -1), ("forearm", FOREARM)) if with_forearm else (("ee", -1),):
        keys += frame_keys(frame)
        columns += [positions[:, link], quaternions(rotations[:, link])]
    rows = np.concatenate([*columns, collisions(state)[:, None].astype(np.float64)], axis=1)
    return [dict(zip([*keys, "in_collision"], row, strict=True)) for row in rows.tolist()]


def as_objects(values: list[Any]) -> NDArray[Any]:
    """`values` as an info: one object a row. Shape: (n,)."""
    objects = np.empty(len(values), dtype=object)
    objects[:] = values
    return objects
