"""Capsules, segments with a radius: fitted around points, and their distances, batched over postures."""

import itertools

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.serial_chain import Capsule, SerialChain

Array = NDArray[np.float64]
_DIRECTIONS = 500
_GAIN = 0.8  # two capsules instead of one must have less than this share of its volume
_NEARLY_ALWAYS = 0.5  # share of postures
_TRIALS = 250  # steps of the search for a thinner capsule
_NEAR = 0.06  # capsules that come no nearer in the postures looked at do not touch in others [m]


_Fit = tuple[Array, Array, float]
"""Ends and radius of a capsule."""
WHOLE = 0.9
"""Least share of an arm's collisions with itself that its outline has to find."""
MOST_FALSE = 2.0
"""Most postures without a collision that may count as one [%]; more of them make the work area small."""


def fitted_capsules(points: Array, link: int, most: int = 2, power: int = 2, seed: int = 0) -> list[Capsule]:
    """Capsules around all `points` (n, 3) [m] on the surface of a link, in the frame of the points; `most` at most.

    The least of their volumes is taken, with the radius to the given `power`: 3 gives thinner, longer ones.
    The search is random, from `seed` on.
    """
    if len(points) == 0:
        return []
    outer = _outermost(points)
    rng = np.random.default_rng(seed)
    best = [_thinner(outer, _capsule(outer, power), rng, power)]
    while len(best) < most:
        gaps = [_distances(outer, start, end) - radius for start, end, radius in best]
        nearest, halves = np.argmin(gaps, axis=0), []
        for at, one in enumerate(best):
            pair = _halves(outer[nearest == at], one, rng, power)
            halves.append((_size([one], power) - _size(pair, power), at, pair))
        gained, at, pair = max(halves, key=lambda half: half[:2])
        if gained <= (1.0 - (_GAIN if most <= 2 else 1.0)) * _size([best[at]], power):
            break
        best = [*best[:at], *pair, *best[at + 1 :]]
    gaps = [_distances(points, start, end) - radius for start, end, radius in best]
    outside = max(0.0, float(np.min(gaps, axis=0).max()))  # of points that were left out
    return [
        Capsule(link=link, start=_rounded(start), end=_rounded(end), radius=round(radius + outside + 1e-4, 4))
        for start, end, radius in best
    ]


def _halves(points: Array, one: _Fit, rng: np.random.Generator, power: int) -> list[_Fit]:
    """The two smallest capsules around `points` instead of `one`; that one if there are none."""
    splits: list[list[_Fit]] = []
    if len(points) < 2:
        return [one]
    for axis in np.concatenate([_principal_axes(points), np.eye(3)]):
        along = points @ axis
        for share in (0.3, 0.5, 0.7):
            first = along < along.min() + share * (along.max() - along.min())
            if first.any() and not first.all():
                splits.append([_capsule(points[first], power), _capsule(points[~first], power)])
    splits.sort(key=lambda pair: _size(pair, power))
    pairs = [_thinner_pair(points, pair, rng, power) for pair in splits[:2]]
    return min(pairs, key=lambda pair: _size(pair, power), default=[one])


def _outermost(points: Array) -> Array:
    """The points that are farthest out in one of many directions, and some of all others."""
    if len(points) <= 2 * _DIRECTIONS:
        return points
    rng = np.random.default_rng(0)
    ways = rng.standard_normal((_DIRECTIONS, 3))
    others = rng.choice(len(points), _DIRECTIONS, replace=False)
    outermost: Array = points[np.unique(np.concatenate([(points @ ways.T).argmax(axis=0), others]))]
    return outermost


def _capsule(points: Array, power: int) -> _Fit:
    """The thinnest capsule about a principal axis of the points."""
    options = []
    for axis in _principal_axes(points):
        along = points @ axis
        across = points - along[:, None] * axis
        middle = 0.5 * (across.min(axis=0) + across.max(axis=0))
        radius = float(np.linalg.norm(across - middle, axis=1).max())
        low, high = float(along.min()) + radius, float(along.max()) - radius
        if low > high:
            low = high = 0.5 * (low + high)
        options.append(_around(points, middle + low * axis, middle + high * axis))
    return min(options, key=lambda one: _size([one], power))


def _around(points: Array, start: Array, end: Array) -> _Fit:
    """The capsule about a segment that holds all points."""
    return start, end, float(_distances(points, start, end).max()) + 1e-6


def _thinner(points: Array, fit: _Fit, rng: np.random.Generator, power: int) -> _Fit:
    """The smallest capsule that a random search about `fit` finds."""
    step = 0.3 * fit[2]
    for _ in range(_TRIALS):
        move = step * rng.standard_normal((2, 3))
        trial = _around(points, fit[0] + move[0], fit[1] + move[1])
        if _size([trial], power) < _size([fit], power):
            fit = trial
        else:
            step *= 0.985
    return fit


def _thinner_pair(points: Array, pair: list[_Fit], rng: np.random.Generator, power: int) -> list[_Fit]:
    """Two capsules about the points that are nearer to them, three times over."""
    for _ in range(3):
        gaps = [_distances(points, start, end) - radius for start, end, radius in pair]
        first = gaps[0] < gaps[1]
        if not first.any() or first.all():
            break
        pair = [_thinner(points[mine], fit, rng, power) for mine, fit in zip((first, ~first), pair, strict=True)]
    return pair


def _distances(points: Array, start: Array, end: Array) -> Array:
    """Distance of each point from a segment. Shape: (n, 3) -> (n,)."""
    way, gap = end - start, points - start
    share = np.clip(gap @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
    apart = gap - share[:, None] * way
    distance: Array = np.sqrt(np.einsum("ij,ij->i", apart, apart))
    return distance


def _principal_axes(points: Array) -> Array:
    """Unit vectors of the principal axes of the points, as rows."""
    if len(points) < 3:
        return np.eye(3)
    axes: Array = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    return axes


def _size(fits: list[_Fit], power: int) -> float:
    """Sum of the volumes of capsules, with the radius to a `power` that is 2 for the volume itself."""
    return sum(float(np.pi * r**power * (np.linalg.norm(end - start) + 4 / 3 * r)) for start, end, r in fits)


def _rounded(point: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(one), 5) + 0.0 for one in point)
    return x, y, z


class Outline:
    """The capsules of an arm in many postures: which pairs can touch, and how near they are.

    Args:
        chain: The arm, with capsules.
        every: Keep also pairs on both sides of a wrist or an elbow that overlap nearly always.
    """

    def __init__(self, chain: SerialChain, *, every: bool = False) -> None:
        self.chain, capsules = chain, chain.capsules
        self.links = np.array([capsule.link for capsule in capsules], dtype=np.int64)
        self.radius = np.array([capsule.radius for capsule in capsules], dtype=np.float64)
        self._ends = np.array([(capsule.start, capsule.end) for capsule in capsules]).reshape(-1, 2, 3)
        self._mount = chain.mount
        self._slack = {(one, other): slack for one, other, slack in chain.slack}
        self.pairs = self._pairs(every)

    def segments(self, q: Array) -> Array:
        """Ends of the capsules' segments at the joints `q` (n, k) [rad]. Shape: (n, capsules, 2, 3)."""
        frames = self.chain.link_frames(q)
        base = np.broadcast_to(self._mount, (len(q), 1, 4, 4))
        poses = np.concatenate([base, frames], axis=1)[:, self.links]
        ends: Array = np.einsum("ncij,cej->ncei", poses[:, :, :3, :3], self._ends) + poses[:, :, None, :3, 3]
        return ends

    def lowest(self, q: Array) -> Array:
        """Height of the lowest point of the links from the third to the flange [m]. Shape: (n,).

        The first two stand where the arm is mounted; the far end of the second is where the third begins.
        """
        moving = (self.links > 2) & (self.links <= self.chain.num_joints)
        lows: Array = self.segments(q)[..., 2][:, moving].min(axis=2) - self.radius[moving]
        lowest: Array = lows.min(axis=1, initial=np.inf)
        return lowest

    def nearest(self, q: Array) -> Array:
        """Distance of the nearest pair of capsules that can touch [m]; negative if they overlap. Shape: (n,)."""
        if not len(self.pairs):
            return np.full(len(q), np.inf)
        nearest: Array = self.distances(q).min(axis=1)
        return nearest

    def distances(self, q: Array) -> Array:
        """Distance of each of `pairs` [m]. Shape: (n, pairs)."""
        ends, (one, other) = self.segments(q), self.pairs.T
        gap = segment_distances(ends[:, one, 0], ends[:, one, 1], ends[:, other, 0], ends[:, other, 1])
        distances: Array = gap - self.radius[one] - self.radius[other] + self.slack
        return distances

    @property
    def slack(self) -> Array:
        """How far the capsules of each of `pairs` may overlap [m]. Shape: (pairs,)."""
        return np.array([self._slack.get((int(self.links[i]), int(self.links[j])), 0.0) for i, j in self.pairs])

    def _pairs(self, every: bool) -> NDArray[np.int64]:
        """Pairs of capsules on links with a joint between them that are apart in some posture, and near in one."""
        links = self.links
        rows = [
            pair for pair in itertools.combinations(range(len(links)), 2) if abs(links[pair[0]] - links[pair[1]]) > 1
        ]
        # The gripper is fixed to the last link.
        last = self.chain.num_joints
        rows = [(i, j) for i, j in rows if not {int(links[i]), int(links[j])} <= {last - 1, last, last + 1}]
        self.pairs = np.array(rows, dtype=np.int64).reshape(-1, 2)
        if not rows:
            return self.pairs
        rng = np.random.default_rng(0)
        low, high = self.chain.low, self.chain.high
        gaps = self.distances(low + rng.random((2000, len(low))) * (high - low))
        # Capsules on both sides of a wrist or an elbow overlap nearly always: limits of joints keep their links apart,
        # unless a slack is known, with which they overlap where the links do.
        ends = [(int(links[i]), int(links[j])) for i, j in rows]
        known = np.array([pair in self._slack for pair in ends])
        near = (np.diff(np.minimum(links[self.pairs], last), axis=1)[:, 0] == 2) & ~known
        share = (gaps < 0.0).mean(axis=0)
        touching = np.where(near, (share > 0.0) & ((share <= _NEARLY_ALWAYS) | every), gaps.min(axis=0) < _NEAR)
        kept: NDArray[np.int64] = self.pairs[touching]
        return kept


def segment_distances(start: Array, end: Array, other_start: Array, other_end: Array) -> Array:
    """Distances of segments; Ericson, "Real-Time Collision Detection", 5.1.9. Shapes: (..., 3) -> (...)."""
    way, other_way, gap = end - start, other_end - other_start, start - other_start
    a, e = (np.maximum(np.einsum("...i,...i", one, one), 1e-12) for one in (way, other_way))
    b, c, f = (np.einsum("...i,...i", *two) for two in ((way, other_way), (way, gap), (other_way, gap)))
    slant = a * e - b * b
    share = np.where(slant > 1e-9 * a * e, np.clip((b * f - c * e) / np.where(slant == 0, 1, slant), 0, 1), 0.0)
    other = np.clip((b * share + f) / e, 0.0, 1.0)
    share = np.clip((b * other - c) / a, 0.0, 1.0)
    apart = gap + share[..., None] * way - other[..., None] * other_way
    distance: Array = np.sqrt(np.einsum("...i,...i", apart, apart))
    return distance
