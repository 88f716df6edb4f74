"""The guards of a base that look at where it is: laser zones, and the edge of a rectangle."""

import math

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.robots.base_description import base_model
from bam_envs.safety.base_guards import BaseBox, LaserZones
from bam_envs.safety.guard import Limits, Tick
from bam_envs.safety.guards import default_guards
from tests.bam_envs.making import CART

BASE, BODY = base_model("mir100").spec(), base_model("mir100").body
FREE = {name: np.full((1, len(scanner.bearings)), 29.0) for scanner in BODY.scanners for name in [scanner.signal]}


def scans(*points):
    """What the scanners see of points x, y [m] in the base's frame."""
    signals = {name: ranges.copy() for name, ranges in FREE.items()}
    for x, y in points:
        for scanner in BODY.scanners:
            dx, dy = x - scanner.pose[0], y - scanner.pose[1]
            bearing = math.remainder(math.atan2(dy, dx) - scanner.pose[2], 2 * math.pi)
            ray = int(np.argmin(np.abs(np.array(scanner.bearings) - bearing)))
            if abs(scanner.bearings[ray] - bearing) < 0.005:
                signals[scanner.signal][0, ray] = math.hypot(dx, dy)
    return signals


def drive(command, signals, guard=None, **limits):
    still = [[0.0] * len(command) for _ in range(5)]
    tick = Tick([*command], [*command], *still, 0.0, 0.1, signals=signals)
    altered = (guard or LaserZones(BASE, Limits(**limits), BODY)).limit(tick)
    assert altered == (tick.command != [*command])
    return tick.command


FRONT, BACK = BODY.front, -BODY.back


@pytest.mark.parametrize(
    ("point", "command", "sent"),
    [
        ((FRONT + 0.29, 0.0), (0.5, 0.3), (0.0, 0.3)),  # in the stop zone: it may turn
        ((FRONT + 0.29, 0.0), (-0.5, 0.0), (-0.5, 0.0)),  # and drive away
        ((FRONT + 0.39, 0.1), (0.5, 0.0), (0.15, 0.0)),  # in the slow zone
        ((FRONT + 0.39, 0.1), (0.1, 0.0), (0.1, 0.0)),
        ((BACK - 0.29, -0.1), (-0.3, 0.0), (0.0, 0.0)),  # backwards too
        ((FRONT + 0.29, 0.6), (0.5, 0.0), (0.5, 0.0)),  # beside its way
        ((FRONT + 0.51, 0.0), (0.5, 0.0), (0.25, 0.0)),  # a collision in between 1.0 and 1.1 s: half as fast
        ((FRONT + 1.2, 0.0), (0.5, 0.0), (0.5, 0.0)),
        ((0.35, 0.42), (0.0, 0.7), (0.0, 0.14)),  # a corner would sweep it after 0.49 s
        ((0.35, 0.42), (0.0, 0.0), (0.0, 0.0)),
    ],
)
def test_a_base_slows_down_and_stops_for_what_its_lasers_see_on_its_way(point, command, sent):
    np.testing.assert_allclose(drive(command, scans(point)), sent, atol=0.036)


def seen_by(model, *points):
    """A base of that description, and what its laser, which stands in its middle, sees of points in its frame."""
    base = base_model({**CART, **model})
    (scanner,) = base.body.scanners
    ranges = np.full((1, len(scanner.bearings)), scanner.range[1])
    for x, y in points:
        ranges[0, np.argmin(np.abs(np.array(scanner.bearings) - math.atan2(y, x)))] = math.hypot(x, y)
    return base, {"scan": ranges}


@pytest.mark.parametrize(
    ("point", "command", "sent"),
    [
        ((0.0, 0.55), (0.0, 0.3, 0.0), (0.0, 0.0, 0.0)),  # its corner is 0.3 m to its left
        ((0.0, 0.55), (0.3, 0.0, 0.0), (0.3, 0.0, 0.0)),
        ((0.0, 0.55), (0.0, -0.3, 0.2), (0.0, -0.3, 0.2)),
        ((0.0, 0.68), (0.0, 0.3, 0.0), (0.0, 0.09, 0.0)),  # in the slow zone
        ((0.5, 0.5), (0.3, 0.3, 0.0), (0.0636, 0.0636, 0.0)),
        ((0.9, 0.0), (0.4, 0.0, 0.0), (0.3, 0.0, 0.0)),  # a collision after 1.5 s
    ],
)
def test_a_base_that_drives_sideways_stops_for_what_is_there(point, command, sent):
    base, signals = seen_by({}, point)
    found = drive(command, signals, LaserZones(base.spec(), Limits(), base.body))
    np.testing.assert_allclose(found, sent, atol=0.05)


def test_a_round_base_turns_close_to_a_wall_and_a_blind_laser_stops_it():
    base, signals = seen_by({"footprint": {"radius": 0.2}}, (0.0, 0.21), (0.22, 0.0))
    guard = LaserZones(base.spec(), Limits(), base.body)
    assert drive((0.0, 0.0, 0.7), signals, guard) == [0.0, 0.0, 0.7]
    assert drive((0.2, 0.0, 0.0), signals, guard) == [0.0, 0.0, 0.0]
    blind = {"scan": np.full_like(signals["scan"], np.nan)}
    for way in ((0.2, 0.0, 0.0), (-0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, -0.2, 0.0)):
        assert drive(way, blind, guard) == [0.0, 0.0, 0.0], "the laser stands in the middle: no way is free"


def test_the_speed_of_a_base_is_that_of_its_direction():
    guards = {one.name: one for one in default_guards(base_model(CART).spec(), Limits(base_speed=0.2))}
    assert drive((0.2, 0.2, 0.1), {}, guards["base speed"]) == pytest.approx([0.1414, 0.1414, 0.1], abs=1e-4)
    assert drive((0.1, -0.1, 0.1), {}, guards["base speed"]) == [0.1, -0.1, 0.1]
    command = drive(
        (0.3, 0.3, 0.0), pose(0.99, 0.0, 0.0), BaseBox(base_model(CART).spec(), Limits(lag=0.3), (-1, -1), (1, 1))
    )
    assert command == pytest.approx([0.0235, 0.0235, 0.0], abs=2e-3)


def test_distances_are_limits():
    near = scans((FRONT + 0.29, 0.0))
    assert drive((0.1, 0.0), near) == [0.0, 0.0]
    assert drive((0.1, 0.0), near, laser_stop=0.2) == [0.1, 0.0]
    assert drive((0.5, 0.0), scans((FRONT + 1.2, 0.0)), collision_time=4.0)[0] < 0.5


@pytest.mark.parametrize("ray", [math.nan, -math.inf, -1.0])
def test_a_ray_without_a_distance_is_an_obstacle(ray):
    """Minus infinity is too near to be measured."""
    blind = {**FREE, "f_scan": np.full((1, FREE["f_scan"].shape[1]), ray)}
    assert drive((0.5, 0.0), blind) == [0.0, 0.0]
    assert drive((-0.5, 0.0), blind) == [-0.5, 0.0]


def test_a_base_whose_lasers_are_not_measured_is_not_limited_by_them():
    guard = next(one for one in default_guards(base_model("mir100").spec(with_scans=False)) if one.number == "G12")
    assert drive((0.5, 0.0), {}, guard) == [0.5, 0.0]


def test_the_lasers_are_where_the_simulated_room_has_them():
    robot = ENVIRONMENTS["bam/avoidance-v0"].make_robot(1, False, {})
    guard = LaserZones(robot.spec, Limits(), robot.spec.body)
    robot.connect()
    task = ENVIRONMENTS["bam/avoidance-v0"].make_task(1, {})
    state = robot.reset(np.arange(1), task.sample_initial(np.arange(1), [np.random.default_rng(0)]))
    points = guard.points(state.signals)
    x, y, yaw = state.signals["base_pose"][0]
    cos, sin = math.cos(yaw), math.sin(yaw)
    world = np.array([x + cos * points[0] - sin * points[1], y + sin * points[0] + cos * points[1]])
    both = np.histogram2d(*world[:, np.hypot(*points) < 20.0], bins=40)[0]
    assert (both > 0).mean() < 0.2, "walls and boxes are lines"


def pose(x, y, yaw):
    return {"base_pose": np.array([[x, y, yaw]])}


@pytest.mark.parametrize(
    ("at", "speed", "sent"),
    [
        ((0.0, 0.0, 0.0), 0.5, 0.5),
        ((0.99, 0.0, 0.0), 0.5, 0.0245),  # v 0.4 + v^2 / 4 = 0.01
        ((0.99, 0.0, math.pi), 0.5, 0.5),
        ((0.99, 0.0, math.pi), -0.5, -0.0245),
        ((1.2, 0.0, 0.0), 0.5, 0.0),  # it stands outside: back only
        ((1.2, 0.0, 0.0), -0.5, -0.5),
        ((0.0, 0.99, math.pi / 2), 0.5, 0.0245),
    ],
)
def test_a_base_brakes_before_the_edge(at, speed, sent):
    guard = BaseBox(BASE, Limits(lag=0.3), (-1, -1), (1, 1))
    command = drive((speed, 0.3), pose(*at), guard)
    assert command == pytest.approx([sent, 0.3], abs=2e-3)
    assert drive((speed, 0.3), {}, guard) == [speed, 0.3]


def test_a_rectangle_needs_room():
    with pytest.raises(InvalidValue, match=r"^A workspace box needs room: low \(0.0, 0.0\) must be below high"):
        BaseBox(BASE, Limits(), (0, 0), (0, 1))
