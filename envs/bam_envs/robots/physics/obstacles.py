"""Where a moving obstacle is: still, up and down, or along a closed path; one in each environment.

An obstacle jumps from sample to sample 100 times a second, as robo-gym's does. Positions are in ``base_link`` [m].
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds
from bam_envs.core.splines import Splines, splines_through

Array = NDArray[np.float64]
UPDATE_RATE = 100.0
"""How often an obstacle moves on [Hz]."""
PATH_POINTS = 10
"""Points of a closed path, the last of which is the first."""
WAVE_X, WAVE_Y = 0.12, 0.34
"""Where the obstacle goes up and down [m]."""
WAVE_FREQUENCY = 0.125
"""How often it goes up and down [Hz]."""
WAVE_AMPLITUDE = (0.09, 0.35)
"""Least and most that it goes up and down from its middle [m]."""
WAVE_MIDDLE = (0.2, 0.6)
"""Lowest and highest middle [m]."""
RADIUS = 0.025
"""Of the obstacle, a sphere [m]."""


def wave_signals(draws: Array) -> dict[str, Array]:
    """Start signals of obstacles that go up and down; `draws` are numbers from 0 to 1. Shape: (k, 2)."""
    amplitude = WAVE_AMPLITUDE[0] + draws[:, 0] * (WAVE_AMPLITUDE[1] - WAVE_AMPLITUDE[0])
    middle = WAVE_MIDDLE[0] + draws[:, 1] * (WAVE_MIDDLE[1] - WAVE_MIDDLE[0])
    place = np.stack([np.full(len(draws), WAVE_X), np.full(len(draws), WAVE_Y), middle], axis=1)
    return {
        "obstacle_position": place,
        "obstacle_wave": np.stack([amplitude, np.full(len(draws), WAVE_FREQUENCY)], axis=1),
    }


class Obstacles:
    """One obstacle in each environment.

    The start signals of k environments say how theirs move:

    - ``obstacle_position`` (k, 3): where it stays, or the middle of its wave [m].
    - ``obstacle_wave`` (k, 2): how far up and down from there [m], and how often [Hz]; it starts at the bottom.
    - ``obstacle_path`` (k, 10, 3) and ``obstacle_samples`` (k,): a closed path along a cubic spline through these
      points [m], and how many hundredths of a second it takes once around.

    Without any of them the wave is drawn from the environment's seed.

    Args:
        num_envs: How many.
    """

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self._place = np.tile([0.0, 0.0, 1.9], (num_envs, 1))  # out of the way until an episode begins
        self._wave = np.zeros((num_envs, 2))
        self._points = np.zeros((num_envs, PATH_POINTS, 3))
        self._knots = np.tile(np.linspace(0.0, 1.0, PATH_POINTS), (num_envs, 1))
        self._coefficients = np.zeros((num_envs, PATH_POINTS - 1, 4, 3))
        self._samples = np.zeros(num_envs, dtype=np.int64)

    def begin(self, env_ids: EnvIds, signals: Mapping[str, Array], seeds: NDArray[np.int64]) -> None:
        """The obstacles of these environments start anew, as the ``obstacle_*`` of `signals` say.

        Raises:
            InvalidValue: A path without its number of samples, or of other than ten points.
        """
        given = {name: value for name, value in signals.items() if name.startswith("obstacle_")}
        if not given:
            given = wave_signals(np.stack([np.random.default_rng(seed).random(2) for seed in seeds]))
        self._samples[env_ids] = 0
        self._wave[env_ids] = given.get("obstacle_wave", np.zeros(2))
        if "obstacle_path" in given:
            self._follow(env_ids, given["obstacle_path"], given.get("obstacle_samples"))
        else:
            self._place[env_ids] = given["obstacle_position"]

    def _follow(self, env_ids: EnvIds, points: Array, samples: Array | None) -> None:
        """Put these environments on the paths through `points` (k, 10, 3)."""
        if samples is None or points.shape[1:] != (PATH_POINTS, 3):
            raise InvalidValue(
                f"A path has {PATH_POINTS} points of x, y, z and obstacle_samples; this has shape {points.shape[1:]}"
                f"{' and no samples' if samples is None else ''}."
            )
        path = splines_through(points)
        self._points[env_ids], self._samples[env_ids] = points, samples
        self._knots[env_ids], self._coefficients[env_ids] = path.knots, path.coefficients

    def position(self, time: Array) -> Array:
        """Where the obstacles are `time` seconds after their episode began. Shape: (n,) -> (n, 3)."""
        sample = np.floor(time * UPDATE_RATE + 1e-6)
        place: Array = self._place.copy()
        # A triangle from -1 to 1; both ends of its period are samples: it stays at the bottom for two of them.
        amplitude, frequency = self._wave.T
        still = frequency <= 0
        count = np.floor(UPDATE_RATE / np.where(still, UPDATE_RATE / 2, frequency))
        triangle = np.where(still, 0.0, 1.0 - np.abs(4 * (sample % count / (count - 1)) - 2))
        place[:, 2] += amplitude * triangle
        follows = self._samples > 0
        if follows.any():
            path = Splines(self._knots[follows], self._coefficients[follows])
            count = self._samples[follows]
            place[follows] = path.at((sample[follows] % count / (count - 1))[:, None])[:, 0]
        return place

    def state_dict(self) -> dict[str, Any]:
        """How each obstacle moves, as plain arrays."""
        return {
            "place": self._place.copy(),
            "wave": self._wave.copy(),
            "points": self._points.copy(),
            "samples": self._samples.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to what `state_dict` returned."""
        self._place, self._wave = np.array(state["place"]), np.array(state["wave"])
        self._points, self._samples = np.array(state["points"]), np.array(state["samples"])
        env_ids = np.flatnonzero(self._samples)
        if len(env_ids):
            self._follow(env_ids, self._points[env_ids], self._samples[env_ids].astype(np.float64))
