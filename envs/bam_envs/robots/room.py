"""Where a simulated base drives: a rectangle of walls or none, and boxes; what the base touches, and its lasers see.

Rays are cast in float32, many bases at a time, and written into scratch arrays that stay in the cache: so a base with
its 1012 rays takes about 10 µs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import BaseBody, Scanner
from bam_envs.robots.base_description import MOST_RAYS

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]
Seeds = NDArray[np.uint64]
BOX_EDGE = 0.5
"""Edge of a box [m]."""
NOWHERE = (1000.0, 1000.0, 0.0)
"""Pose of a box that is not there: out of sight [m, m, rad]."""
NOISE = 0.01  # standard deviation of a measured range [m]
_CHUNK = 64
_TAPE = 1 << 17
_SIZE = 0.56733  # farthest point of a MiR100 from its frame [m]
_ONE, _HALF_EDGE = np.float32(1.0), np.float32(BOX_EDGE / 2)


@dataclass(frozen=True)
class Room:
    """Four walls, from the lowest x and y [m] to the highest; the space between them is free."""

    low: tuple[float, float]
    high: tuple[float, float]


LAB = Room((-2.877, -3.836), (2.823, 3.864))
"""The inside of robo-gym's world ``lab_6x8``."""


def room_for(body: BaseBody) -> float:
    """How many times as large as `LAB` and the distances in it a room for this base is: 1 up to a MiR100's size."""
    return max(1.0, round(body.size / _SIZE, 2))


def touches(body: BaseBody, pose: Array, room: Room | None, boxes: Array) -> Flags:
    """Whether the footprint of each base touches a wall, if there is a `room`, or a box.

    Poses are x, y [m], yaw [rad]. Shapes: (n, 3), (n, b, 3) -> (n,).
    """
    yaw = pose[:, 2:].copy()
    cos, sin = np.cos(yaw), np.sin(yaw)
    own_x, own_y = np.array(body.corners).T
    x, y = pose[:, :1] + own_x * cos - own_y * sin, pose[:, 1:2] + own_x * sin + own_y * cos
    hit = np.zeros(len(pose), dtype=bool)
    if room is not None:
        for places, least, most in ((x, room.low[0], room.high[0]), (y, room.low[1], room.high[1])):
            hit |= ((places < least + body.radius) | (places > most - body.radius)).any(axis=1)
    for box in range(boxes.shape[1]):
        hit |= _touches_box(body, x, y, pose, cos, sin, boxes[:, box])
    return hit


def _touches_box(body: BaseBody, x: Array, y: Array, pose: Array, cos: Array, sin: Array, box: Array) -> Flags:
    """Whether each base, with corners at `x` and `y` (n, c), touches a box (n, 3). Shape: (n,)."""
    box_x, box_y, yaw = np.ascontiguousarray(box.T)[..., None]
    box_cos, box_sin, half = np.cos(yaw), np.sin(yaw), BOX_EDGE / 2
    dx, dy = x - box_x, y - box_y
    in_box = (dx * box_cos + dy * box_sin, dy * box_cos - dx * box_sin)
    if body.radius:
        off_x, off_y = (np.maximum(np.abs(one[:, 0]) - half, 0.0) for one in in_box)
        near: Flags = np.hypot(off_x, off_y) <= body.radius
        return near
    # Two convex polygons are apart if a side of one of them separates them.
    apart = np.any([np.maximum(one.min(axis=1), -one.max(axis=1)) > half for one in in_box], axis=0)
    side_x, side_y, side = np.array(body.sides).T
    dx, dy = box_x - pose[:, :1], box_y - pose[:, 1:2]
    turn_cos, turn_sin = cos * box_cos + sin * box_sin, sin * box_cos - cos * box_sin
    reach = half * (np.abs(side_x * turn_cos - side_y * turn_sin) + np.abs(side_x * turn_sin + side_y * turn_cos))
    away = (dx * cos + dy * sin) * side_x + (dy * cos - dx * sin) * side_y
    touching: Flags = ~(apart | (away - side > reach).any(axis=1))
    return touching


class LaserScanner:
    """The laser `scanner` on every base."""

    def __init__(self, scanner: Scanner) -> None:
        self._mount, bearing = scanner.pose, np.array(scanner.bearings)
        self._directions = (np.cos(bearing).astype(np.float32), np.sin(bearing).astype(np.float32))
        self._scratch = np.empty((6, _CHUNK, len(bearing)), np.float32)
        self._hits = np.empty((_CHUNK, len(bearing)), bool)

    def cast(self, pose: Array, room: Room | None, boxes: Array) -> Floats:
        """Range of each ray to a wall or a box [m]; infinite if it meets none.

        Poses of bases and boxes as in `touches`. Shapes: (n, 3), (n, b, 3) -> (n, rays).
        """
        x, y, yaw = np.ascontiguousarray(pose.T)
        (ahead, left, turned), cos, sin = self._mount, np.cos(yaw), np.sin(yaw)
        eye, heading = np.stack([x + ahead * cos - left * sin, y + ahead * sin + left * cos], axis=1), yaw + turned
        ranges = np.empty((len(pose), self._hits.shape[1]), np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):  # rays along an axis
            for start in range(0, len(pose), _CHUNK):
                chunk = slice(start, start + _CHUNK)
                out = ranges[chunk]
                self._to_walls(eye[chunk], heading[chunk], room, out)
                for box in range(boxes.shape[1]):
                    self._to_box(eye[chunk], heading[chunk], boxes[chunk, box], out)
        return ranges

    def _slopes(self, turn: Array, scratch: Floats) -> tuple[Floats, Floats]:
        """1 / x and 1 / y of each ray's direction, after a turn (k,) [rad]. Shape: (k, rays) each."""
        (cos_ray, sin_ray), (x, y, product) = self._directions, scratch
        cos, sin = _column(np.cos(turn)), _column(np.sin(turn))
        np.multiply(cos_ray, cos, out=x)
        np.multiply(sin_ray, sin, out=product)
        x -= product
        np.multiply(cos_ray, sin, out=y)
        np.multiply(sin_ray, cos, out=product)
        y += product
        return np.divide(_ONE, x, out=x), np.divide(_ONE, y, out=y)

    def _to_walls(self, eye: Array, heading: Array, room: Room | None, out: Floats) -> None:
        """Write the ranges from inside the room to its walls into `out` (k, rays)."""
        if room is None:
            out[:] = np.inf
            return
        scratch = self._scratch[:, : len(out)]
        slopes, (one, other) = self._slopes(heading, scratch[:3]), scratch[3:5]
        for axis, target in ((0, out), (1, other)):
            np.multiply(slopes[axis], _column(room.high[axis] - eye[:, axis]), out=target)
            np.multiply(slopes[axis], _column(room.low[axis] - eye[:, axis]), out=one)
            np.maximum(target, one, out=target)  # the wall behind has a negative range
        np.minimum(out, other, out=out)

    def _to_box(self, eye: Array, heading: Array, box: Array, out: Floats) -> None:
        """Shorten `out` (k, rays) where a box (k, 3) is in the way.

        In the box's frame a ray is between two parallel sides from `near` to `far`; it meets the box if it is between
        both pairs at once.
        """
        yaw = box[:, 2].copy()
        cos, sin = np.cos(yaw), np.sin(yaw)
        dx, dy = box[:, 0] - eye[:, 0], box[:, 1] - eye[:, 1]
        scratch = self._scratch[:, : len(out)]
        slopes, (near, far, spare) = self._slopes(heading - yaw, scratch[:3]), scratch[3:]
        nears, fars = (near, scratch[2]), (far, spare)
        for slope, middle, first, last in zip(
            slopes, (dx * cos + dy * sin, dy * cos - dx * sin), nears, fars, strict=True
        ):
            # `slope` is overwritten with the range to the farther side
            np.multiply(slope, _column(middle) - _HALF_EDGE, out=first)
            np.multiply(slope, _column(middle) + _HALF_EDGE, out=slope)
            np.maximum(first, slope, out=last)
            np.minimum(first, slope, out=first)
        np.maximum(near, scratch[2], out=near)
        np.maximum(near, np.float32(0.0), out=near)
        np.minimum(far, spare, out=far)
        hits = np.less_equal(near, far, out=self._hits[: len(out)])
        np.minimum(out, near, out=out, where=hits)


def _column(values: Array) -> Floats:
    """As a column of float32. Shape: (k,) -> (k, 1)."""
    return values.astype(np.float32)[:, None]


def measured(ranges: Floats, deviates: Floats, scanners: Sequence[Scanner]) -> Array:
    """What `scanners` measure, from true `ranges` (n, rays) [m] and `deviates` (n, rays) [m]."""
    ranges, begin = ranges + deviates, 0
    for scanner in scanners:
        part = ranges[:, begin : begin + len(scanner.bearings)]
        np.fmax(part, np.float32(scanner.range[0]), out=part)  # NaN becomes the least range
        np.minimum(part, np.float32(scanner.range[1]), out=part)
        begin += part.shape[1]
    return ranges.astype(np.float64)


def noise(seeds: Seeds, count: Seeds, rays: int) -> Floats:
    """Normal deviates of mean 0 and standard deviation `NOISE` [m]; `rays` are at most `MOST_RAYS`.

    Each scan is a section of one long tape, at a position given by the seed of its base and its number `count` in the
    episode: no environment needs a generator, and a scan costs one copy. Shapes: (n,), (n,) -> (n, rays).
    """
    starts = mixed(seeds + mixed(count)) % np.uint64(_TAPE)
    deviates: Floats = np.lib.stride_tricks.sliding_window_view(_tape(), rays)[starts.astype(np.int64)]
    return deviates


@cache
def _tape() -> Floats:
    deviates = np.random.Generator(np.random.PCG64(100)).standard_normal(_TAPE + MOST_RAYS, dtype=np.float32)
    tape: Floats = deviates * np.float32(NOISE)
    return tape


def mixed(values: Seeds) -> Seeds:
    """One pseudo-random number for each value: splitmix64 (Steele, Lea and Flood, OOPSLA 2014)."""
    z = values + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixture: Seeds = z ^ (z >> np.uint64(31))
    return mixture
