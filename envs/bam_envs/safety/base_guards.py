"""The guards of a base that depend on its surroundings: laser zones, and a workspace rectangle."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import BaseBody, RobotSpec
from bam_envs.safety.guard import Guard, Limits, Tick, columns_in, max_rate
from bam_envs.safety.region_guards import require_room

Array = NDArray[np.float64]
SLOW = 0.3
"""Share of the speed limit between the slow zone and the stop zone."""
_SAMPLES = 20
"""Number of moments within `collision_time` at which the path ahead is checked."""


class LaserZones(Guard):
    """A base slows down and stops before obstacles that its lasers see in its direction of travel.

    It may always turn where it hits nothing, and drive away. It also slows down in proportion if it would hit an
    obstacle sooner than `collision_time` along the commanded arc. A NaN in a scan counts as an obstacle at the
    scanner.
    """

    number, name, unit, setting = "G12", "laser zones", "m", "laser_stop"

    def __init__(self, spec: RobotSpec, limits: Limits, body: BaseBody) -> None:
        self.limit_value, self._slow, self._time = limits.laser_stop, limits.laser_slow, limits.collision_time
        self._body, self._sizes = body, {signal.name: len(signal.labels) for signal in spec.signals}
        (self._drive,), (self._turn,) = columns_in(spec.command, "m/s"), columns_in(spec.command, "rad/s")
        self._creep = SLOW * min(limits.base_speed, spec.command.high[self._drive])
        self._scanners = []
        for scanner in body.scanners:
            if self._sizes.get(scanner.signal) == len(scanner.bearings):
                bearing = np.array(scanner.bearings) + scanner.pose[2]
                rays = np.stack([np.cos(bearing), np.sin(bearing)])
                self._scanners.append((scanner.signal, np.array(scanner.pose[:2])[:, None], rays))
        if not self._scanners:  # the task measures no scans
            self.limit_value = math.inf

    def limit(self, tick: Tick) -> bool:
        """Reduce the speeds."""
        speed, turn = tick.command[self._drive], tick.command[self._turn]
        if not self._scanners or not (speed or turn):
            return False
        points = self.points(tick.signals)
        slowed = self._in_zones(speed, points)
        share = self._share(slowed, turn, points)
        tick.command[self._drive], tick.command[self._turn] = slowed * share, turn * share
        return slowed != speed or share < 1.0

    def points(self, signals: Mapping[str, Array]) -> Array:
        """The points that the scanners see, in the base's frame [m]. Shape: (2, k)."""
        hits = [
            place + np.clip(np.nan_to_num(signals[name][0]), 0.0, 1e6) * rays for name, place, rays in self._scanners
        ]
        return np.concatenate(hits, axis=1)

    def _in_zones(self, speed: float, points: Array) -> float:
        """The allowed part of `speed` [m/s], by the nearest of `points` in the direction of travel."""
        if not speed:
            return speed
        way, end = (1.0, self._body.front) if speed > 0.0 else (-1.0, self._body.back)
        ahead = way * points[0][(np.abs(points[1]) <= self._body.side) & (way * points[0] > 0.0)] - end
        nearest = float(ahead.min(initial=math.inf))
        if nearest <= self.limit_value:
            return 0.0
        return way * min(abs(speed), self._creep) if nearest <= self._slow else speed

    def _share(self, speed: float, turn: float, points: Array) -> float:
        """The share of both speeds at which a collision is `collision_time` away, or 1."""
        body = self._body
        radius = math.hypot(max(body.front, body.back), body.side)
        x, y = points[:, np.square(points).sum(axis=0) <= (radius + abs(speed) * self._time) ** 2]
        outside = ~self._touches(x, y)
        x, y = x[outside], y[outside]
        moments = self._time * np.arange(1, _SAMPLES + 1)[:, None] / _SAMPLES
        angle = turn * moments
        # Along the arc the base is at v t sinc(angle / 2) in the direction angle / 2.
        way = speed * moments * np.sinc(angle / (2 * math.pi))
        dx, dy = x - way * np.cos(angle / 2), y - way * np.sin(angle / 2)
        cos, sin = np.cos(angle), np.sin(angle)
        hits = self._touches(cos * dx + sin * dy, cos * dy - sin * dx).any(axis=1)
        return float(hits.argmax()) / _SAMPLES if hits.any() else 1.0

    def _touches(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Whether points in the base's frame are inside its body."""
        inside: NDArray[np.bool_] = (x <= self._body.front) & (x >= -self._body.back) & (np.abs(y) <= self._body.side)
        return inside


class BaseBox(Guard):
    """A base stays in a rectangle of its map: it brakes before the edge, and may turn there and drive back.

    Args:
        spec: The base, whose ``base_pose`` is measured.
        limits: Its limits; `base_acceleration` and `lag` are used.
        low: Lowest x and y of its frame [m].
        high: Highest x and y [m].

    Raises:
        InvalidValue: `low` is not below `high`.
    """

    number, name, unit, keeps_out = "G10", "workspace box", "m", True

    def __init__(self, spec: RobotSpec, limits: Limits, low: Sequence[float], high: Sequence[float]) -> None:
        self._low, self._high = (*map(float, low),), (*map(float, high),)
        require_room(self._low, self._high)
        self.limit_value = max(most - least for least, most in zip(self._low, self._high, strict=True))
        (self._drive,) = columns_in(spec.command, "m/s")
        self._brakes = min(limits.base_acceleration, max_rate(spec.command)[self._drive])
        self._delay = spec.period + (spec.lag if limits.lag is None else limits.lag)

    def limit(self, tick: Tick) -> bool:
        """Limit the speed so that the base can brake before the edge."""
        if "base_pose" not in tick.signals:
            return False
        x, y, yaw = tick.signals["base_pose"][0].tolist()
        speed = tick.command[self._drive]
        way = math.copysign(1.0, speed) * math.cos(yaw), math.copysign(1.0, speed) * math.sin(yaw)
        room = math.inf
        for place, along, least, most in zip((x, y), way, self._low, self._high, strict=True):
            if along:
                room = min(room, max(0.0, (most - place if along > 0.0 else place - least) / abs(along)))
        # v delay + v^2 / 2a = room
        delay = self._brakes * self._delay
        fastest = math.sqrt(delay * delay + 2.0 * self._brakes * room) - delay if room < math.inf else math.inf
        if not abs(speed) > fastest:
            return False
        tick.command[self._drive] = math.copysign(fastest, speed)
        return True
