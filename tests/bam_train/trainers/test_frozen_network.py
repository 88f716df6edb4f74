"""Golden observations: values of the space, and where they lie."""

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

from bam_train.trainers.frozen_network import draw_array


@pytest.mark.parametrize(
    "space",
    [
        Box(-2, 3, (2,), np.float32),
        Box(np.array([-np.inf, 0]), np.array([np.inf, 1e38]), dtype=np.float64),
        Box(0, 255, (4, 4, 1), np.uint8),
        Discrete(3, start=-1),
        MultiDiscrete([2, 5], start=[1, 0]),
        MultiBinary(4),
    ],
    ids=str,
)
def test_values_are_of_the_space(space):
    drawn = draw_array(space, 50, np.random.default_rng(0), None)
    assert len(drawn) == 50
    assert all(one in space for one in drawn)
    assert len(np.unique(drawn)) > 1


def test_normalised_numbers_are_about_their_mean():
    space, moments = Box(-np.inf, np.inf, (1,), np.float64), (np.array([100.0]), np.array([0.5]))
    drawn = draw_array(space, 1000, np.random.default_rng(0), moments)
    assert drawn.mean() == pytest.approx(100, abs=0.2)
    assert drawn.std() == pytest.approx(1.0, abs=0.1)
