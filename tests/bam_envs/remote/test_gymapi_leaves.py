"""Which parts of a space go where, and under which names."""

from collections import OrderedDict

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.remote.wire.gymapi_leaves import is_depth, leaves_of

POSE = {"position": spaces.Box(-1, 1, (3,)), "orientation": spaces.Box(-1, 1, (4,))}
WIDTH = spaces.Box(0, 1, ())


def kinds(space, **options):
    return [(leaf.kind, leaf.name) for leaf in leaves_of(space, "it", **options)]


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (spaces.Box(-1, 1, (2,)), [("numbers", "it")]),
        (spaces.Box(-1, 1, (0,)), [("exact", "it")]),
        (spaces.Box(-1, 1, (65, 64)), [("exact", "it")]),
        (spaces.Box(-1, 1, (2,), np.longdouble), [("exact", "it")]),
        (spaces.Discrete(3), [("numbers", "it")]),
        (spaces.MultiBinary([2, 2]), [("numbers", "it")]),
        (spaces.Text(3), [("exact", "it")]),
        (spaces.Box(0, 255, (8, 8), np.uint8), [("image", "it")]),
        (spaces.Box(0, 255, (8, 8, 4), np.uint8), [("image", "it")]),
        (spaces.Box(0, 255, (8, 8, 2), np.uint8), [("numbers", "it")]),
        (spaces.Box(0, 255, (7, 8, 3), np.uint8), [("numbers", "it")]),
        (spaces.Tuple([spaces.Discrete(2), WIDTH]), [("numbers", "0"), ("numbers", "1")]),
        (spaces.Dict(a=spaces.Dict(b=WIDTH)), [("numbers", "a/b")]),
        (spaces.Dict(OrderedDict([("a/b", WIDTH), ("a", spaces.Dict(b=WIDTH))])), [("exact", "it")]),
        (spaces.Dict(), [("exact", "it")]),
        (spaces.Tuple([]), [("exact", "it")]),
        (spaces.Dict(POSE), [("pose", "it")]),
        (spaces.Dict(goal=spaces.Dict(POSE)), [("pose", "goal")]),
        (
            spaces.Dict({**POSE, "speed": WIDTH}),
            [("numbers", "orientation"), ("numbers", "position"), ("numbers", "speed")],
        ),
        (
            spaces.Dict({**POSE, "gripper_width": WIDTH}),
            [("numbers", "gripper_width"), ("numbers", "orientation"), ("numbers", "position")],
        ),
    ],
    ids=str,
)
def test_kinds(space, expected):
    assert kinds(space) == expected


def test_an_action_may_be_a_pose_with_a_gripper_width():
    assert kinds(spaces.Dict({**POSE, "gripper_width": WIDTH}), gripper=True) == [("pose", "it")]


@pytest.mark.parametrize("other", [spaces.Text(3), spaces.Box(0, 1, (0,)), spaces.Discrete(3)])
def test_where_two_parts_have_one_name_all_is_one_exact_leaf(other):
    space = spaces.Dict(OrderedDict({"0": spaces.Tuple([spaces.MultiBinary(1)]), "0/0": other}))
    assert kinds(space) == [("exact", "it")]


def test_depth():
    assert is_depth(spaces.Box(0, 9, (8, 8)))
    assert is_depth(spaces.Box(0, 9, (8, 8, 1), np.float64))
    assert not is_depth(spaces.Box(0, 9, (8, 8, 3)))
    assert not is_depth(spaces.Box(0, 255, (8, 8), np.uint8))
    assert not is_depth(spaces.Text(3))
