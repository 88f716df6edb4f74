"""Golden observations: how many, which, and where they lie."""

import types

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

from bam_train.checkpoint import safetensors_file
from bam_train.trainers.frozen_network import affordable, clearest, draw_array, pack


def test_large_arrays_are_few():
    small, image = Box(-1, 1, (3,), np.float32), Box(0, 255, (100, 100, 3), np.uint8)
    assert affordable([small], 256) == 256
    assert affordable([small, image], 256) == 200_000 // 30_012
    assert affordable([Box(0, 255, (1000, 1000, 3), np.uint8)], 256) == 4
    assert affordable([Box(0, 1, (0,), np.float32)], 256) == 256


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


def test_unclear_choices_are_left_out_and_order_is_kept():
    head = types.SimpleNamespace(margin=lambda scores: scores[:, 0].abs())
    module = types.SimpleNamespace(scores=lambda x: x, head=head)
    rows = np.array([[0.5], [0.0], [-2.0], [1.0]], np.float32)
    assert torch.equal(torch.as_tensor(clearest(module, {"": rows}, 3)[""]), torch.as_tensor(rows[[0, 2, 3]]))


@pytest.mark.parametrize(("key", "name"), [("", "observation"), ("arm", "observation.arm")])
def test_names_in_the_file(key, name):
    arrays = safetensors_file.parse(pack({key: np.zeros((2, 1), np.float32)}, np.ones(2)))
    assert sorted(arrays) == ["action", name]
