"""Long meshes in parts, whose convex hulls are closer to the surface than the hull of a whole bent link."""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.robots.physics.mujoco_batch import mujoco

Array = NDArray[np.float64]
_LONG, _MOST_PARTS = 0.15, 5  # shorter meshes stay whole [m]
_THINNEST = 0.001  # part that has a convex hull [m]


def model_in_parts(spec: Any, model: Any, geoms: list[int]) -> Any:
    """The compiled `spec` in which parts of the meshes among `geoms` collide instead of them, and no other geoms.

    Args:
        spec: The model, which is changed.
        model: The same, compiled.
        geoms: Geoms of `model` that count as the shapes of links.
    """
    for one, geom in [(one, int(one.id)) for one in spec.geoms]:  # numbers change when a geom is added
        one.contype = one.conaffinity = int(geom in geoms)
        mesh = int(model.geom_dataid[geom])
        if geom not in geoms or model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
            continue
        first, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(np.float64)
        parts = mesh_parts(points[model.mesh_face[face : face + model.mesh_facenum[mesh]]])
        if len(parts) < 2:
            continue
        one.contype = one.conaffinity = 0
        for place, part in enumerate(parts):
            name = f"bam_part{geom}_{place}"
            spec.add_mesh(name=name, uservert=part.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
            pose = {"pos": model.geom_pos[geom], "quat": model.geom_quat[geom]}
            kind = mujoco.mjtGeom.mjGEOM_MESH
            one.parent.add_geom(name=name, type=kind, meshname=name, mass=0.0, contype=1, conaffinity=1, **pose)
    return spec.compile()


def mesh_parts(triangles: Array) -> list[Array]:
    """Corners of a surface of `triangles` (n, 3, 3) [m] in parts, cut across its longest axis, as long as wide."""
    sizes = np.ptp(triangles, axis=(0, 1))
    axis, count = int(sizes.argmax()), min(_MOST_PARTS, round(sizes.max() / max(float(np.median(sizes)), 1e-9)))
    count = count if sizes.max() > _LONG else 1
    ends = np.linspace(triangles[..., axis].min(), triangles[..., axis].max(), max(1, count) + 1)
    start, end = triangles.reshape(-1, 3), np.roll(triangles, -1, axis=1).reshape(-1, 3)
    cuts = []
    for place in ends[1:-1]:
        crosses = (start[:, axis] - place) * (end[:, axis] - place) < 0.0
        one, other = start[crosses], end[crosses]
        share = (place - one[:, axis]) / (other[:, axis] - one[:, axis])
        cuts.append(one + share[:, None] * (other - one))
    inside = [start[(start[:, axis] >= low) & (start[:, axis] <= high)] for low, high in itertools.pairwise(ends)]
    none = np.zeros((0, 3))
    groups = zip([none, *cuts], inside, [*cuts, none], strict=True)
    parts = [np.unique(np.concatenate(group).round(6), axis=0) for group in groups]
    whole = all(len(part) > 3 and np.linalg.svd(part - part.mean(axis=0))[1][-1] > _THINNEST for part in parts)
    return parts if whole else [start]
