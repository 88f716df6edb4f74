"""The detector of unusual observations: how far what a policy sees and does is from its training. Needs NumPy only.

Five charts, each divided by its bound; the largest is the level of a tick, and above 1 it is an alarm:

- ``state``: how unusual observation and action are together, x = (o, a): the leverage h = φᵀ (ΦᵀΦ/n + r I)⁻¹ φ of the
  features φ = (tanh(Wᵀ(x, 1)), x, 1), standardised, with random W; its exponentially weighted mean,
- ``answer``: how unusual the next observation is after them and the command c' that was sent, which guards may have
  changed: e = (o' - Bᵀφ) / exp(Vᵀφ), whitened, where φ is of x = (o, a, c, c' - c), c is the command before, B is ridge
  regression, and V that of the logarithm of the error's size; the squared length of the mean of e (MEWMA: Lowry et al.
  1992),
- two CUSUM charts (Page 1954) of l = log(1 + h), and the same of e's squared length, for what lasts:
  S = max(0, S + p (min(l, cut) - drift)),
- ``duration``: ticks since the episode began, times p; those in which a guard held the robot do not count.

p, the pace, is the share of its speed at which the robot is allowed to move. The bounds are conformal: quantiles of the
largest value in each of the episodes that were kept apart, continued beyond the largest of them by the exponential tail
of such maxima, for at most one false alarm in `TICKS` ticks. Fewer than `FEW` ticks lack episodes of a rare kind, which
may be unusual until they end: a CUSUM chart is then an alarm only after three quarters of the time limit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bam_train.checkpoint import safetensors_file
from bam_train.errors import CheckpointError, SettingsError

if TYPE_CHECKING:
    from bam_train.checkpoint import Checkpoint

Floats = NDArray[np.float32]
Array = NDArray[Any]
DETECTOR = "bam/detector.safetensors"
"""Member of a checkpoint with the arrays of a `Model`."""
TICKS = 720_000
"""Ticks with at most one false alarm: ten hours at 20 Hz."""
MOST_NUMBERS = 64
"""Maximum numbers of an observation, of an action, and of a command; a tick takes about 15 µs."""
LEAST_TICKS, LEAST_EPISODES = 1_000, 20
FEW = TICKS // 10
"""With fewer ticks that determine the bounds, usual episodes of a rare kind are missing among them."""
LEAST_MARGIN = 0.02
"""Least distance from the range of a number at which it is unusual [rad, m]; some never move in the data."""
TIMELY = 0.35
"""Greatest deviation of the time between two observations from the period [periods] at which an answer is judged."""
_HIDDEN = 96
_MEMORY = 0.2  # weight of the newest tick in a mean
_RIDGE = 1e-3
_RATES = np.array([0.05, 0.05, 0.05, 0.05, 0.4])  # false alarms of each chart in `TICKS` ticks
_TAILS = 0.1, 0.05, 0.02, 0.01  # shares of the episodes' maxima that tails are fitted to; the highest bound counts
_LASTING = 0.75  # share of the time limit for which a rare usual episode may be unusual
_NEAR = 0.75  # share of the time limit above which the bound of the duration is in the last tick
_NOT_FINITE = 1e6  # level of an observation with NaN
_LONGEST = 10.0  # of a whitened error, per square root of a number
_LOG_SIZE = 0.635  # a normal distribution's deviation over the geometric mean of its size, as a logarithm
_USUAL = (0.95, 0.999), (0.95, 0.99)  # quantiles of the charts for what lasts: drift and cut, of state and answer
REASONS = (
    "the policy sees and does what it did not in training",
    "the robot answers its commands otherwise than in training",
    "for some time the policy has seen and done what it did not in training",
    "for some time the robot has answered its commands otherwise than in training",
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
    commands: Array | None = None
    """The command that was sent before each observation, NaN if it is unknown. Shape: (T, m); None without a robot."""
    periods: Array | None = None
    """Time from the observation before to each observation [periods], shape (T,); None if they are on time."""
    pace: float = 1.0
    """Share of its speed at which the robot was allowed to move."""


@dataclass(frozen=True)
class Model:
    """What a detector has learnt, of d numbers an observation, k with the action, m a command.

    x = (o, a, 1, c, c' - c) has n = k + 1 + 2 m numbers.
    """

    lever_hidden: Floats
    """W of the leverage. Shape: (k + 1, h)."""
    lever: Floats
    """The inverse Cholesky factor of the leverage. Shape: (h + k + 1, h + k + 1)."""
    whiten: Floats
    """Shape: (d, d)."""
    drift: Floats
    """Of the logarithms of leverage and squared error. Shape: (2,)."""
    cut: Floats
    """Shape: (2,)."""
    bounds: Floats
    """Of the charts. Shape: (5,)."""
    answer_hidden: Any = None
    """W of the answer. Shape: (n, g). None, as the next two, if answers are not judged."""
    answer: Any = None
    """B, and V, side by side. Shape: (n + g, 2 d)."""
    sizes: Any = None
    """Logarithms of the smallest and the largest size of an error. Shape: (2, d)."""

    @classmethod
    def of(cls, arrays: Mapping[str, Array]) -> Model:
        """The model of a member `DETECTOR`.

        One of the first format knows no commands: what it has learnt of the answer to an action is not true where
        guards change what is sent. Only its first and its last chart are used.
        """
        if "matrix" not in arrays:
            return cls(**arrays)
        hidden, matrix = arrays["hidden"], arrays["matrix"]
        lever = np.roll(matrix[:, : len(matrix)], hidden.shape[1], axis=0)
        none = np.zeros(2, np.float32)
        return cls(hidden, lever, arrays["whiten"], none, none, arrays["bounds"])

    def require_shapes(self) -> None:
        """Raise ValueError unless the arrays fit each other, are finite and not too large."""
        (rows, h), d = self.lever_hidden.shape, len(self.whiten)
        shapes: list[tuple[int, ...]] = [(rows, h), (rows + h, rows + h), (d, d), (2,), (2,), (5,)]
        if self.answer_hidden is not None:
            n, g = self.answer_hidden.shape
            shapes += [(n, g), (n + g, 2 * d), (2, d)]
        for one, shape in zip(fields(self), shapes, strict=False):
            array = getattr(self, one.name)
            if array is None or array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
                found = None if array is None else array.shape
                raise ValueError(f"{one.name}: expected finite float32 numbers of shape {shape}, found {found}")
        commands = 0 if self.answer_hidden is None else len(self.answer_hidden) - rows
        if not 0 < d <= rows - 1 <= 2 * MOST_NUMBERS or not 0 <= commands <= 2 * MOST_NUMBERS or commands % 2:
            raise ValueError(f"{d} numbers of {rows - 1}, and {commands} of commands")
        if h > 4 * _HIDDEN or (self.answer_hidden is not None and g > 4 * _HIDDEN) or not (self.bounds > 0).all():
            raise ValueError(f"{h} features, bounds {self.bounds.tolist()}")

    @property
    def numbers(self) -> tuple[int, int]:
        """Numbers of an observation, and of an action."""
        return len(self.whiten), len(self.lever_hidden) - 1 - len(self.whiten)

    @property
    def commands(self) -> int | None:
        """Numbers of a command: 0 for an environment without a robot, None if answers are not judged."""
        return None if self.answer_hidden is None else (len(self.answer_hidden) - len(self.lever_hidden)) // 2


class Detector:
    """Follows one episode after the other: `begin`, then `step` at every tick."""

    def __init__(self, model: Model) -> None:
        self.model = model
        (k1, h), self._d = model.lever_hidden.shape, len(model.whiten)
        d, m, g = self._d, model.commands or 0, 0 if model.answer_hidden is None else model.answer_hidden.shape[1]
        features = np.ones(h + k1 + 2 * m + g, np.float32)
        self._lever_features, self._answer_features = features[: h + k1], features[h:]
        self._x, self._sent = features[h : h + k1 + 2 * m], features[h + k1 : h + k1 + m]
        self._known, self._seen, self._acted = self._x[:k1], self._x[:d], self._x[d : k1 - 1]
        self._change = self._x[k1 + m :]
        self._lever_h, self._answer_h = features[:h], features[h + k1 + 2 * m :]
        self._lever, self._answer = np.zeros(h + k1, np.float32), np.zeros(2 * d, np.float32)
        self._next, self._size = self._answer[:d], self._answer[d:]
        self._error, self._white, self._mean = (np.zeros(d, np.float32) for _ in range(3))
        self._m, self._command = model.commands, np.zeros(m)
        least_and_most: Any = np.zeros((2, d), np.float32) if model.sizes is None else model.sizes
        self._least, self._most = least_and_most
        self._share, self._longest = 1.0 / (h + k1), _LONGEST**2 * d
        self._drift, self._cut, self._bounds = model.drift.tolist(), model.cut.tolist(), model.bounds.tolist()
        self.begin()

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> Detector | None:
        """The detector of a checkpoint; None if it has none. Raises CheckpointError if it is not one."""
        if not checkpoint.has(DETECTOR):
            return None
        arrays = checkpoint.arrays(DETECTOR)
        try:
            model = Model.of(arrays)
            model.require_shapes()
            spaces = checkpoint.manifest.observation_space, checkpoint.manifest.action_space
            numbers, expected = model.numbers, tuple(map(_size, spaces))
            if numbers != expected:
                raise ValueError(f"expected {expected} numbers in observation and action, found {numbers}")
        except (TypeError, ValueError, KeyError) as error:
            raise CheckpointError(checkpoint.path, f"{DETECTOR}: {error}. Make it again", member=DETECTOR) from error
        return cls(model)

    def to_bytes(self) -> bytes:
        """The member `DETECTOR` of a checkpoint."""
        return safetensors_file.dump({name: value for name, value in vars(self.model).items() if value is not None})

    def begin(self, pace: float = 1.0) -> None:
        """Forget the last episode; `pace` is the share of its speed at which the robot is allowed to move."""
        self.level = 0.0
        """The newest level; above 1 it is an alarm."""
        self.charts = [0.0] * 5
        """The newest value of each chart, before it is divided by its bound."""
        self._ticks, self._usual, self._pace = 0, 0.0, pace  # ticks without those that were held
        self._mean.fill(0.0)
        self._is_sent = False  # whether the command before the last observation is known

    @property
    def reason(self) -> str:
        """What the highest chart means."""
        levels = [value / bound for value, bound in zip(self.charts, self._bounds, strict=True)]
        return REASONS[levels.index(max(levels))]

    def step(
        self,
        observation: Array,
        action: Array,
        command: Array | None = None,
        periods: float = 1.0,
        *,
        held: bool = False,
    ) -> float:
        """The level of a tick, after the policy has chosen `action` for `observation`.

        The answer to a command is judged if the detector knows commands, and the observation came on time; without a
        robot, the answer to an action.

        Args:
            observation: d numbers.
            action: a numbers.
            command: The command that was sent before the observation, m numbers [SI]; None without a robot.
            periods: Time since the observation before [periods].
            held: Whether a guard held the robot meanwhile.
        """
        model, white, seen = self.model, None, observation.reshape(-1)
        is_sent = (0 if command is None else command.size) == self._m
        if is_sent and self._is_sent and abs(periods - 1.0) <= TIMELY:
            if command is not None:
                np.subtract(command, self._command, out=self._change)
            np.tanh(np.dot(self._x, model.answer_hidden, out=self._answer_h), out=self._answer_h)
            np.dot(self._answer_features, model.answer, out=self._answer)
            size = np.maximum(np.minimum(self._size, self._most, out=self._size), self._least, out=self._size)
            np.exp(size, out=size)
            error = np.subtract(seen, self._next, out=self._error)
            white = np.dot(np.divide(error, size, out=error), model.whiten, out=self._white)
        self._seen[:], self._acted[:], self._is_sent = seen, action.reshape(-1), is_sent
        if is_sent and command is not None:
            self._sent[:] = self._command[:] = command
        np.tanh(np.dot(self._known, model.lever_hidden, out=self._lever_h), out=self._lever_h)
        np.dot(self._lever_features, model.lever, out=self._lever)
        return self._advance(float(np.dot(self._lever, self._lever)) * self._share, white, held=held)

    def levels(self, rollout: Rollout) -> Array:
        """The level of each tick of an episode; `step` in one call. Shape: (T,) float64."""
        levels: Array = (self.values(rollout) / self.model.bounds).max(axis=1)
        return levels

    def values(self, rollout: Rollout) -> Array:
        """The charts at each tick of an episode. Shape: (T, 5) float64."""
        return self._charted(surprises(self.model, rollout), rollout.pace)

    def _charted(self, found_at: tuple[Array, Array, Array], pace: float) -> Array:
        """`values`, of the surprises of an episode."""
        leverage, white, judged = found_at
        self.begin(pace)
        found = []
        for t, one in enumerate(leverage.tolist()):
            self._advance(one, white[t - 1] if t and judged[t - 1] else None)
            found.append(self.charts)
        return np.array(found)

    def _advance(self, leverage: float, white: Array | None, *, held: bool = False) -> float:
        """Add a tick to the charts; returns the level."""
        self._ticks += not held
        self._usual += _MEMORY * (leverage - self._usual)
        (drift, drift_of_error), (cut, cut_of_error), before, pace = self._drift, self._cut, self.charts, self._pace
        lasting = max(0.0, before[2] + pace * (min(math.log1p(leverage), cut) - drift))
        answer, wrong = before[1], before[3]
        if white is not None:
            square, mean = float(np.dot(white, white)), self._mean
            white *= _MEMORY * min(1.0, math.sqrt(self._longest / max(square, 1e-9)))
            mean *= 1.0 - _MEMORY
            mean += white
            answer = math.log1p(float(np.dot(mean, mean)) / self._d)
            wrong = max(0.0, wrong + pace * (min(math.log1p(square / self._d), cut_of_error) - drift_of_error))
            leverage += square
        self.charts = values = [math.log1p(self._usual), answer, lasting, wrong, pace * self._ticks]
        self.level = max([value / bound for value, bound in zip(values, self._bounds, strict=True)])
        if not math.isfinite(leverage):  # NaN in an observation
            self.level = _NOT_FINITE
        return self.level


def detector_of_ranges(low: Array, high: Array, d: int) -> Detector:
    """A detector for which each number of observation and action should be in its range, or near it.

    It has two features for each number, which rise from 0 to 1 where it leaves its range by a tenth of that. Answers
    and durations are not judged.

    Args:
        low: Lowest value of each number of an observation and then of an action, -inf where it is unknown. Shape: (n,).
        high: Highest value, inf where it is unknown. Shape: (n,).
        d: Numbers of an observation.
    """
    n, known = len(low), np.isfinite(low) & np.isfinite(high)
    low, high = np.where(known, low, 0.0), np.where(known, high, 0.0)
    margin = np.maximum(0.1 * (high - low), LEAST_MARGIN)
    slope = 2.0 / margin
    hidden, lever = np.zeros((n + 1, 2 * n)), np.zeros((3 * n + 1, 3 * n + 1))
    hidden[:n] = np.concatenate([np.diag(slope), -np.diag(slope)], axis=1)
    hidden[n] = np.concatenate([-slope * (high + margin), slope * (low - margin)])
    lever[range(2 * n), range(2 * n)] = lever[3 * n, : 2 * n] = 0.5 * np.tile(known, 2)
    bounds = [math.log1p(0.25 / len(lever)), *[1e30] * 4]
    return Detector(Model(*(np.asarray(one, np.float32) for one in (hidden, lever, np.eye(d), [0, 0], [0, 0], bounds))))


def vectors(observation: Any) -> Array:
    """The numbers of observations (T, ...) that a detector compares: of a mapping, its vectors by their names.

    Shape: (T, d), or that of the only array.
    """
    parts = [observation[key] for key in sorted(observation)] if isinstance(observation, Mapping) else [observation]
    flat = [one for one in parts if np.ndim(one) == 2] if len(parts) > 1 else parts
    return flat[0] if len(flat) == 1 else np.concatenate(flat, axis=1)


def _size(space: Mapping[str, Any]) -> int:
    """Numbers of a space, in JSON form, that a detector compares; see `vectors`."""
    parts = list(space["spaces"].values()) if space.get("type") == "Dict" else [space]
    return sum(math.prod(one.get("shape", ())) for one in parts if len(parts) == 1 or len(one.get("shape", ())) == 1)


def surprises(model: Model, rollout: Rollout) -> tuple[Array, Array, Array]:
    """Leverage of each tick (T,), the whitened error of each next observation (T - 1, d), and whether it is judged."""
    known, d = _known(rollout), len(model.whiten)
    leverage = np.square(_features(known, model.lever_hidden, hidden_first=True) @ model.lever).mean(axis=1)
    answers, judged = _answers(rollout)
    hidden = model.answer_hidden
    if hidden is None or answers.shape[1] != len(hidden):
        return leverage, np.zeros((len(answers), d)), np.zeros(len(answers), bool)
    out = _features(answers, hidden) @ model.answer
    error: Array = (known[1:, :d] - out[:, :d]) / np.exp(np.clip(out[:, d:], *model.sizes))
    return leverage, error @ model.whiten, judged


def _known(rollout: Rollout) -> Array:
    """Observation and action of each tick, and 1. Shape: (T, k + 1) float64."""
    steps = len(rollout.actions)
    parts = [
        np.asarray(part, np.float64).reshape(steps, -1) for part in (rollout.observations[:steps], rollout.actions)
    ]
    return np.concatenate([*parts, np.ones((steps, 1))], axis=1)


def _answers(rollout: Rollout) -> tuple[Array, Array]:
    """The rows x of each tick but the last, shape (T - 1, n) float64, and whether that answer is judged, (T - 1,)."""
    known, steps = _known(rollout)[:-1], len(rollout.actions)
    sent = np.zeros((steps, 0)) if rollout.commands is None else np.asarray(rollout.commands, np.float64)
    rows = np.concatenate([known, sent[:-1], np.diff(sent, axis=0)], axis=1)
    judged: Array = np.isfinite(rows[:, known.shape[1] :]).all(axis=1)
    if rollout.periods is not None:
        judged &= np.abs(np.asarray(rollout.periods)[1:] - 1.0) <= TIMELY
    return np.where(judged[:, None], rows, 0.0), judged


def _features(rows: Array, hidden: Array, *, hidden_first: bool = False) -> Array:
    """φ of x. Shapes: (n, k), (k, h) -> (n, k + h)."""
    h = np.tanh(rows @ hidden)
    return np.concatenate([h, rows] if hidden_first else [rows, h], axis=1)


def make_detector(*kinds: Iterable[Rollout], limit: float | None = None, seed: int = 0) -> Detector:
    """Make a detector of episodes of one policy, or of a data set.

    Two of five episodes are learnt from, and the others determine the bounds. If some succeeded, only these count.

    Args:
        kinds: The episodes of each kind of usual run, such as behind guards, in random order. A bound is the largest of
            the kinds'; a further kind with too few successful episodes is left out.
        limit: Time limit of an episode [ticks at a pace of 1]; None: that of the episodes that failed, if any did.
        seed: Of the random features.

    Raises:
        SettingsError: The observations are not up to 64 numbers, or there are too few episodes of the first kind.
    """
    every = [[one for one in kind if len(one.actions)] for kind in kinds]
    used = [[one for one in kind if one.success] or kind for kind in every]
    ticks = sum(len(one.actions) for one in used[0])
    if ticks < LEAST_TICKS or len(used[0]) < LEAST_EPISODES:
        expected = f"at least {LEAST_EPISODES} successful episodes of {LEAST_TICKS} steps in all"
        raise SettingsError(f"a detector needs {expected}, found {len(used[0])} of {ticks}")
    if max(len(one.actions) for one in used[0]) < 2:
        raise SettingsError("a detector compares a step with the next one, and these episodes have one step")
    sizes = [max(1, math.prod(part.shape[1:])) for part in used[0][0][:2]]
    if max(sizes) > MOST_NUMBERS:
        raise SettingsError(f"a detector takes at most {MOST_NUMBERS} numbers, found {sizes[0]} in an observation")
    used = [kind for kind in used if len(kind) >= LEAST_EPISODES]
    kept = [kind[2::5] + kind[3::5] + kind[4::5] for kind in used]
    model = _learnt([one for kind in used for one in kind[0::5] + kind[1::5]], sizes[0], np.random.default_rng(seed))
    found = [[(surprises(model, one), one.pace) for one in kind] for kind in kept]
    every_one = [one for kind in found for one, _ in kind]
    leverage = np.concatenate([one for one, _, _ in every_one])
    square = np.concatenate([np.square(white[judged]).mean(axis=1) for _, white, judged in every_one])
    parts = zip((leverage, square), _USUAL, strict=True)
    usual = [np.quantile(np.log1p(one), shares) if len(one) else np.zeros(2) for one, shares in parts]
    drift, cut = np.array(usual, np.float32).T
    detector = Detector(replace(model, drift=drift, cut=cut))
    failed = [one.pace * len(one.actions) for kind in every for one in kind if one.success is False]
    longest = max(failed, default=math.inf) if limit is None else limit
    bounds = []
    for kind in found:
        maxima = np.array([detector._charted(*one).max(axis=0) for one in kind])
        episodes = len(kind) * TICKS / sum(len(one[0]) for one, _ in kind)
        bounds.append(_bounds(maxima, episodes, longest))
    bound = np.max(bounds, axis=0)
    if len(leverage) < FEW and math.isfinite(longest):
        bound[2:4] = np.maximum(bound[2:4], _LASTING * longest * (cut - drift))
    if longest - 0.5 < max(failed, default=0.0) or _NEAR * longest < bound[4] < longest:
        bound[4] = longest - 0.5  # others, as slow, may succeed in their last tick
    return Detector(replace(detector.model, bounds=bound.astype(np.float32)))


def _learnt(rollouts: Sequence[Rollout], d: int, rng: np.random.Generator) -> Model:
    """The model of all but drift, cut and bounds, which are 0, infinite and 1."""
    known = np.concatenate([_known(one) for one in rollouts])
    hidden, to_z, deviation = _standardised(known, known.shape[1] - 1, rng)
    to_z = np.roll(to_z, (_HIDDEN, _HIDDEN), axis=(0, 1))  # the hidden features are first
    phi = _features(known, hidden, hidden_first=True) @ to_z
    gram = phi.T @ phi / len(phi) + _RIDGE * np.eye(len(to_z))
    lever = to_z @ np.linalg.inv(np.linalg.cholesky(gram)).T
    two: Any = np.zeros(2)
    answers = _learnt_answers(rollouts, d, deviation[:d], known.shape[1] - 1, rng)
    arrays = {"lever_hidden": hidden, "lever": lever, **answers, "drift": two, "cut": two + 1e30, "bounds": np.ones(5)}
    return Model(**{name: np.asarray(value, np.float32) for name, value in arrays.items()})


def _learnt_answers(
    rollouts: Sequence[Rollout], d: int, deviation: Array, constant: int, rng: np.random.Generator
) -> dict[str, Array]:
    """The arrays of the answer; `deviation` (d,) is the observations', `constant` the column of ones."""
    pieces = [(*_answers(one), np.diff(_known(one)[:, :d], axis=0)) for one in rollouts]
    rows = np.concatenate([x[judged] for x, judged, _ in pieces])
    change = np.concatenate([step[judged] for _, judged, step in pieces])
    if not len(rows):
        return {"whiten": np.eye(d)}
    hidden, to_z, _ = _standardised(rows, constant, rng)
    phi = _features(rows, hidden) @ to_z
    gram = phi.T @ phi / len(phi) + 0.1 * _RIDGE * np.eye(len(to_z))

    def regression(target: Array) -> Array:
        return np.linalg.solve(gram, phi.T @ target / len(phi))

    fit = regression(change)
    left = change - phi @ fit
    spread = left.std(axis=0)
    log_size = regression(np.log(np.abs(left) + 0.03 * spread + 1e-9))
    log_size[constant] += _LOG_SIZE
    sizes, least = phi @ log_size, np.log(np.maximum(0.3 * spread, 1e-3 * deviation))
    span = np.stack([least, np.maximum(sizes.max(axis=0), least)])
    error = np.clip(left / np.exp(np.clip(sizes, *span)), -10, 10)
    whiten = np.linalg.inv(np.linalg.cholesky(np.atleast_2d(np.cov(error.T)) + 1e-2 * np.eye(d))).T
    answer = to_z @ np.concatenate([fit, log_size], axis=1)
    answer[:d, :d] += np.eye(d)  # the change is added to the observation
    return {"whiten": whiten, "answer_hidden": hidden, "answer": answer, "sizes": span}


def _standardised(rows: Array, constant: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Random weights of `rows` (n, k), whose column `constant` is 1, as if these were standardised.

    Returns the weights (k, h), the matrix (k + h, k + h) that standardises the features, and the deviations (k,).
    """
    mean, k = rows.mean(axis=0), rows.shape[1]
    deviation = np.maximum(rows.std(axis=0), 1e-3 * np.abs(rows).max(axis=0) + 1e-6)
    deviation[constant], mean[constant] = 1.0, 0.0
    scaled = np.diag(1 / deviation)
    scaled[constant] -= mean / deviation
    weights = rng.standard_normal((k, _HIDDEN)) / math.sqrt(k - 1)
    weights[constant] = rng.uniform(-1, 1, _HIDDEN)
    to_z = np.eye(k + _HIDDEN)
    to_z[:k, :k] = scaled
    return scaled @ weights, to_z, deviation


def _bounds(maxima: Array, episodes: float, limit: float) -> Array:
    """The bound of each chart, of its maxima in n episodes (n, 5), if `TICKS` ticks are so many episodes.

    Exceedances of the upper tenth are exponential with their mean (1.5 standard errors more, as it is estimated). Where
    a few episodes in a hundred are of a rare kind, those of the upper twentieth, fiftieth or hundredth have a larger
    mean, and the highest bound counts. No duration is above `limit`.
    """
    top, limits = np.sort(maxima, axis=0)[::-1], np.array([math.inf] * 4 + [limit])
    bounds: Array = np.maximum(top[0], 1e-6)
    for tail in _TAILS:
        k = max(5, int(tail * len(maxima)))
        beyond = (top[:k] - top[k]).mean(axis=0) * (1 + (1.5 / math.sqrt(k) if tail == _TAILS[0] else 0.0))
        share = _RATES * len(maxima) / (k * episodes)  # of the exceedances that may be above the bound
        with np.errstate(divide="ignore", invalid="ignore"):
            share = share + np.where(beyond > 0, np.exp(-(limits - top[k]) / beyond), 0.0)
        bounds = np.maximum(bounds, top[k] - beyond * np.log(np.minimum(share, 1.0)))
    return bounds
