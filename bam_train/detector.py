"""The detector of unusual observations: how far what a policy sees and does is from its training. Needs NumPy only.

Five charts, each divided by its bound; the largest is the level of a tick, and above 1 it is an alarm:

- ``state``: how unusual observation and action are together, x = (o, a): the leverage h = φᵀ (ΦᵀΦ/n + r I)⁻¹ φ of the
  features φ = (x, 1, tanh(Wᵀ(x, 1))), standardised, with random W; its exponentially weighted mean,
- ``answer``: how unusual the next observation is after them: e = (o' - Bᵀφ) / max(Vᵀφ, floor), whitened, where B is
  ridge regression and V that of the error's size; the squared length of the mean of e (MEWMA: Lowry et al. 1992),
- two CUSUM charts (Page 1954) of h and of e's squared length, S = max(0, S + min(h, cut) - drift), for what lasts,
- ``duration``: ticks since the episode began.

The bounds are conformal: quantiles of the largest value in each of the episodes that were kept apart, continued beyond
the largest of them by the exponential tail of such maxima, for at most one false alarm in `TICKS` ticks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bam_train.checkpoint import safetensors_file
from bam_train.errors import AlteredCheckpoint, NoDetector

if TYPE_CHECKING:
    from bam_train.checkpoint import Checkpoint

Floats = NDArray[np.float32]
Array = NDArray[Any]
DETECTOR = "bam/detector.safetensors"
"""Member of a checkpoint with the arrays of a `Model`."""
TICKS = 72_000
"""Ticks with at most one false alarm: an hour at 20 Hz."""
MOST_NUMBERS = 64
"""Maximum numbers of an observation, and of an action; a tick takes about 15 µs."""
LEAST_TICKS, LEAST_EPISODES = 1_000, 20
_HIDDEN = 96
_MEMORY = 0.2  # weight of the newest tick in a mean
_RIDGE = 1e-3
_RATES = np.array([0.05, 0.05, 0.05, 0.05, 0.2])  # false alarms of each chart in `TICKS` ticks
_TAIL = 0.1  # share of the episodes' maxima that the tail is fitted to
_NOT_FINITE = 1e6  # level of an observation with NaN
_LONGEST = 30.0  # of a whitened error, per square root of a number
REASONS = (
    "the policy sees and does what it did not in training",
    "the robot answers its actions otherwise than in training",
    "for some time the policy has seen and done what it did not in training",
    "for some time the robot has answered its actions otherwise than in training",
    "the episode takes longer than successful ones in training",
)
"""What an alarm of each chart means."""


class Rollout(NamedTuple):
    """One episode of T steps, from which a detector is made."""

    observations: Array
    """Shape: (T + 1, ...), or (T, ...) without the final one."""
    actions: Array
    """Shape: (T, ...)."""
    success: bool | None = None
    """None if it is unknown."""


@dataclass(frozen=True)
class Model:
    """What a detector has learnt, of d numbers an observation and k = d + a with the action; f = k + 1 + hidden."""

    hidden: Floats
    """W. Shape: (k + 1, hidden)."""
    matrix: Floats
    """The inverse Cholesky factor of the leverage, B, and V, side by side. Shape: (f, f + 2 d)."""
    floor: Floats
    """Smallest size of an error. Shape: (d,)."""
    whiten: Floats
    """Shape: (d, d)."""
    drift: Floats
    """Of leverage and squared error. Shape: (2,)."""
    cut: Floats
    """Shape: (2,)."""
    bounds: Floats
    """Of the charts. Shape: (5,)."""

    def require_shapes(self) -> None:
        """Raise ValueError unless the arrays fit each other, are finite and not too large."""
        (rows, hidden), d = self.hidden.shape, len(self.floor)
        k, f = rows - 1, rows + hidden
        shapes = [(rows, hidden), (f, f + 2 * d), (d,), (d, d), (2,), (2,), (5,)]
        for one, shape in zip(fields(self), shapes, strict=True):
            array = getattr(self, one.name)
            if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
                raise ValueError(f"{one.name}: expected finite float32 numbers of shape {shape}, found {array.shape}")
        if not 0 < d <= k <= 2 * MOST_NUMBERS or hidden > 4 * _HIDDEN or not (self.bounds > 0).all():
            raise ValueError(f"{d} numbers of {k}, {hidden} features, bounds {self.bounds.tolist()}")

    @property
    def numbers(self) -> tuple[int, int]:
        """Numbers of an observation, and of an action."""
        return len(self.floor), len(self.hidden) - 1 - len(self.floor)

    def features(self, rows: Array) -> Array:
        """φ. Shapes: (n, k) -> (n, f)."""
        x = np.concatenate([rows, np.ones((len(rows), 1))], axis=1)
        return np.concatenate([x, np.tanh(x @ self.hidden)], axis=1)


class Detector:
    """Follows one episode after the other: `begin`, then `step` at every tick."""

    def __init__(self, model: Model) -> None:
        self.model = model
        (k, _), self._d = model.hidden.shape, len(model.floor)
        f, d = len(model.matrix), self._d
        self._features, self._out = np.ones(f, np.float32), np.zeros(f + 2 * d, np.float32)
        self._x, self._seen, self._acted = self._features[:k], self._features[:d], self._features[d : k - 1]
        self._h = self._features[k:]
        self._lever, self._next, self._size = self._out[:f], self._out[f : f + d], self._out[f + d :]
        self._error, self._white, self._mean = (np.zeros(d, np.float32) for _ in range(3))
        self._share, self._longest = 1.0 / f, _LONGEST**2 * d
        self._drift, self._cut, self._bounds = model.drift.tolist(), model.cut.tolist(), model.bounds.tolist()
        self.begin()

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> Detector | None:
        """The detector of a checkpoint; None if it has none. Raises AlteredCheckpoint if it is not one."""
        if not checkpoint.has(DETECTOR):
            return None
        arrays = checkpoint.arrays(DETECTOR)
        try:
            model = Model(**arrays)
            model.require_shapes()
            spaces = checkpoint.manifest.observation_space, checkpoint.manifest.action_space
            numbers, expected = model.numbers, tuple(math.prod(space.get("shape", ())) for space in spaces)
            if numbers != expected:
                raise ValueError(f"expected {expected} numbers in observation and action, found {numbers}")
        except (TypeError, ValueError) as error:
            raise AlteredCheckpoint(checkpoint.path, DETECTOR, f"{DETECTOR}: {error}. Make it again") from error
        return cls(model)

    def to_bytes(self) -> bytes:
        """The member `DETECTOR` of a checkpoint."""
        return safetensors_file.dump(vars(self.model))

    def begin(self) -> None:
        """Forget the last episode."""
        self.level = 0.0
        """The newest level; above 1 it is an alarm."""
        self.charts = [0.0] * 5
        """The newest value of each chart, before it is divided by its bound."""
        self._ticks, self._usual = 0, 0.0
        self._mean.fill(0.0)

    @property
    def reason(self) -> str:
        """What the highest chart means."""
        levels = [value / bound for value, bound in zip(self.charts, self._bounds, strict=True)]
        return REASONS[levels.index(max(levels))]

    def step(self, observation: Array, action: Array) -> float:
        """The level of a tick, after the policy has chosen `action` for `observation`: arrays of d and of a numbers."""
        model, white, seen = self.model, None, observation.reshape(-1)
        if self._ticks:
            error = np.subtract(seen, self._next, out=self._error)
            np.divide(error, np.maximum(self._size, model.floor, out=self._size), out=error)
            white = np.dot(error, model.whiten, out=self._white)
        self._seen[:], self._acted[:] = seen, action.reshape(-1)
        np.tanh(np.dot(self._x, model.hidden, out=self._h), out=self._h)
        np.dot(self._features, model.matrix, out=self._out)
        return self._advance(float(np.dot(self._lever, self._lever)) * self._share, white)

    def levels(self, rollout: Rollout) -> Array:
        """The level of each tick of an episode; `step` in one call. Shape: (T,) float64."""
        levels: Array = (self.values(rollout) / self.model.bounds).max(axis=1)
        return levels

    def values(self, rollout: Rollout) -> Array:
        """The charts at each tick of an episode. Shape: (T, 5) float64."""
        leverage, white = surprises(self.model, rollout)
        self.begin()
        found = []
        for t, one in enumerate(leverage.tolist()):
            self._advance(one, white[t - 1] if t else None)
            found.append(self.charts)
        return np.array(found)

    def _advance(self, leverage: float, white: Array | None) -> float:
        """Add a tick to the charts; returns the level."""
        self._ticks += 1
        self._usual += _MEMORY * (leverage - self._usual)
        (drift, drift_of_error), (cut, cut_of_error), before = self._drift, self._cut, self.charts
        lasting = max(0.0, before[2] + min(leverage, cut) - drift)
        answer, wrong = before[1], before[3]
        if white is not None:
            square, mean = float(np.dot(white, white)), self._mean
            white *= _MEMORY * min(1.0, math.sqrt(self._longest / max(square, 1e-9)))
            mean *= 1.0 - _MEMORY
            mean += white
            answer = math.log1p(float(np.dot(mean, mean)) / self._d)
            wrong = max(0.0, wrong + min(square / self._d, cut_of_error) - drift_of_error)
            leverage += square
        self.charts = values = [math.log1p(self._usual), answer, lasting, wrong, float(self._ticks)]
        self.level = max([value / bound for value, bound in zip(values, self._bounds, strict=True)])
        if not math.isfinite(leverage):  # NaN in an observation
            self.level = _NOT_FINITE
        return self.level


def surprises(model: Model, rollout: Rollout) -> tuple[Array, Array]:
    """Leverage of each tick (T,), and the whitened error of each step to the next tick (T - 1, d)."""
    rows, d = _rows(rollout), len(model.floor)
    f = len(model.matrix)
    out = model.features(rows) @ model.matrix
    error: Array = (rows[1:, :d] - out[:-1, f : f + d]) / np.maximum(out[:-1, f + d :], model.floor)
    return np.square(out[:, :f]).mean(axis=1), error @ model.whiten


def _rows(rollout: Rollout) -> Array:
    """Observation and action of each tick. Shape: (T, k) float64."""
    steps = len(rollout.actions)
    parts = rollout.observations[:steps], rollout.actions
    return np.concatenate([np.asarray(part, np.float64).reshape(steps, -1) for part in parts], axis=1)


def make_detector(rollouts: Iterable[Rollout], *, seed: int = 0) -> Detector:
    """Make a detector of episodes of one policy, or of a data set.

    Two of five episodes are learnt from, and the others determine the bounds. If some succeeded, only these count.

    Args:
        rollouts: The episodes, in random order.
        seed: Of the random features.

    Raises:
        NoDetector: The observations are not up to 64 numbers, or there are too few episodes.
    """
    every = [one for one in rollouts if len(one.actions)]
    used = [one for one in every if one.success] or every
    ticks = sum(len(one.actions) for one in used)
    if ticks < LEAST_TICKS or len(used) < LEAST_EPISODES:
        expected = f"at least {LEAST_EPISODES} successful episodes of {LEAST_TICKS} steps in all"
        raise NoDetector(f"a detector needs {expected}, found {len(used)} of {ticks}")
    if max(len(one.actions) for one in used) < 2:
        raise NoDetector("a detector compares a step with the next one, and these episodes have one step")
    sizes = [max(1, math.prod(part.shape[1:])) for part in used[0][:2]]
    if max(sizes) > MOST_NUMBERS:
        raise NoDetector(f"a detector takes at most {MOST_NUMBERS} numbers, found {sizes[0]} in an observation")
    learnt, kept = used[0::5] + used[1::5], used[2::5] + used[3::5] + used[4::5]
    model = _learnt(learnt, sizes[0], np.random.default_rng(seed))
    found = [surprises(model, one) for one in kept]
    leverage = np.concatenate([one for one, _ in found])
    square = np.concatenate([np.square(white).mean(axis=1) for _, white in found])
    usual = np.array([np.quantile(one, [0.9, 0.98]) for one in (leverage, square)], np.float32)
    model = replace(model, drift=usual[:, 0], cut=usual[:, 1])
    detector = Detector(model)
    maxima = np.array([detector.values(one).max(axis=0) for one in kept])
    bounds = _bounds(maxima, len(kept) * TICKS / sum(len(one.actions) for one in kept))
    return Detector(replace(model, bounds=bounds.astype(np.float32)))


def _learnt(rollouts: Sequence[Rollout], d: int, rng: np.random.Generator) -> Model:
    """The model of all but drift, cut and bounds, which are 0, infinite and 1."""
    pieces = [_rows(one) for one in rollouts]
    rows = np.concatenate(pieces)
    deviation = np.maximum(rows.std(axis=0), 1e-3 * np.abs(rows).max(axis=0) + 1e-6)
    k = rows.shape[1]
    scaled = np.diag([*(1 / deviation), 1.0])  # (x, 1) to (z, 1): the features are standardised
    scaled[-1, :-1] = -rows.mean(axis=0) / deviation
    weights = np.concatenate([rng.standard_normal((k, _HIDDEN)) / math.sqrt(k), rng.uniform(-1, 1, (1, _HIDDEN))])
    none: Any = np.zeros((1, 1))
    two: Any = np.zeros(2)
    model = Model(scaled @ weights, none, two, none, two, two + 1e30, np.ones(5, np.float32))
    to_z = np.eye(k + 1 + _HIDDEN)
    to_z[: k + 1, : k + 1] = scaled
    phi = np.concatenate([model.features(piece[:-1]) for piece in pieces]) @ to_z
    gram, ridge = phi.T @ phi / len(phi), _RIDGE * np.eye(len(to_z))
    change = np.concatenate([np.diff(piece[:, :d], axis=0) for piece in pieces])

    def regression(target: Array) -> Array:
        return np.linalg.solve(gram + 0.1 * ridge, phi.T @ target / len(phi))

    fit = regression(change)
    left = change - phi @ fit
    size = 1.25 * regression(np.abs(left))  # a normal distribution's deviation is 1.25 of its mean size
    floor = np.maximum(0.1 * left.std(axis=0), 1e-3 * deviation[:d])
    error = np.clip(left / np.maximum(phi @ size, floor), -10, 10)
    spread = np.atleast_2d(np.cov(error.T)) + 1e-2 * np.eye(d)
    matrix = to_z @ np.concatenate([np.linalg.inv(np.linalg.cholesky(gram + ridge)).T, fit, size], axis=1)
    matrix[:d, len(to_z) : len(to_z) + d] += np.eye(d)  # the change is added to the observation
    model = replace(model, matrix=matrix, floor=floor, whiten=np.linalg.inv(np.linalg.cholesky(spread)).T)
    return Model(**{name: np.asarray(value, np.float32) for name, value in vars(model).items()})


def _bounds(maxima: Array, episodes: float) -> Array:
    """The bound of each chart, of its maxima in n episodes (n, 5), if `TICKS` ticks are so many episodes.

    Exceedances of the upper tenth are exponential with their mean (1.5 standard errors more, as it is estimated).
    """
    k = max(5, int(_TAIL * len(maxima)))
    top = np.sort(maxima, axis=0)[::-1]
    beyond = (top[:k] - top[k]).mean(axis=0) * (1 + 1.5 / math.sqrt(k))
    bounds: Array = np.maximum(top[k] + beyond * np.log(np.maximum(1.0, k / len(maxima) * episodes / _RATES)), top[0])
    return np.maximum(bounds, 1e-6)
