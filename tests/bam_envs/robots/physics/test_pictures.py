"""Pictures of shapes: each body is where it should be, in its colour."""

import numpy as np
import pytest

from bam_envs.robots.physics.rendering import MOST_GEOMS, RenderingUnavailable, ShapeRenderer
from bam_envs.robots.physics.shapes import BLUE, RED, Shape, View, marked, turned

pytestmark = pytest.mark.slow

ABOVE = View((0.0, 0.0, 0.0), 4.0, 90.0, -90.0)
"""Straight from above, x to the right and y up: 45 degrees high, so about 3.3 m over 480 lines at the floor."""
PIXELS = 480 / (2 * 4.0 * np.tan(np.pi / 8))
"""A metre on the floor."""


@pytest.fixture
def renderer():
    try:
        made = ShapeRenderer("rgb_array")
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    yield made
    made.close()
    made.close()


def changed(renderer, *shapes):
    """Where the picture with these differs from that without (480, 640); shadows are faint, and left out."""
    empty = renderer.render([], ABOVE).astype(int)
    image = renderer.render(shapes, ABOVE)
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    return np.ptp(image.astype(int), axis=2) > np.ptp(empty, axis=2) + 40


def middle(mask):
    """Where the middle of the changed pixels is on the floor [m]."""
    rows, columns = np.nonzero(mask)
    return (columns.mean() - 319.5) / PIXELS, (239.5 - rows.mean()) / PIXELS


def extent(mask):
    """Its width and height [m]."""
    rows, columns = np.nonzero(mask)
    return np.ptp(columns) / PIXELS, np.ptp(rows) / PIXELS


def test_a_box_lies_where_it_is_put(renderer):
    seen = changed(renderer, Shape("box", np.array([0.5, -0.4, 0.01]), (0.8, 0.4, 0.02), BLUE))
    np.testing.assert_allclose(middle(seen), (0.5, -0.4), atol=0.02)
    np.testing.assert_allclose(extent(seen), (0.8, 0.4), atol=0.03)


def test_a_box_is_turned(renderer):
    seen = changed(renderer, Shape("box", np.array([0.5, 0.4, 0.01]), (0.8, 0.4, 0.02), BLUE, turned(np.pi / 2)))
    np.testing.assert_allclose(extent(seen), (0.4, 0.8), atol=0.03)


def test_a_capsule_goes_from_end_to_end(renderer):
    start, end = np.array([-1.0, 0.2, 0.05]), np.array([0.2, 0.2, 0.05])
    seen = changed(renderer, Shape("capsule", start, (0.05,), BLUE, to=end))
    np.testing.assert_allclose(middle(seen), (-0.4, 0.2), atol=0.02)
    np.testing.assert_allclose(extent(seen), (1.3, 0.1), atol=0.05)


def test_spheres_and_marks(renderer):
    seen = changed(renderer, Shape("sphere", np.array([0.6, 0.6, 0.0]), (0.2,), RED))
    np.testing.assert_allclose(extent(seen), (0.4, 0.4), atol=0.05)
    seen = changed(renderer, *marked([(np.array([-0.6, 0.6, 0.0]), (0.0, 1.0, 0.0, 1.0))], 0.1))
    np.testing.assert_allclose(middle(seen), (-0.6, 0.6), atol=0.03)
    np.testing.assert_allclose(extent(seen), (0.2, 0.2), atol=0.05)


def test_the_camera_follows_its_target(renderer):
    box = Shape("box", np.array([5.0, 3.0, 0.01]), (0.4, 0.4, 0.02), BLUE)
    assert not changed(renderer, box).any()
    image = renderer.render([box], View((5.0, 3.0, 0.0), 4.0, 90.0, -90.0)).astype(int)
    np.testing.assert_allclose(middle(np.ptp(image, axis=2) > 80), (0.0, 0.0), atol=0.02)


def test_what_is_too_much_is_left_out(renderer):
    many = [Shape("sphere", np.array([0.0, 0.0, 0.0]), (0.01,), RED)] * (2 * MOST_GEOMS)
    assert renderer.render(many, ABOVE).shape == (480, 640, 3)


def test_the_floor_may_lie_lower(renderer):
    lower = ShapeRenderer("rgb_array", floor=-0.5)
    try:
        assert (lower.render([], ABOVE) != renderer.render([], ABOVE)).any()
    finally:
        lower.close()
