"""What a base touches in a room, and what its lasers see."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bam_envs.robots.base_description import base_model
from bam_envs.robots.room import LAB, NOISE, NOWHERE, LaserScanner, Room, measured, mixed, noise, touches
from tests.bam_envs.making import CART

BODY = base_model("mir100").body
SCANNERS = BODY.scanners


def touching(pose, room=None, boxes=(), body=BODY):
    return bool(touches(body, np.array([pose], dtype=float), room, np.array([boxes], dtype=float).reshape(1, -1, 3))[0])


@pytest.mark.parametrize(
    ("pose", "free"),
    [
        ((2.823 - 0.45 - 0.0376, 0, 0), 1),  # its front is 0.4876 m ahead of its frame
        ((2.823 - 0.45 + 0.0376, 0, math.pi), 1),  # its back 0.4124 m behind
        ((2.823 - 0.29, 0, math.pi / 2), 1),
        ((-2.877 + 0.45 + 0.0376, 0, math.pi), -1),
        ((-2.877 + 0.29, 0, -math.pi / 2), -1),
    ],
)
def test_walls_along_x(pose, free):
    x, y, yaw = pose
    assert not touching((x - free * 1e-6, y, yaw), LAB)
    assert touching((x + free * 1e-6, y, yaw), LAB)


def test_walls_along_y():
    for y, way in ((3.864 - 0.4876, 1), (-3.836 + 0.4876, -1)):
        assert not touching((0, y - way * 1e-6, way * math.pi / 2), LAB)
        assert touching((0, y + way * 1e-6, way * math.pi / 2), LAB)


def test_a_box_ahead():
    for yaw, reach in ((0.0, 0.25), (math.pi / 4, 0.25 * math.sqrt(2))):
        edge = 0.4876 + reach
        assert touching((0, 0, 0), None, [(edge - 1e-6, 0, yaw)])
        assert not touching((0, 0, 0), None, [(edge + 1e-6, 0, yaw)])


def test_a_box_beside_and_behind_in_the_frame_of_a_turned_base():
    yaw = 0.7
    for ahead, left, edge in ((0, 1, 0.29 + 0.25), (-1, 0, 0.4124 + 0.25)):
        for gap in (-1e-6, 1e-6):
            far = edge + gap
            x, y = (
                1.0 + far * (ahead * math.cos(yaw) - left * math.sin(yaw)),
                far * (ahead * math.sin(yaw) + left * math.cos(yaw)),
            )
            assert touching((1.0, 0, yaw), None, [NOWHERE, (x, y, yaw)]) == (gap < 0)


def test_corner_to_corner_is_separated_by_an_axis_of_the_box():
    corner = np.array([0.4876, 0.29])
    for gap in (-1e-6, 1e-6):
        middle = corner + (0.25 + gap) * np.array([1, 1]) / math.sqrt(2)
        assert touching((0, 0, 0), None, [(*middle, math.pi / 4)]) == (gap < 0)


@pytest.mark.parametrize("model", ["turtlebot4", "husky", CART])
def test_what_touches_any_footprint_is_what_a_plain_search_finds(model):
    """Points on a grid inside the box, and inside the footprint; poses where the two nearly touch are left out."""
    body, rng = base_model(model).body, np.random.default_rng(1)
    grid = np.linspace(-0.25, 0.25, 60)
    own_x, own_y = (one.ravel() for one in np.meshgrid(grid, grid))
    far = rng.uniform(0.0, 1.3, 200)
    poses = np.stack([far, rng.uniform(-0.3, 0.3, 200), rng.uniform(-4, 4, 200)], axis=1)
    box = (0.1, -0.05, 0.4)
    found = touches(body, poses, None, np.tile(box, (200, 1, 1)))
    for (x, y, yaw), touching in zip(poses, found, strict=True):
        dx = box[0] + own_x * math.cos(box[2]) - own_y * math.sin(box[2]) - x
        dy = box[1] + own_x * math.sin(box[2]) + own_y * math.cos(box[2]) - y
        seen_x, seen_y = dx * math.cos(yaw) + dy * math.sin(yaw), dy * math.cos(yaw) - dx * math.sin(yaw)
        inside = body.holds(seen_x, seen_y).any()
        near = body.holds(seen_x * 0.97, seen_y * 0.97).any() | body.holds(seen_x * 1.03, seen_y * 1.03).any()
        assert touching == inside or (near and not inside), (x, y, yaw)
    assert 40 < found.sum() < 170


def test_a_round_base_beside_a_wall():
    body = base_model("turtlebot4").body
    for way in (0.0, 1.0, 2.5):
        assert not touching((2.823 - 0.171 - 1e-6, 0, way), LAB, body=body)
        assert touching((2.823 - 0.171 + 1e-6, 0, way), LAB, body=body)


FRONT, BACK = map(LaserScanner, SCANNERS)
FORWARDS = 150  # -135 + (30 + 150) / 2 = -45 degrees in a scanner that looks to +45
LEFTWARDS = 330  # +45 degrees there
BACKWARDS = 170  # -135 + (10 + 170) / 2 = -45 degrees in a scanner that looks to -135
RIGHTWARDS = 350  # +45 degrees there


def cast(scanner, pose, room=LAB, boxes=()):
    boxes = np.array([boxes], dtype=float).reshape(1, -1, 3)
    return scanner.cast(np.array([pose], dtype=float), room, boxes)[0]


def test_walls_from_both_corners():
    front, back = cast(FRONT, (0.5, 1.0, 0.0)), cast(BACK, (0.5, 1.0, 0.0))
    assert front[FORWARDS] == pytest.approx(2.823 - 0.5 - 0.4288, abs=1e-6)
    assert front[LEFTWARDS] == pytest.approx(3.864 - 1.0 - 0.2358, abs=1e-6)
    assert back[BACKWARDS] == pytest.approx(2.877 + 0.5 - 0.3548, abs=1e-6)
    assert back[RIGHTWARDS] == pytest.approx(3.836 + 1.0 - 0.2352, abs=1e-6)
    diagonal = 240  # along the scanner's own +45 degrees
    assert front[diagonal] == pytest.approx((2.823 - 0.5 - 0.4288) * math.sqrt(2), abs=1e-5)


def test_nothing_near_and_nothing_but_near():
    assert [len(scanner.bearings) for scanner in SCANNERS] == [501, 511]
    assert np.isinf(cast(FRONT, (1.0, 2.0, 0.3), None)).all()
    assert (cast(FRONT, (0, 0, 0), LAB, [(0.4288, 0.2358, 0.3)]) == 0).all()  # from inside a box
    assert not touching((0, 0, 0), LAB)
    assert not touching((500, 500, 0), None, [NOWHERE])


def test_the_nearer_of_two_boxes_hides_the_other():
    boxes = [(2.0, 0.2358, 0.0), (1.2, 0.2358, 0.0)]
    assert cast(FRONT, (0, 0, 0), LAB, boxes)[FORWARDS] == pytest.approx(1.2 - 0.25 - 0.4288, abs=1e-6)


def test_as_a_plain_search_finds_it():
    """Points along each ray, a millimetre apart, until one is outside the room or inside a box."""
    room, boxes = Room((-1.5, -1.2), (1.4, 1.6)), [(0.9, 1.0, 0.4), (-1.0, 0.4, 1.1), (0.3, -0.9, -0.2)]
    pose = (0.05, 0.1, 0.37)
    for scanner, seen in zip((FRONT, BACK), SCANNERS, strict=True):
        mount, masked = seen.pose, seen.hidden
        ranges = cast(scanner, pose, room, boxes)
        x = pose[0] + mount[0] * math.cos(pose[2]) - mount[1] * math.sin(pose[2])
        y = pose[1] + mount[0] * math.sin(pose[2]) + mount[1] * math.cos(pose[2])
        bearing = pose[2] + mount[2] + np.radians(np.linspace(-135, 135, 541)[masked[0] : 541 - masked[1]])
        far = np.arange(0.0, 4.0, 0.001)
        px, py = x + far * np.cos(bearing)[:, None], y + far * np.sin(bearing)[:, None]
        solid = (px < room.low[0]) | (px > room.high[0]) | (py < room.low[1]) | (py > room.high[1])
        for bx, by, yaw in boxes:
            u = (px - bx) * math.cos(yaw) + (py - by) * math.sin(yaw)
            v = (py - by) * math.cos(yaw) - (px - bx) * math.sin(yaw)
            solid |= (np.abs(u) < 0.25) & (np.abs(v) < 0.25)
        found = far[solid.argmax(axis=1)]
        grazing = np.abs(ranges - found) > 0.003  # a millimetre of a corner may be missed
        assert grazing.sum() <= 2


def test_a_row_of_many_is_the_row_alone():
    rng = np.random.default_rng(0)
    poses = np.stack([rng.uniform(-2, 2, 150), rng.uniform(-3, 3, 150), rng.uniform(-4, 4, 150)], axis=1)
    boxes = rng.uniform(-2, 2, (150, 3, 3))
    many = FRONT.cast(poses, LAB, boxes)
    for row in (0, 1, 63, 64, 149):
        np.testing.assert_array_equal(FRONT.cast(poses[[row]], LAB, boxes[[row]])[0], many[row])


def test_measured_ranges_are_inside_what_a_scanner_says():
    true = np.array([[0.01, 1.0, 28.995, np.inf, np.nan]], np.float32)
    said = measured(true, np.full((1, 5), 0.01, np.float32), [replace(SCANNERS[0], bearings=(0.0,) * 5)])
    assert said.dtype == np.float64
    np.testing.assert_allclose(said, [[0.05, 1.01, 29.0, 29.0, 0.05]], atol=1e-6)


def test_noise_is_normal_and_follows_seed_and_count():
    seeds, counts = np.arange(400, dtype=np.uint64), np.zeros(400, np.uint64)
    deviates = noise(seeds, counts, 1012)
    assert deviates.shape == (400, 1012)
    assert deviates.mean() == pytest.approx(0.0, abs=2e-4)
    assert deviates.std() == pytest.approx(NOISE, rel=0.01)
    np.testing.assert_array_equal(noise(seeds, counts, 1012), deviates)
    for other in (noise(seeds + np.uint64(1000), counts, 1012), noise(seeds, counts + np.uint64(1), 1012)):
        assert abs(np.corrcoef(deviates.ravel(), other.ravel())[0, 1]) < 0.01


def test_mixed_numbers():
    """The first of splitmix64 seeded with 0, as published."""
    assert int(mixed(np.zeros(1, np.uint64))[0]) == 0xE220A8397B1DCDAF
