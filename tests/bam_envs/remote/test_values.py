"""Values as trees: what is refused, and what is let through."""

import json

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, ProtocolError, UnknownName
from bam_envs.remote.wire.values import exact, pack, plain_info, tree_from_json, tree_to_json
from tests.raising import raising

BOX = spaces.Box(-1, 1, (2,))
SHORT = f"'{27 * 'x'}...{28 * 'x'}'"
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
    value = exact(TREE, tree)
    assert type(value["a"]) is tuple
    assert value["z"].dtype == np.int64


@pytest.mark.parametrize(
    ("space", "value", "text"),
    [
        (BOX, [0, np.nan], "action[1] is NaN; only numbers are sent."),
        (FREE, np.float32([np.nan, 0]), "action[0] is NaN; only numbers are sent."),
        (spaces.Box(-1, 1, ()), np.nan, "action is NaN; only numbers are sent."),
        (BOX, [0, np.inf], "action[1] is inf, where the space has a finite bound."),
        (spaces.Box(0, np.inf, (2,)), [np.inf, -np.inf], "action[1] is -inf, where the space has a finite bound."),
        (BOX, [0, 0, 0], "action must have shape (2,), not (3,)."),
        (BOX, ["a", "b"], "action must be numbers, not ['a', 'b']."),
        (BOX, None, "action must be numbers, not None."),
        (BOX, [[1], [1, 2]], "action must be an array, not [[1], [1, 2]]."),
        (BOX, [1e300, 0], "action[0] is 1e+300, which float32 cannot hold."),
        (spaces.Box(0, 255, (2,), np.uint8), [0, 256], "action[1] is 256, which uint8 cannot hold."),
        (spaces.Box(0, 255, (2,), np.uint8), [0.5, 1], "action must be of dtype uint8, not float64."),
        (spaces.Discrete(3), 3, "action must be a whole number from 0 to 2, not 3."),
        (spaces.Discrete(3, start=-1), -2, "action must be a whole number from -1 to 1, not -2."),
        (spaces.Discrete(3), 1.0, "action must be a whole number from 0 to 2, not 1.0."),
        (spaces.Discrete(3), True, "action must be a whole number from 0 to 2, not True."),
        (spaces.MultiDiscrete([2, 3]), [1, 3], "action must be one of MultiDiscrete([2 3]), not [1, 3]."),
        (spaces.MultiBinary(2), [1, 2], "action must be one of MultiBinary(2), not [1, 2]."),
        (spaces.Text(2, charset="ab"), "abc", "action must be 1 to 2 of the characters 'ab', not 'abc'."),
        (spaces.Text(2, charset="ab"), "x" * 1_000_000, f"action must be 1 to 2 of the characters 'ab', not {SHORT}."),
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
    with raising(InvalidValue, text):
        exact(space, value, "action")


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


def test_a_stacked_sequence_is_a_list_of_its_items_in_a_tree():
    space = spaces.Sequence(spaces.Dict({"x": BOX}), stack=True)
    value = {"x": np.float32([[0, 1], [1, 0]])}
    tree = pack(space, value)
    assert [one["x"].tolist() for one in tree] == [[0, 1], [1, 0]]
    np.testing.assert_array_equal(exact(space, tree)["x"], value["x"])


def test_other_kinds_of_space_are_refused():
    with pytest.raises(UnknownName) as caught:
        pack(spaces.Graph(BOX, None), None)
    assert caught.value.name == "Graph"


class Thing:
    def __str__(self):
        return "a thing"


def test_infos_become_plain():
    info = {
        1: (True, None, "x"),
        "set": {3},
        "thing": Thing(),
        "large": 2**70,
        "objects": np.array(["a", None], dtype=object),
        "array": np.arange(4).reshape(2, 2).T,
        "scalar": np.float32(0.1),
        "nan": float("nan"),
        "nested": {"in": [np.int8(2)]},
        "text": np.array(["success"])[0],  # a scalar of text would be refused at the other end
    }
    tree = plain_info(info)
    assert (type(tree["text"]), tree_from_json(tree_to_json(tree["text"]))) == (str, "success")
    assert tree["1"] == [True, None, "x"]
    assert (tree["set"], tree["thing"], tree["large"]) == ([3], "a thing", str(2**70))
    assert tree["objects"] == ["a", None]
    assert tree["array"].flags.c_contiguous
    assert tree["array"].tolist() == [[0, 2], [1, 3]]
    assert tree["scalar"].dtype == np.float32
    assert np.isnan(tree["nan"])
    assert tree["nested"]["in"][0].dtype == np.int8
    assert 1 in info


JSON_TREE = {
    "array": np.array([[1.5, np.nan]], np.float32),
    "empty": np.zeros((0, 3), np.int16),
    "scalar": np.int8(-3),
    "numbers": [1, -0.0, float("inf"), float("-inf"), True, None],
    "marks": [{"array": 1}, {"dict": {"float": 2}}, {"float": "nan", "x": 1}],
    "text": "ü\ud800",
}


def test_a_tree_comes_through_strict_json_bit_for_bit():
    back = tree_from_json(json.loads(json.dumps(tree_to_json(JSON_TREE), allow_nan=False)))
    for key in ("array", "empty", "scalar"):
        assert (back[key].dtype, back[key].shape) == (JSON_TREE[key].dtype, JSON_TREE[key].shape)
        assert back[key].tobytes() == JSON_TREE[key].tobytes()
    assert back["array"].flags.writeable
    assert [repr(back[key]) for key in ("numbers", "marks", "text")] == [
        repr(JSON_TREE[key]) for key in ("numbers", "marks", "text")
    ]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({"array": ["O", [1], ""]}, "Expected the array of a value, found ['O', [1], '']: 'O' is no dtype of numbers."),
        ({"array": 3}, "Expected the array of a value, found 3: cannot unpack non-iterable int object."),
        ({"array": ["<f4", [2], "AAAA"]}, "Expected the array of a value, found "),
        ({"array": ["<f4", [2], "!"]}, "Expected the array of a value, found "),
        ({"scalar": ["<f4"]}, "Expected the scalar of a value, found "),
        ({"float": "much"}, "Expected the float of a value, found 'much': "),
    ],
)
def test_what_is_no_value_is_refused(value, text):
    with raising(ProtocolError, text, begins=True):
        tree_from_json([value])
