"""Quaternions."""

import numpy as np
import pytest

from bam_envs.core.rotations import angle_between, from_angles

H = np.sqrt(0.5)


@pytest.mark.parametrize(
    ("angles", "quaternion"),
    [
        ((0, 0, 0), (0, 0, 0, 1)),
        ((np.pi / 2, 0, 0), (H, 0, 0, H)),
        ((0, np.pi / 2, 0), (0, H, 0, H)),
        ((0, 0, np.pi / 2), (0, 0, H, H)),
        ((0, np.pi / 2, np.pi / 2), (-0.5, 0.5, 0.5, 0.5)),  # x points down, then all turned to the left
        ((np.pi / 2, np.pi / 2, 0), (0.5, 0.5, -0.5, 0.5)),
    ],
)
def test_angles_about_fixed_axes(angles, quaternion):
    np.testing.assert_allclose(from_angles(np.array([angles], float)), [quaternion], atol=1e-15)


def test_the_angle_between_two():
    one = from_angles(np.array([[0.0, 0.0, 0.3], [0.0, 1.2, 0.0], [0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]))
    other = from_angles(np.array([[0.0, 0.0, -0.1], [0.0, 1.2, 0.0], [0.1, 0.2, 0.3], [np.pi, 0.0, 0.0]]))
    np.testing.assert_allclose(angle_between(one, other), [0.4, 0.0, 0.0, np.pi], atol=1e-15)
    np.testing.assert_allclose(angle_between(one, -other), [0.4, 0.0, 0.0, np.pi], atol=1e-15)


def test_small_angles_are_exact():
    turned = from_angles(np.array([[0.0, 0.0, 1e-9]]))
    np.testing.assert_allclose(angle_between(turned, np.array([[0.0, 0.0, 0.0, 1.0]])), [1e-9], rtol=1e-9)
