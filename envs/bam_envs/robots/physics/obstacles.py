"""The motion of obstacles, one in each environment: at rest, up and down, or along a closed path.

An obstacle jumps from sample to sample 100 times a second, as robo-gym's does. Positions are in ``base_link`` [m].
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import EnvIds
from bam_envs.core.task import Memory
from bam_envs.robots.splines import Splines, splines_through

Array = NDArray[np.float64]
UPDATE_RATE = 100.0  # of an obstacle's position [Hz]
PATH_POINTS = 10
"""Points of a closed path; the last equals the first."""
RADIUS = 0.025
"""Radius of the obstacle, a sphere [m]."""


def wave_signals(draws: Array) -> dict[str, Array]:
    """Start signals of obstacles that go 0.09 to 0.35 m up and down at 0.125 Hz, by `draws` (k, 2) from [0, 1).

    Their middle is at (0.12, 0.34, 0.2 to 0.6) m.
    """
    least, most, fixed = np.array([0.09, 0.2]), np.array([0.35, 0.6]), np.ones(len(draws))
    amplitude, middle = (least + draws * (most - least)).T
    return {
        "obstacle_position": np.stack([0.12 * fixed, 0.34 * fixed, middle], axis=1),
        "obstacle_wave": np.stack([amplitude, 0.125 * fixed], axis=1),
    }


class Obstacles(Memory):
    """One obstacle in each environment.

    The start signals of k environments define the motion:

    - ``obstacle_position`` (k, 3): a fixed position, or the middle of the wave [m].
    - ``obstacle_wave`` (k, 2): amplitude up and down [m], and frequency [Hz]; the wave starts at the bottom.
    - ``obstacle_path`` (k, 10, 3) and ``obstacle_samples`` (k,): a closed path along a cubic spline through these
      points [m], and its duration [1/100 s].

    Without any of them the wave is drawn from the environment's seed.
    """

    memory: Mapping[str, str] = {name: f"_{name}" for name in ("place", "wave", "points", "samples")}

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self._place = np.tile([0.0, 0.0, 1.9], (num_envs, 1))  # out of the way until an episode begins
        self._wave = np.zeros((num_envs, 2))
        self._points = np.zeros((num_envs, PATH_POINTS, 3))
        self._knots = np.tile(np.linspace(0.0, 1.0, PATH_POINTS), (num_envs, 1))
        self._coefficients = np.zeros((num_envs, PATH_POINTS - 1, 4, 3))
        self._samples = np.zeros(num_envs, dtype=np.int64)

    def begin(self, env_ids: EnvIds, signals: Mapping[str, Array], seeds: NDArray[np.int64]) -> None:
        """Restart the obstacles of these environments, with the motions in the ``obstacle_*`` of `signals`."""
        motion = {name: value for name, value in signals.items() if name.startswith("obstacle_")}
        if not motion:
            motion = wave_signals(np.stack([np.random.default_rng(seed).random(2) for seed in seeds]))
        self._samples[env_ids] = 0
        self._wave[env_ids] = motion.get("obstacle_wave", np.zeros(2))
        if "obstacle_path" in motion:
            self._points[env_ids], self._samples[env_ids] = motion["obstacle_path"], motion["obstacle_samples"]
            self._follow(env_ids)
        else:
            self._place[env_ids] = motion["obstacle_position"]

    def _follow(self, env_ids: EnvIds) -> None:
        """Compute the paths through the points of these environments."""
        path = splines_through(self._points[env_ids])
        self._knots[env_ids], self._coefficients[env_ids] = path.knots, path.coefficients

    def position(self, time: Array) -> Array:
        """Positions of the obstacles [m] at a `time` [s] after the start of their episodes. Shape: (n,) -> (n, 3)."""
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

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        super().load_state_dict(state)
        env_ids = np.flatnonzero(self._samples)
        if len(env_ids):
            self._follow(env_ids)
