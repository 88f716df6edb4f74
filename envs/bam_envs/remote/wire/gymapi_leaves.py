"""The layout of a Gymnasium space in the flat lists of a GymAPI message; both ends derive the leaves from the space.

============  =================================================  ============================================
kind          spaces                                             names
============  =================================================  ============================================
``NUMBERS``   Box, Discrete, MultiDiscrete, MultiBinary          ``arm/joints[2]``; without [i] for one number
``POSE``      Dict of position (3,) [m] and orientation (4,),    ``pick``
              x, y, z, w as in ROS; in an action perhaps with
              gripper_width [m]
``IMAGE``     Box of uint8, (height, width) or with 1, 3 or 4    ``camera``
              channels
``EXACT``     everything else, very long arrays                  ``goal``
============  =================================================  ============================================

Keys of Dict and places in Tuple are joined with ``/``. A space in which two names would be equal is one exact leaf.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from gymnasium import Space, spaces

from bam_envs.core.errors import ProtocolError
from bam_envs.core.spaces import Path, leaves_by_path, parts_of
from bam_envs.core.wording import listed

NUMBERS, POSE, IMAGE, EXACT = "numbers", "pose", "image", "exact"
GRIPPER_WIDTH = "gripper_width"
_MOST_NUMBERS = 4096
_SMALLEST_IMAGE = 8
"""An image with fewer pixels a side is sent as numbers, which are readable in a log."""
_WHOLE = 2**53
"""Every integer up to this is exact as a float64."""
_CHANNELS = ((), (1,), (3,), (4,))
_POSE_SHAPES: dict[str, list[tuple[int, ...]]] = {"position": [(3,)], "orientation": [(4,)], GRIPPER_WIDTH: [(), (1,)]}


@dataclass(frozen=True)
class GymApiLeaf:
    """One part of a value."""

    kind: str
    """See the top of the module."""
    name: str
    """Unique in its space; the name of the space itself if it has no parts."""
    path: Path
    """Keys and places that lead to it."""
    space: Space[Any]
    """The space of this part."""
    labels: tuple[str, ...]
    """Names of its numbers; of other kinds only its name."""


def leaves_of(space: Space[Any], name: str, *, gripper: bool = False) -> tuple[GymApiLeaf, ...]:
    """The leaves of `space`, which is called `name`; with `gripper`, a pose may have a gripper width."""
    found = leaves_by_path(space, lambda part: _is_pose(part, gripper) or not parts_of(part))
    leaves = tuple(_leaf(path, part, name, gripper) for path, part in found)
    names, labels = [leaf.name for leaf in leaves], [label for leaf in leaves for label in leaf.labels]
    unique = len({*names}) == len(names) and len({*labels}) == len(labels)
    return leaves if unique else (GymApiLeaf(EXACT, name, (), space, (name,)),)


def _leaf(path: Path, space: Space[Any], name: str, gripper: bool) -> GymApiLeaf:
    name, shape, kind, labels = "/".join(map(str, path)) or name, space.shape or (), EXACT, None
    arrays = isinstance(space, (spaces.Box, spaces.MultiDiscrete, spaces.MultiBinary))
    fits = arrays and 0 < np.prod(shape) <= _MOST_NUMBERS and np.dtype(space.dtype).itemsize <= 8
    if _is_pose(space, gripper):
        kind = POSE
    elif _is_image(space, shape):
        kind = IMAGE
    elif fits or isinstance(space, spaces.Discrete):
        indices, kind = np.ndindex(*shape), NUMBERS
        labels = tuple(f"{name}[{', '.join(map(str, index))}]" if index else name for index in indices)
    return GymApiLeaf(kind, name, path, space, labels or (name,))


def _is_image(space: Space[Any], shape: tuple[int, ...]) -> bool:
    bytes_ = isinstance(space, spaces.Box) and space.dtype == np.uint8
    return bytes_ and len(shape) in (2, 3) and min(shape[:2]) >= _SMALLEST_IMAGE and shape[2:] in _CHANNELS


def _is_pose(space: Space[Any], gripper: bool) -> bool:
    if not isinstance(space, spaces.Dict) or not {"position", "orientation"} <= space.spaces.keys():
        return False
    keys = _POSE_SHAPES.keys() if gripper else _POSE_SHAPES.keys() - {GRIPPER_WIDTH}
    return space.spaces.keys() <= keys and all(
        _is_float_box(part) and (part.shape or ()) in _POSE_SHAPES[key] for key, part in space.spaces.items()
    )


def _is_float_box(space: Space[Any]) -> bool:
    dtype = np.dtype(space.dtype)
    return isinstance(space, spaces.Box) and dtype.kind == "f" and dtype.itemsize <= 8


def is_depth(space: Space[Any]) -> bool:
    """Whether values of `space` may be depth images: floats, (height, width) or (height, width, 1)."""
    return _is_float_box(space) and len(space.shape or ()) in (2, 3) and (space.shape or ())[2:] in ((), (1,))


@dataclass(frozen=True)
class Lists:
    """Leaves of one kind in two lists of a message: their names, and their numbers or poses."""

    names: str
    """Field with the names."""
    values: str
    """Field with the numbers or poses."""
    leaves: tuple[GymApiLeaf, ...]
    """In the order of the values if none of the names is known."""
    extra: bool = False
    """Whether the lists may hold more than the leaves."""

    def write(self, leaf: GymApiLeaf, part: Any, fields: dict[str, Any]) -> bool:
        """Append a part to the lists in `fields`; False if those cannot hold it exactly."""
        written = _numbers(part) if leaf.kind == NUMBERS else _pose(part)
        if written is None:
            return False
        fields.setdefault(self.names, []).extend(leaf.labels)
        fields.setdefault(self.values, []).extend(written)
        return True

    def read(self, message: Mapping[str, Any]) -> dict[Path, Any]:
        """The value of each leaf. Raises ProtocolError for one that is missing, unexpected, or does not fit."""
        ordered = iter(self.in_order(message[self.values], message[self.names]))
        read = _read_pose if self.leaves and self.leaves[0].kind == POSE else _read_numbers
        return {leaf.path: read(leaf, list(islice(ordered, len(leaf.labels)))) for leaf in self.leaves}

    def in_order(self, values: Sequence[Any], names: Sequence[str], field: str = "") -> Sequence[Any]:
        """`values`, which errors call `field`, by their `names` in the order of the leaves.

        If none of the names is expected, only the number of values counts.
        """
        field = field or self.values
        expected = tuple(label for leaf in self.leaves for label in leaf.labels)
        known = set(expected) & set(names)
        if not known:
            if len(values) != len(expected):
                raise ProtocolError(
                    f"{field} must have {len(expected)} values ({listed(expected)}), not {len(values)}."
                )
            return values
        if len(names) != len(values) or len(known) < len(expected) or (len(names) > len(expected) and not self.extra):
            raise ProtocolError(
                f"The names of {field} must be {listed(expected)}, one for each value, "
                f"not {listed(names)} for {len(values)} values."
            )
        if tuple(names) == expected:
            return values
        table = dict(zip(names, values, strict=True))
        return [table[name] for name in expected]


def _numbers(value: Any) -> list[Any] | None:
    """A number or array as a flat list of floats or ints, or None if that would not be exact."""
    array = np.asarray(value)
    if array.dtype.kind == "f":
        return array.ravel().tolist() if np.isfinite(array).all() else None
    plain = [int(one) for one in array.ravel().tolist()]
    return plain if all(-_WHOLE <= one <= _WHOLE for one in plain) else None


def _read_numbers(leaf: GymApiLeaf, numbers: Sequence[Any]) -> Any:
    dtype = np.dtype(leaf.space.dtype)
    wide = np.asarray(numbers, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        array = wide.astype(dtype)
        bad = ~np.isfinite(array) if dtype.kind == "f" else array.astype(np.float64) != wide
    if bad.any():
        place = int(np.argmax(bad))
        raise ProtocolError(f"{leaf.labels[place]} must be a number that {dtype} can hold, not {numbers[place]!r}.")
    return array[0] if isinstance(leaf.space, spaces.Discrete) else array.reshape(leaf.space.shape or ())


def _pose(value: Mapping[str, Any]) -> list[dict[str, Any]] | None:
    """One geometry_msgs/PoseStamped, or None if the pose is not finite."""
    if not all(np.isfinite(part).all() for part in value.values()):
        return None
    position = dict(zip("xyz", value["position"].tolist(), strict=True))
    orientation = dict(zip("xyzw", value["orientation"].tolist(), strict=True))
    return [{"pose": {"position": position, "orientation": orientation}}]


def _read_pose(leaf: GymApiLeaf, messages: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The pose in one PoseStamped; a gripper width, which the message lacks, is 0."""
    pose = messages[0]["pose"]
    numbers = {
        "position": [pose["position"][axis] for axis in "xyz"],
        "orientation": [pose["orientation"][axis] for axis in "xyzw"],
        GRIPPER_WIDTH: [0.0],
    }
    parts = leaf.space.spaces.items()  # type: ignore[attr-defined]
    return {key: np.array(numbers[key], part.dtype).reshape(part.shape) for key, part in parts}
