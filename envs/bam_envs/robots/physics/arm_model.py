"""The simulated model of any described arm: its links as capsules on the table, with a gripper of two parallel pads.

A gripper is the one of ``ur5e_gripper.xml``, in the size of the description's. Each link's mass is spread over its
capsules. The shipped UR5e has a model of its own, from before descriptions, with the published moments of inertia.
"""

from typing import Any

import numpy as np

from bam_envs.arms.description import ArmDescription, Box, Placed, cube_edge
from bam_envs.arms.serial_chain import Capsule
from bam_envs.core.robot_models import SHIPPED, read_description
from bam_envs.robots.physics.mujoco_batch import MODELS, mujoco

CUBE_DENSITY = 0.08 / 0.04**3
"""Of beech [kg/m^3]."""
SERVO_LAG = 0.05
"""Delay of a joint behind its set point: damping by stiffness of its actuator [s]."""
_LOOKED_AT = np.array([0.3, 0.0, 0.25])  # by the camera of pictures, nearer or farther by the size of the arm [m]
_STIFFNESS = 60.0  # of an actuator, by its torque [1/rad]
_ARMATURE = 0.003  # inertia of the motor, by its torque [kg m^2 / (N m)]


def scene_spec(description: ArmDescription, *, with_object: bool) -> Any:
    """The `mujoco.MjSpec` of the arm on its table, and of a cube if there is one."""
    if description.digest == read_description(SHIPPED / "ur5e.toml").digest:
        spec = mujoco.MjSpec.from_file(str(MODELS / ("ur5e_cube.xml" if with_object else "ur5e_gripper.xml")))
    else:
        text = arm_mjcf(description, with_object=with_object)
        spec = mujoco.MjSpec.from_string(text, {"table.xml": (MODELS / "table.xml").read_bytes()})
    camera, chain = spec.camera("overview"), description.chain
    length = float(np.linalg.norm(chain.placements[:, :3, 3], axis=1).sum())
    camera.pos = _LOOKED_AT + float(np.clip(1.3 * length, 0.5, 2.5)) * (camera.pos - _LOOKED_AT)
    return spec


def arm_mjcf(description: ArmDescription, *, with_object: bool) -> str:
    """The MJCF text of the arm on its table."""
    size, chain = description.num_joints, description.chain
    mount = _pose(description.mount)
    lines = ['<mujoco model="arm">', '<include file="table.xml"/>', "<worldbody>"]
    lines += [f'<body name="base" {mount} childclass="arm">', *_capsules(description, 0, 4.0)]
    for link, row in enumerate(description.joints, 1):
        axis = " ".join(map(repr, row.axis))
        armature = float(np.clip(_ARMATURE * row.effort, 0.005, 0.1))
        lines += [
            f'<body name="link_{link}" {_pose(row)} gravcomp="1">',
            f'<joint name="{row.name}" axis="{axis}" range="{row.low!r} {row.high!r}" armature="{armature:g}" '
            f'damping="{row.effort / 75:g}"/>',
            *_capsules(description, link, row.mass),
        ]
    lines += [*_gripper(description), "</body>" * (size + 1)]
    if with_object:
        half = cube_edge(description.gripper.open, chain.turns) / 2
        x, y = np.mean(np.array(description.workspace)[:, :2], axis=0).tolist()
        lines += [
            f'<body name="object" pos="{x:g} {y:g} {half:g}"><freejoint name="object"/>',
            f'<geom name="object" type="box" size="{half:g} {half:g} {half:g}" mass="{CUBE_DENSITY * 8 * half**3:g}" '
            'rgba="0.85 0.32 0.18 1" group="0" contype="8" conaffinity="5" friction="0.6 0.005 0.0001"/></body>',
        ]
    lines += ["</worldbody>", *_drives(description), "</mujoco>"]
    return "\n".join(lines)


def _pose(placed: Placed) -> str:
    pos, quat = (" ".join(map(repr, values)) for values in (placed.xyz, placed.quat))
    return f'pos="{pos}" quat="{quat}"'


def _capsules(description: ArmDescription, link: int, mass: float) -> list[str]:
    """The geoms of a link, with shares of its mass; a link without capsules is a small ball that touches nothing."""
    capsules = [one for one in description.capsules if one.link == link]
    if not capsules:
        radius = 0.02
        return [f'<geom type="sphere" size="{radius}" mass="{mass:g}" contype="0" conaffinity="0"/>']
    volumes = np.array([_volume(one) for one in capsules])
    shares = (mass * volumes / volumes.sum()).tolist()
    bare = 'contype="0" conaffinity="0"' if link < 2 else ""  # base and shoulder stand in the table
    return [_geom(one, share, bare) for one, share in zip(capsules, shares, strict=True)]


def _volume(capsule: Capsule) -> float:
    length = float(np.linalg.norm(np.subtract(capsule.end, capsule.start)))
    return capsule.radius**2 * (length + 4 / 3 * capsule.radius)


def _geom(capsule: Capsule, mass: float, more: str) -> str:
    start, end = np.array(capsule.start), np.array(capsule.end)
    if np.linalg.norm(end - start) < 1e-4:
        place = " ".join(map(repr, start.tolist()))
        return f'<geom type="sphere" size="{capsule.radius!r}" pos="{place}" mass="{mass:g}" {more}/>'
    ends = " ".join(map(repr, (*start.tolist(), *end.tolist())))
    return f'<geom type="capsule" size="{capsule.radius!r}" fromto="{ends}" mass="{mass:g}" {more}/>'


def _gripper(description: ArmDescription) -> list[str]:
    """The gripper's body, turned as the tool and 15 cm before its point if it opens to 85 mm, and its fingers."""
    tool, width, mass = description.tool.matrix(), description.gripper.open, description.gripper.mass
    length, (palm, finger, pad) = description.gripper.boxes(tool)
    root, fingers = tool[:3, 3] - length * tool[:3, 2], 2 * palm[0][2]
    pos, quat = " ".join(map(repr, root.tolist())), " ".join(map(repr, description.tool.quat))
    lines = [
        f'<body name="gripper" pos="{pos}" quat="{quat}" childclass="gripper" gravcomp="1">',
        f'<camera name="wrist" pos="0 {-75 / 32 * palm[1][1]:g} 0.03" xyaxes="1 0 0 0 -0.97 0.24" fovy="78"/>',
        f'<geom name="palm" {_box(palm)} mass="{0.8 * mass:g}"/>',
        f'<site name="tool" pos="0 0 {length!r}" size="0.004" rgba="0.9 0.2 0.2 0"/>',
    ]
    for name, side in (("left", 1), ("right", -1)):
        lines += [
            f'<body name="{name}_finger" pos="0 0 {fingers:g}" gravcomp="1">',
            f'<joint name="{name}_finger_joint" axis="{side} 0 0" range="0 {width / 2!r}"/>',
            f'<geom {_box(finger, side, fingers)} mass="{0.05 * mass:g}"/>',
            f'<geom class="pad" name="{name}_pad" {_box(pad, side, fingers)} mass="{0.05 * mass:g}"/>',
            "</body>",
        ]
    return [*lines, "</body>"]


def _box(box: Box, side: int = 1, base: float = 0.0) -> str:
    """Size and place of a box on one side, from a base at a height."""
    (x, y, z), half = box
    size = " ".join(f"{one:g}" for one in half)
    return f'size="{size}" pos="{side * x:g} {y:g} {z - base:g}"'


def _drives(description: ArmDescription) -> list[str]:
    """Position servos of the joints and of the gripper, whose two fingers are coupled."""
    lines = [
        '<tendon><fixed name="width"><joint joint="left_finger_joint" coef="1"/>'
        '<joint joint="right_finger_joint" coef="1"/></fixed></tendon>',
        '<equality><joint joint1="left_finger_joint" joint2="right_finger_joint" polycoef="0 1 0 0 0" '
        'solref="0.005 1"/></equality>',
        "<actuator>",
    ]
    for row in description.joints:
        stiffness = _STIFFNESS * row.effort
        lines.append(
            f'<position name="{row.name}" joint="{row.name}" kp="{stiffness:g}" kv="{SERVO_LAG * stiffness:g}" '
            f'ctrlrange="{row.low!r} {row.high!r}" forcerange="{-row.effort:g} {row.effort:g}"/>'
        )
    width, force = description.gripper.open, description.gripper.force
    lines.append(
        f'<position name="gripper" tendon="width" kp="4000" kv="60" ctrlrange="0 {width!r}" '
        f'forcerange="{-force:g} {force:g}"/>'
    )
    return [*lines, "</actuator>"]
