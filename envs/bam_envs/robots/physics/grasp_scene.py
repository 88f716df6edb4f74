"""The model of a grasp cell: a table, objects of random shapes on it, a camera above, and the arm's gripper in the air.

The gripper is that of ``ur5e_gripper.xml``. It hangs on two slides: one upwards, which lifts, and one along its
fingers, whose zero is the pose of a grasp.
"""

import math
from typing import Any

import numpy as np

from bam_envs.robots.grasping import CAMERA_HEIGHT, MIDDLE, VIEW
from bam_envs.robots.physics.mujoco_batch import MODELS, mujoco

LIFT, APPROACH, LEFT, RIGHT = range(4)
"""Indices of slides and fingers among the generalised positions; seven of each object follow."""
PARTS = 2  # geoms of an object
_SPREAD = 0.09  # farthest distance of an object from the middle of the table along x and y [m]
_GAP = 0.002  # least distance between two objects [m]
_TRIES = 40  # places that are tried for an object
_DENSITY = 450.0  # [kg/m^3], a light wood
_FRICTION, _GRIP = 0.6, 1.2  # sliding friction of the objects, and of the pads with anything
_FORCE = 60.0  # of the slides [N]
_BEYOND = 2.0  # x of objects that are not on the table [m]
_BOX, _CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER


def build(objects: int) -> Any:
    """The `MjSpec` of a cell with bodies ``object0``, ``object1``, ... of two geoms each."""
    source = str(MODELS / "ur5e_gripper.xml")
    cell, arm = mujoco.MjSpec.from_file(source), mujoco.MjSpec.from_file(source)
    cell.delete(cell.body("base"))
    cell.option.cone = arm.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    cell.memory = arm.memory = 2**21
    cell.stat.extent, cell.stat.center = 1.0, [*MIDDLE, 0.0]
    cell.visual.headlight.diffuse = [0.25] * 3  # both lights are above
    table = cell.geom("table")
    table.type, table.pos, table.size = mujoco.mjtGeom.mjGEOM_PLANE, [*MIDDLE, 0.0], [0.6, 0.6, 0.02]
    cell.camera("overview").pos = [0.94, -0.43, 0.42]
    opening = math.degrees(2 * math.atan2(VIEW / 2, CAMERA_HEIGHT))
    cell.worldbody.add_camera(name="above", pos=[*MIDDLE, CAMERA_HEIGHT], fovy=opening)
    body = cell.worldbody
    for name in ("lift", "approach"):
        body = body.add_body(name=name, mass=0.5, inertia=[1e-3] * 3, explicitinertial=True, gravcomp=1)
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    gripper = arm.body("gripper")
    gripper.pos = -arm.site("tool").pos
    body.add_frame().attach_body(gripper, "hand_", "")
    for name in ("lift", "approach"):
        drive = cell.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        drive.set_to_position(kp=20000.0, kv=400.0)
        drive.forcerange = [-_FORCE, _FORCE]
    for index in range(objects):
        body = cell.worldbody.add_body(name=f"object{index}")
        body.add_freejoint()
        for part in range(PARTS):
            body.add_geom(name=f"object{index}_{part}")
        _shape(body, np.random.default_rng(index))
    return cell


def draw(spec: Any, objects: int, rng: np.random.Generator, *, randomize: bool) -> tuple[Any, np.ndarray]:
    """A model with new shapes and colours, and its generalised positions: the objects at rest, apart from each other.

    An object that finds no place lies far from the table. `randomize` varies the density of the objects, and their
    friction and that of the pads.
    """
    density, friction = (rng.uniform(0.5, 2.0), rng.uniform(0.7, 1.3)) if randomize else (1.0, 1.0)
    for name in ("hand_left_pad", "hand_right_pad"):
        spec.geom(name).friction[0] = _GRIP * friction
    for index in range(objects):
        for geom in spec.body(f"object{index}").geoms:
            geom.density, geom.friction[0] = _DENSITY * density, _FRICTION * friction
    rests = [_shape(spec.body(f"object{index}"), rng) for index in range(objects)]
    model = spec.compile()
    data = mujoco.MjData(model)
    geoms = [[model.geom(f"object{index}_{part}").id for part in range(PARTS)] for index in range(objects)]
    for index, (rest, height) in enumerate(rests):
        pose = data.qpos[4 + 7 * index : 11 + 7 * index]
        for _ in range(_TRIES):
            x, y = MIDDLE + rng.uniform(-_SPREAD, _SPREAD, 2)
            mujoco.mju_mulQuat(pose[3:], _about_z(rng.uniform(0, 2 * math.pi)), rest)
            pose[:3] = x, y, height
            mujoco.mj_kinematics(model, data)
            earlier = [geom for group in geoms[:index] for geom in group]
            if all(
                mujoco.mj_geomDistance(model, data, one, other, _GAP, None) >= _GAP
                for one in geoms[index]
                for other in earlier
            ):
                break
        else:
            pose[:2] = _BEYOND + 0.3 * index, 0.0
    return model, data.qpos.copy()


def _shape(body: Any, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Give a body a random shape and colour; returns its orientation (w, x, y, z) at rest, and its height there [m]."""
    first, second = body.geoms
    kind = rng.choice(["box", "cylinder", "lying", "corner"], p=[0.35, 0.2, 0.15, 0.3])
    rest, hidden = np.array([1.0, 0.0, 0.0, 0.0]), True
    if kind == "box":
        long, narrow, height = rng.uniform(0.05, 0.12), rng.uniform(0.03, 0.08), rng.uniform(0.025, 0.06)
        first.type, first.size = _BOX, [long / 2, narrow / 2, height / 2]
    elif kind == "cylinder":
        radius, height = rng.uniform(0.02, 0.045), rng.uniform(0.03, 0.07)
        first.type, first.size = _CYLINDER, [radius, height / 2, 0]
    elif kind == "lying":
        radius, length = rng.uniform(0.018, 0.032), rng.uniform(0.05, 0.12)
        first.type, first.size, height = _CYLINDER, [radius, length / 2, 0], 2 * radius
        rest = np.array([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0])
    else:  # two bars that meet at a right angle
        one, other = rng.uniform(0.07, 0.12, 2)
        thick, height, hidden = rng.uniform(0.02, 0.035), rng.uniform(0.025, 0.05), False
        first.type, first.size = _BOX, [one / 2, thick / 2, height / 2]
        second.size = [thick / 2, (other - thick) / 2, height / 2]
        second.pos = [(one - thick) / 2, other / 2, 0]
    colour = [*rng.uniform(0.1, 0.95, 3), 1.0]
    for geom in (first, second):
        geom.rgba, geom.contype, geom.conaffinity = colour, 8, 13
    second.type = _BOX
    if hidden:  # inside the first, and nothing touches it; off its middle, as MuJoCo stores another inertia without
        second.size, second.pos, second.contype, second.conaffinity = [0.002] * 3, [0.001] * 3, 0, 0
    return rest, height / 2


def _about_z(angle: float) -> np.ndarray:
    return np.array([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)])
