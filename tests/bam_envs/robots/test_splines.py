"""Cubic splines through points."""

import numpy as np
import pytest

from bam_envs.robots.splines import splines_through

POINTS = np.random.default_rng(0).uniform(-1, 1, (4, 10, 3))
ALONG = np.linspace(0, 1, 301)


def test_it_goes_through_its_points_in_order():
    path = splines_through(POINTS)
    np.testing.assert_allclose(path.at(path.knots), POINTS, atol=1e-12)
    assert (path.knots[:, 0] == 0).all()
    assert (path.knots[:, -1] == 1).all()
    assert (np.diff(path.knots, axis=1) > 0).all()


def test_knots_are_as_far_apart_as_the_points():
    path = splines_through(np.array([[[0.0], [1.0], [4.0], [5.0], [10.0]]]))
    np.testing.assert_allclose(path.knots, [[0.0, 0.1, 0.4, 0.5, 1.0]])


def test_points_of_a_line_give_the_line():
    path = splines_through(np.array([[[0.0, 0.0], [3.0, 4.0], [4.5, 6.0], [6.0, 8.0]]]))
    np.testing.assert_allclose(path.at(ALONG[None]), [ALONG[:, None] * [6.0, 8.0]], atol=1e-12)


def test_it_is_smooth_and_its_ends_are_not_a_knot():
    path = splines_through(POINTS)
    width = np.diff(path.knots, axis=1)[:, :, None]
    a, b, c, d = np.moveaxis(path.coefficients, 2, 0)
    for left, right in (
        (a + width * (b + width * (c + width * d)), a),
        (b + width * (2 * c + 3 * width * d), b),
        (2 * c + 6 * width * d, 2 * c),
    ):
        np.testing.assert_allclose(left[:, :-1], right[:, 1:], atol=1e-9)
    np.testing.assert_allclose(d[:, 0], d[:, 1], atol=1e-9 * np.abs(d).max())
    np.testing.assert_allclose(d[:, -1], d[:, -2], atol=1e-9 * np.abs(d).max())


def test_a_row_of_many_is_the_row_alone():
    many = splines_through(POINTS).at(np.tile(ALONG, (4, 1)))
    for row in range(4):
        np.testing.assert_array_equal(splines_through(POINTS[row : row + 1]).at(ALONG[None])[0], many[row])


def test_it_is_scipys():
    interpolate = pytest.importorskip("scipy.interpolate", reason="needs scipy")
    tck, _ = interpolate.splprep(POINTS[0].T, s=0)
    expected = np.transpose(interpolate.splev(ALONG, tck))
    np.testing.assert_allclose(splines_through(POINTS[:1]).at(ALONG[None])[0], expected, atol=1e-12)
