"""Spaces through JSON and back."""

import json
from typing import Any

import numpy as np
import pytest
from gymnasium import Space, spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.spaces import (
    indexed,
    joined,
    leaves_by_path,
    mapped,
    part_at,
    place_of,
    space_from_json,
    space_to_json,
)

FLOATS, INTS = ("float16", "float32", "float64"), ("uint8", "int8", "int32", "int64", "uint16")


def through_json(space: Space[Any]) -> Space[Any]:
    return space_from_json(json.loads(json.dumps(space_to_json(space), allow_nan=False)))


@st.composite
def boxes(draw: st.DrawFn) -> spaces.Box:
    dtype = np.dtype(draw(st.sampled_from((*FLOATS, *INTS))))
    shape = draw(st.one_of(st.just(()), array_shapes(max_dims=3, max_side=3)))
    if dtype.kind == "f":
        numbers: Any = st.floats(allow_nan=False, width=8 * dtype.itemsize)
    else:
        info = np.iinfo(dtype)
        numbers = st.integers(int(info.min), int(info.max))
    if draw(st.booleans()):
        one, two = draw(numbers), draw(numbers)
        first, second = np.full(shape, one, dtype), np.full(shape, two, dtype)
    else:
        first, second = (draw(arrays(dtype, shape, elements=numbers)) for _ in range(2))
    return spaces.Box(np.minimum(first, second), np.maximum(first, second), shape=shape, dtype=dtype)  # type: ignore[arg-type]


def discretes() -> st.SearchStrategy[spaces.Discrete]:
    return st.builds(lambda n, start: spaces.Discrete(n, start=start), st.integers(1, 99), st.integers(-9, 9))


@st.composite
def multi_discretes(draw: st.DrawFn) -> spaces.MultiDiscrete:
    shape = draw(array_shapes(max_dims=2, max_side=3))
    nvec = draw(arrays(np.int64, shape, elements=st.integers(1, 9)))
    return spaces.MultiDiscrete(nvec, start=draw(arrays(np.int64, shape, elements=st.integers(-9, 9))))


def multi_binaries() -> st.SearchStrategy[spaces.MultiBinary]:
    shapes = st.lists(st.integers(1, 4), min_size=2, max_size=3)
    return st.builds(spaces.MultiBinary, st.one_of(st.integers(1, 9), shapes))


def texts() -> st.SearchStrategy[spaces.Text]:
    charset = st.sets(st.characters(codec="utf-8"), min_size=1, max_size=5).map(lambda some: "".join(sorted(some)))
    return st.builds(lambda length, chars: spaces.Text(length, charset=chars), st.integers(1, 9), charset)


LEAVES = st.one_of(boxes(), discretes(), multi_discretes(), multi_binaries(), texts())
SPACES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.dictionaries(st.text(max_size=5), inner, max_size=3).map(lambda some: spaces.Dict(list(some.items()))),  # type: ignore[arg-type]
        st.lists(inner, max_size=3).map(spaces.Tuple),
        st.builds(lambda one, stack: spaces.Sequence(one, stack=stack), inner, st.booleans()),
    ),
    max_leaves=5,
)


@settings(max_examples=150, deadline=None)
@given(SPACES)
def test_any_space_comes_back_equal(space: Space[Any]) -> None:
    back = through_json(space)
    assert back == space
    assert space_to_json(back) == space_to_json(space)


@settings(max_examples=100, deadline=None)
@given(boxes())
def test_a_box_keeps_every_bit(space: spaces.Box) -> None:
    back = through_json(space)
    assert isinstance(back, spaces.Box)
    assert back.dtype == space.dtype
    assert back.low.tobytes() == space.low.tobytes()
    assert back.high.tobytes() == space.high.tobytes()


def test_json_forms() -> None:
    inf = np.inf
    assert space_to_json(spaces.Box(-1, 1, (3,))) == {
        "type": "Box",
        "shape": [3],
        "dtype": "float32",
        "low": -1.0,
        "high": 1.0,
    }
    assert space_to_json(spaces.Box(np.array([-inf, 0.1]), np.array([inf, 2.0]), dtype=np.float64)) == {
        "type": "Box",
        "shape": [2],
        "dtype": "float64",
        "low": ["-inf", 0.1],
        "high": ["inf", 2.0],
    }
    assert space_to_json(spaces.Box(0, 255, (2, 2, 3), np.uint8)) == {
        "type": "Box",
        "shape": [2, 2, 3],
        "dtype": "uint8",
        "low": 0,
        "high": 255,
    }
    assert space_to_json(spaces.Discrete(4)) == {"type": "Discrete", "n": 4, "start": 0, "dtype": "int64"}
    assert space_to_json(spaces.MultiDiscrete([3, 2], start=[1, 0])) == {
        "type": "MultiDiscrete",
        "nvec": [3, 2],
        "start": [1, 0],
        "dtype": "int64",
    }
    assert space_to_json(spaces.MultiBinary(5)) == {"type": "MultiBinary", "n": [5]}
    assert space_to_json(spaces.MultiBinary([2, 3])) == {"type": "MultiBinary", "n": [2, 3]}
    assert space_to_json(spaces.Text(5, charset="ba")) == {
        "type": "Text",
        "min_length": 1,
        "max_length": 5,
        "charset": "ba",
    }
    assert space_to_json(spaces.Tuple([spaces.Discrete(2)])) == {
        "type": "Tuple",
        "spaces": [{"type": "Discrete", "n": 2, "start": 0, "dtype": "int64"}],
    }
    assert space_to_json(spaces.Sequence(spaces.MultiBinary(2), stack=True)) == {
        "type": "Sequence",
        "space": {"type": "MultiBinary", "n": [2]},
        "stack": True,
    }


def test_a_dict_keeps_its_order() -> None:
    space = spaces.Dict([("z", spaces.Discrete(2)), ("a", spaces.Discrete(3))])  # type: ignore[arg-type]
    back = through_json(space)
    assert isinstance(back, spaces.Dict)
    assert list(back.spaces) == ["z", "a"]


def test_one_dimensional_multi_binary_holds_the_same_arrays() -> None:
    back = through_json(spaces.MultiBinary([5]))
    assert back == spaces.MultiBinary(5)
    assert back.shape == (5,)


@pytest.mark.parametrize(
    ("space", "name"),
    [
        (spaces.Sequence(spaces.OneOf([spaces.Discrete(2)])), "OneOf"),
        (spaces.Graph(spaces.Discrete(2), None), "Graph"),
        (spaces.Dict({"x": spaces.OneOf([spaces.Discrete(2)])}), "OneOf"),
    ],
)
def test_other_kinds_of_space_are_refused(space: Space[Any], name: str) -> None:
    with pytest.raises(UnknownName) as caught:
        space_to_json(space)
    assert caught.value.name == name
    assert str(caught.value).startswith(f"Unknown kind of space '{name}'. ")


def test_nan_bounds_are_refused() -> None:
    space = spaces.Box(0, 1, (2,))
    space.low[1] = np.nan
    with pytest.raises(InvalidValue) as caught:
        space_to_json(space)
    assert str(caught.value) == "The low of a Box must be numbers, not NaN."


def test_keys_that_are_not_strings_are_refused() -> None:
    with pytest.raises(InvalidValue) as caught:
        space_to_json(spaces.Dict({1: spaces.Discrete(2)}))  # type: ignore[dict-item]
    assert str(caught.value) == "The keys of a Dict space must be strings, not 1."


BOX = {"type": "Box", "shape": [2], "dtype": "float32", "low": -1.0, "high": 1.0}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("Box", "A space is an object with a type, not 'Box'."),
        ({}, "Unknown kind of space 'None'. "),
        ({"type": "Bax"}, "Unknown kind of space 'Bax'. Did you mean 'Box'?"),
        ({"type": "Box"}, "The Box space has no field 'dtype'."),
        ({**BOX, "low": float("nan")}, 'The low of a Box must be numbers, "inf" or "-inf", not nan.'),
        ({**BOX, "low": None}, 'The low of a Box must be numbers, "inf" or "-inf", not None.'),
        ({**BOX, "high": [1.0]}, "The high of the Box must have shape (2,), not (1,)."),
        ({**BOX, "low": 2.0}, "The fields of the Box space do not make one: "),
        ({**BOX, "dtype": "float33"}, "The fields of the Box space do not make one: "),
        ({**BOX, "shape": 2}, "The fields of the Box space do not make one: "),
        ({**BOX, "shape": [-1]}, "The fields of the Box space do not make one: "),
        (
            {"type": "Discrete", "n": 0, "start": 0, "dtype": "int64"},
            "The fields of the Discrete space do not make one: ",
        ),
        (
            {"type": "Discrete", "n": "4", "start": 0, "dtype": "int64"},
            "Discrete space: n: expected a whole number, found '4'",
        ),
        ({"type": "Tuple", "spaces": [{"type": "Box"}]}, "The Box space has no field 'dtype'."),
        ({"type": "Sequence", "space": BOX}, "The Sequence space has no field 'stack'."),
        (
            {"type": "Sequence", "space": BOX, "stack": 1},
            "Sequence space: stack: expected true or false, found 1",
        ),
        ({"type": "Dict", "spaces": [1]}, "The fields of the Dict space do not make one: "),
        ({"type": "MultiBinary", "n": []}, None),
    ],
)
def test_values_that_make_no_space_are_refused(value: Any, text: str | None) -> None:
    if text is None:
        assert space_from_json(value).shape == ()
        return
    with pytest.raises((InvalidValue, UnknownName)) as caught:
        space_from_json(value)
    assert str(caught.value).startswith(text)


def test_reading_does_not_change_what_it_is_given() -> None:
    value = {"type": "Dict", "spaces": {"b": dict(BOX), "a": {"type": "MultiBinary", "n": [2]}}}
    before = json.dumps(value)
    space_from_json(value)
    assert json.dumps(value) == before


NESTED = spaces.Dict(
    {"arm": spaces.Dict({"q": spaces.Box(-1, 1, (2,))}), "pair": spaces.Tuple([spaces.Discrete(2)] * 2)}
)
PATHS = [("arm", "q"), ("pair", 0), ("pair", 1)]


def test_the_walk_over_a_space_and_its_values():
    value = {"arm": {"q": np.float32([0.5, 1])}, "pair": (np.int64(0), np.int64(1))}
    for tree in (NESTED, value):
        assert [path for path, _ in leaves_by_path(tree)] == PATHS
        assert [part is part_at(tree, path) for path, part in leaves_by_path(tree)] == [True] * 3
        assert joined(tree, dict(zip(PATHS, "abc", strict=True))) == {"arm": {"q": "a"}, "pair": ("b", "c")}
        assert joined(tree, {("arm",): 1, ("pair",): 2}) == {"arm": 1, "pair": 2}
        with pytest.raises(KeyError):
            joined(tree, {("arm",): 1})
    assert [path for path, _ in leaves_by_path(value, lambda part: isinstance(part, tuple))] == [
        ("arm", "q"),
        ("pair",),
    ]
    shapes = mapped(lambda space, one: (space.shape, np.shape(one)), NESTED, value)
    assert shapes == {"arm": {"q": ((2,), (2,))}, "pair": (((), ()), ((), ()))}
    twice = mapped(lambda one: np.stack([one, one]), value)
    assert indexed(twice, 1)["pair"] == (0, 1)
    assert indexed(twice, slice(1))["arm"]["q"].shape == (1, 2)
    assert list(leaves_by_path(3)) == [((), 3)]
    assert list(leaves_by_path({})) == []
    assert place_of("observation", ("arm", 0)) == "observation['arm'][0]"
