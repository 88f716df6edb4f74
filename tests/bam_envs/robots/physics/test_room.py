"""Contacts of the base's footprint with walls and boxes, by hand."""

import math

import numpy as np
import pytest

from bam_envs.robots.physics.room import LAB, NOWHERE, touches

NO_BOXES = np.zeros((1, 0, 3))


def touching(pose, room=None, boxes=()):
    return bool(touches(np.array([pose], dtype=float), room, np.array([boxes], dtype=float).reshape(1, -1, 3))[0])


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


def test_nothing_there():
    assert not touching((0, 0, 0), LAB)
    np.testing.assert_array_equal(touches(np.zeros((1, 3)), None, NO_BOXES), [False])
    assert not touching((500, 500, 0), None, [NOWHERE])
