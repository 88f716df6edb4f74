"""Values as trees: what is refused, and what is let through."""

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.remote.transports.values import check, exact, pack, unpack

BOX = spaces.Box(-1, 1, (2,))
FREE = spaces.Box(-np.inf, np.inf, (2,))
TREE = spaces.Dict({"z": spaces.Discrete(3, start=1), "a": spaces.Tuple([BOX, spaces.Text(2, charset="ab")])})


def test_a_tree_is_made_of_plain_values_and_arrays():
    box = np.float32([0.5, -0.0])
    tree = pack(TREE, {"a": (box, "ab"), "z": np.int64(3)})
    assert list(tree) == ["a", "z"]
    assert tree["z"] == 3
    assert type(tree["z"]) is int
    assert tree["a"][0] is box
    assert tree["a"][1] == "ab"
    value = unpack(TREE, tree)
    assert type(value["a"]) is tuple
    assert value["z"].dtype == np.int64


@pytest.mark.parametrize(
    ("space", "value", "text"),
    [
        (BOX, [0, np.nan], "action[1] is NaN; only numbers are sent."),
        (FREE, np.float32([np.nan, 0]), "action[0] is NaN; only numbers are sent."),
        (spaces.Box(-1, 1, ()), np.nan, "action is NaN; only numbers are sent."),
        (BOX, [0, np.inf], "action[1] is inf, where the space has a finite bound."),
        (spaces.Box(-np.inf, 0, (2,)), [np.inf, -np.inf], "action[0] is inf, where the space has a finite bound."),
        (spaces.Box(0, np.inf, (2,)), [np.inf, -np.inf], "action[1] is -inf, where the space has a finite bound."),
        (BOX, [0, 0, 0], "action must have shape (2,), not (3,)."),
        (BOX, 0.5, "action must have shape (2,), not ()."),
        (BOX, ["a", "b"], "action must be numbers, not ['a', 'b']."),
        (BOX, None, "action must be numbers, not None."),
        (BOX, [[1], [1, 2]], "action must be an array, not [[1], [1, 2]]."),
        (BOX, [1e300, 0], "action[0] is 1e+300, which float32 cannot hold."),
        (spaces.Box(0, 255, (2,), np.uint8), [0, 256], "action[1] is 256, which uint8 cannot hold."),
        (spaces.Box(0, 255, (2,), np.uint8), [-1, 0], "action[0] is -1, which uint8 cannot hold."),
        (spaces.Box(0, 255, (2,), np.uint8), [0.5, 1], "action must be of dtype uint8, not float64."),
        (spaces.Discrete(3), 3, "action must be a whole number from 0 to 2, not 3."),
        (spaces.Discrete(3, start=-1), -2, "action must be a whole number from -1 to 1, not -2."),
        (spaces.Discrete(3), 1.0, "action must be a whole number from 0 to 2, not 1.0."),
        (spaces.Discrete(3), True, "action must be a whole number from 0 to 2, not True."),
        (spaces.Discrete(3), None, "action must be a whole number from 0 to 2, not None."),
        (spaces.MultiDiscrete([2, 3]), [1, 3], "action must be one of MultiDiscrete([2 3]), not [1, 3]."),
        (spaces.MultiBinary(2), [1, 2], "action must be one of MultiBinary(2), not [1, 2]."),
        (spaces.Text(2, charset="ab"), "abc", "action must be 1 to 2 of the characters 'ab', not 'abc'."),
        (spaces.Text(2, charset="ab"), 7, "action must be 1 to 2 of the characters 'ab', not 7."),
        (spaces.Tuple([BOX]), [], "action must be 1 values, not []."),
        (spaces.Tuple([BOX, BOX]), ([0, 0], [0, np.nan]), "action[1][1] is NaN; only numbers are sent."),
        (spaces.Dict({"x": BOX}), {"y": 1}, "action must have the keys ['x'], not ['y']."),
        (spaces.Dict({"x": BOX}), 4, "action must have the keys ['x'], not 4."),
        (spaces.Sequence(BOX), np.zeros((1, 2)), "action must be a tuple of any length, not array([[0., 0.]])."),
        (spaces.Sequence(BOX, stack=True), 3, "action must be an array of any length, not 3."),
        (spaces.Sequence(BOX, stack=True), [[0, 0], [0, np.nan]], "action[1][1] is NaN; only numbers are sent."),
        (
            spaces.Sequence(spaces.Tuple([spaces.Discrete(2), spaces.Discrete(2)]), stack=True),
            ([0, 1], [0]),
            "The parts of action must have one length, not [2, 1].",
        ),
    ],
)
def test_what_does_not_fit_is_refused_by_its_place(space, value, text):
    with pytest.raises(InvalidValue) as caught:
        check(space, value, "action")
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (BOX, [2, -5]),  # beyond the bounds: environments clip
        (FREE, np.float32([np.inf, -np.inf])),
        (BOX, np.float64([0.1, 0.2])),
        (BOX, (0, 1)),
        (spaces.Box(-5, 5, (2,), np.int64), np.uint8([1, 2])),
        (spaces.Discrete(3), np.array(2)),
        (spaces.Discrete(3), np.array([2])),
        (spaces.MultiBinary(2), [True, False]),
        (spaces.Tuple([spaces.Discrete(2)]), [1]),
    ],
)
def test_what_fits_gets_the_dtype_of_its_space(space, value):
    result = exact(space, value)
    kind = space.spaces[0] if isinstance(space, spaces.Tuple) else space
    np.testing.assert_array_equal(
        np.asarray(result, kind.dtype), np.asarray(value, kind.dtype).reshape(np.shape(result))
    )


def test_arrays_that_do_not_lie_in_one_piece_are_copied():
    value = np.arange(12, dtype=np.float32).reshape(3, 4).T
    tree = pack(spaces.Box(-np.inf, np.inf, (4, 3)), value)
    assert tree.flags.c_contiguous
    np.testing.assert_array_equal(tree, value)


@pytest.mark.parametrize(
    ("tree", "text"),
    [
        (np.zeros(2), "value must be an array of float32 (2,), not float64 (2,)."),
        (np.zeros(3, np.float32), "value must be an array of float32 (2,), not float32 (3,)."),
        ([0.0, 0.0], "value must be an array of float32 (2,), not [0.0, 0.0]."),
        (np.float32([0, np.nan]), "value[1] is NaN; only numbers are sent."),
    ],
)
def test_a_tree_must_be_exact(tree, text):
    with pytest.raises(InvalidValue) as caught:
        unpack(BOX, tree)
    assert str(caught.value) == text


def test_a_tree_of_a_sequence_is_a_list():
    with pytest.raises(InvalidValue) as caught:
        unpack(spaces.Sequence(BOX), "x")
    assert str(caught.value) == "value must be a list, not 'x'."


@pytest.mark.parametrize("change", [pack, unpack])
def test_other_kinds_of_space_are_refused(change):
    with pytest.raises(UnknownName) as caught:
        change(spaces.Graph(BOX, None), None)
    assert caught.value.name == "Graph"


def test_long_values_are_shown_short():
    with pytest.raises(InvalidValue) as caught:
        check(spaces.Text(2), "x" * 1_000_000)
    assert len(str(caught.value)) < 250
