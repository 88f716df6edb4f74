"""The guards of a base that depend on its surroundings: laser zones, and a workspace rectangle."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import BaseBody, RobotSpec
from bam_envs.safety.guard import Guard, Limits, Numbers, Tick, columns_in, max_rate
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
    scanner, or at the edge of the base if the scanner stands inside it.
    """

    number, name, unit, setting = "G12", "laser zones", "m", "laser_stop"

    def __init__(self, spec: RobotSpec, limits: Limits, body: BaseBody) -> None:
        self.limit_value, self._slow, self._time = limits.laser_stop, limits.laser_slow, limits.collision_time
        self._body, self._sizes = body, {signal.name: len(signal.labels) for signal in spec.signals}
        self._drive, (self._turn,) = columns_in(spec.command, "m/s"), columns_in(spec.command, "rad/s")
        self._creep = SLOW * min(limits.base_speed, *(spec.command.high[at] for at in self._drive))
        self._scanners = []
        for scanner in body.scanners:
            if self._sizes.get(scanner.signal) == len(scanner.bearings):
                bearing = np.array(scanner.bearings) + scanner.pose[2]
                rays = np.stack([np.cos(bearing), np.sin(bearing)])
                least = np.array(scanner.least)
                self._scanners.append((scanner.signal, np.array(scanner.pose[:2])[:, None], rays, least))
        if not self._scanners:  # the task measures no scans
            self.limit_value = math.inf

    def limit(self, tick: Tick) -> bool:
        """Reduce the speeds."""
        velocity, turn = [tick.command[at] for at in self._drive], tick.command[self._turn]
        if not self._scanners or not (any(velocity) or turn):
            return False
        points = self.points(tick.signals)
        slowed = self._in_zones(velocity, points)
        share = self._share(slowed, turn, points)
        for at, speed in zip(self._drive, slowed, strict=True):
            tick.command[at] = speed * share
        tick.command[self._turn] = turn * share
        return slowed != velocity or share < 1.0

    def points(self, signals: Mapping[str, Array]) -> Array:
        """The points that the scanners see, in the base's frame [m]. Shape: (2, k)."""
        hits = [
            place + np.clip(np.nan_to_num(signals[name][0]), least, 1e6) * rays
            for name, place, rays, least in self._scanners
        ]
        return np.concatenate(hits, axis=1)

    def _in_zones(self, velocity: Numbers, points: Array) -> Numbers:
        """The allowed part of a velocity forwards, or forwards and to the left [m/s], by the nearest of `points` there.

        That is the nearest of those that the base would meet if it drove straight on.
        """
        speed = math.hypot(*velocity)
        if not speed:
            return velocity
        x, y = along(velocity)
        far, across = x * points[0] + y * points[1], x * points[1] - y * points[0]
        beside = (across <= self._body.reach(-y, x)) & (-across <= self._body.reach(y, -x))
        nearest = float((far[beside & (far > 0.0)] - self._body.reach(x, y)).min(initial=math.inf))
        most = 0.0 if nearest <= self.limit_value else self._creep if nearest <= self._slow else math.inf
        return velocity if speed <= most else [way * most for way in (x, y)[: len(velocity)]]

    def _share(self, velocity: Numbers, turn: float, points: Array) -> float:
        """The share of all speeds at which a collision is `collision_time` away, or 1."""
        forwards, aside = (*velocity, 0.0)[:2]
        far = self._body.size + math.hypot(*velocity) * self._time
        x, y = points[:, np.square(points).sum(axis=0) <= far**2]
        outside = ~self._body.holds(x, y)
        x, y = x[outside], y[outside]
        moments = self._time * np.arange(1, _SAMPLES + 1)[:, None] / _SAMPLES
        angle = turn * moments
        # Along the arc the base is at v t sinc(angle / 2), turned by angle / 2.
        shorter, cos, sin = np.sinc(angle / (2 * math.pi)), np.cos(angle / 2), np.sin(angle / 2)
        ahead, left = forwards * moments * shorter, aside * moments * shorter
        dx, dy = x - (ahead * cos - left * sin), y - (ahead * sin + left * cos)
        cos, sin = np.cos(angle), np.sin(angle)
        hits = self._body.holds(cos * dx + sin * dy, cos * dy - sin * dx).any(axis=1)
        return float(hits.argmax()) / _SAMPLES if hits.any() else 1.0


def along(velocity: Sequence[float]) -> tuple[float, float]:
    """The direction of a velocity forwards, or forwards and to the left, that is not 0: x, y of a unit vector."""
    x, y = (*velocity, 0.0)[:2]
    speed = math.hypot(x, y)
    return x / speed, y / speed


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
        self._drive = columns_in(spec.command, "m/s")
        self._brakes = min(limits.base_acceleration, *(max_rate(spec.command)[at] for at in self._drive))
        self._delay = spec.period + (spec.lag if limits.lag is None else limits.lag)

    def limit(self, tick: Tick) -> bool:
        """Limit the speed so that the base can brake before the edge."""
        if "base_pose" not in tick.signals:
            return False
        x, y, yaw = tick.signals["base_pose"][0].tolist()
        velocity = [tick.command[at] for at in self._drive]
        if not any(velocity):
            return False
        ahead, left = along(velocity)
        way = ahead * math.cos(yaw) - left * math.sin(yaw), ahead * math.sin(yaw) + left * math.cos(yaw)
        room = math.inf
        for place, to, least, most in zip((x, y), way, self._low, self._high, strict=True):
            if to:
                room = min(room, max(0.0, (most - place if to > 0.0 else place - least) / abs(to)))
        # v delay + v^2 / 2a = room
        delay = self._brakes * self._delay
        fastest = math.sqrt(delay * delay + 2.0 * self._brakes * room) - delay if room < math.inf else math.inf
        if not math.hypot(*velocity) > fastest:
            return False
        for at, share in zip(self._drive, (ahead, left), strict=False):
            tick.command[at] = share * fastest
        return True
