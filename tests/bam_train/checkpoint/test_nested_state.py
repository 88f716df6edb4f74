"""Any nested state as JSON and safetensors."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from bam_train.checkpoint.safetensors_file import pack, unpack
from bam_train.errors import FormatError


def same(one, other):
    """Equal, down to types, dtypes, shapes and bits."""
    if isinstance(one, np.ndarray | np.generic):
        return (
            type(one) is type(other)
            and one.dtype == other.dtype
            and one.shape == other.shape
            and one.tobytes() == other.tobytes()
        )
    if isinstance(one, dict):
        return isinstance(other, dict) and list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and math.isnan(one):
        return math.isnan(other)
    return type(one) is type(other) and one == other


@pytest.mark.parametrize(
    "tree",
    [
        None,
        [True, 1, 2**127 + 1, -0.1, 1e-320, "text", float("inf"), float("nan")],
        {"a": (1, (2.5, None)), "b": []},
        {0: {"step": np.float32(3)}, 1: np.arange(6, dtype=np.int16).reshape(2, 3)},
        {"$array": 3, "b": {"$tuple": [1]}},
        np.array(2.5),
        np.zeros((0, 3), np.uint8),
        np.float64(math.pi),
        np.random.default_rng(3).bit_generator.state,
        {"swapped": np.arange(6.0).reshape(2, 3).T},
    ],
)
def test_exact_both_ways(tree):
    assert same(unpack(*pack(tree)), tree)


def test_a_restored_generator_goes_on_with_the_same_numbers():
    rng = np.random.default_rng(5)
    rng.normal(size=7)
    saved = pack(rng.bit_generator.state)
    other = np.random.default_rng()
    other.bit_generator.state = unpack(*saved)
    assert np.array_equal(rng.normal(size=9), other.normal(size=9))


def test_tensors_come_back_as_tensors():
    torch = pytest.importorskip("torch")
    packed = pack({"w": torch.arange(3.0), "step": torch.tensor(2.0)})
    found = unpack(*packed, torch.from_numpy)
    assert torch.equal(found["w"], torch.arange(3.0))
    assert found["step"].shape == ()
    assert isinstance(unpack(*packed)["w"], np.ndarray)


def test_arrays_are_copies():
    array = np.zeros(2)
    packed = pack([array])
    array[:] = 1
    assert unpack(*packed)[0].tolist() == [0, 0]


def test_what_cannot_be_saved_is_named():
    with pytest.raises(FormatError, match=r"^/a/1: expected numbers, text, arrays or nests of them, found a object$"):
        pack({"a": [1, object()]})
    with pytest.raises(FormatError, match=r"^/a/b: two entries of a saved state have this name$"):
        pack({"a": {"b": np.zeros(1)}, "a/b": np.zeros(1)})


@pytest.mark.parametrize(
    "skeleton", ['{"$array": "missing"}', "{", '{"$items": [1]}', '{"$float": "x"}', "[" * 100_000]
)
def test_a_damaged_skeleton_is_refused(skeleton):
    with pytest.raises(FormatError, match=r"^a saved state cannot be read: "):
        unpack(skeleton.encode(), pack(None)[1])


def test_nothing_in_a_skeleton_is_more_than_data():
    evil = json.dumps({"$reduce": "os.system", "__class__": "x", "py/object": "os.system"})
    assert unpack(evil.encode(), pack(None)[1]) == {"$reduce": "os.system", "__class__": "x", "py/object": "os.system"}
