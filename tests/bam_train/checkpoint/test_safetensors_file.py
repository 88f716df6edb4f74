from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bam_train.checkpoint.safetensors_file import dump, pack, parse, unpack
from bam_train.errors import FormatError

INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]


def arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    made = {
        name: (rng.random((2, 3)) * 100).astype(name) for name in ("bool", "float16", "float32", "float64", *INTEGERS)
    }
    return {
        **made,
        "é": np.array(3.5),
        "empty": np.zeros((0, 3), np.float32),
        "transposed": np.eye(3, 2).T,
        ">": np.ones(2, ">f4"),
    }


def file_of(header: object, body: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + body


def test_arrays_of_every_type_come_back_as_writable_copies():
    found = parse(dump(arrays()))
    assert set(found) == set(arrays())
    for name, array in arrays().items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype.newbyteorder("=")
        assert found[name].flags.writeable
    assert parse(dump({})) == {}


def test_what_cannot_be_stored_is_named():
    for array in (np.array([{}]), np.ones(2, complex), np.array(["a"])):
        with pytest.raises(FormatError, match=r"array 'a': dtype .* cannot be stored; expected bool, an integer or a"):
            dump({"a": array})


def entry(dtype: object, shape: object, offsets: list[int], body: bytes = bytes(4)) -> bytes:
    return file_of({"a": {"dtype": dtype, "shape": shape, "data_offsets": offsets}}, body)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff" * 20,
        (2**23 + 8).to_bytes(8, "little") + b" " * (2**23 + 8),
        file_of(b"{nonsense"),
        file_of(b"[" * 100_000),
        file_of([]),
        file_of({"a": 3}),
        entry("F32", 3, [0, 4]),
        entry("BF16", [2], [0, 4]),
        entry("F4", [2], [0, 1]),
        entry([], [2], [0, 4]),
        entry("F32", [-1], [0, 4]),
        entry("F32", [1.5], [0, 4]),
        entry("F32", [2], [0, 8]),
        entry("F32", [1], [4, 8], bytes(8)),
        file_of({}, bytes(4)),
        entry("F32", [2**63, 0], [0, 0], b""),
        entry("F32", [1] * 100, [0, 4]),
    ],
)
def test_what_is_not_safetensors_is_refused(data: bytes):
    with pytest.raises(FormatError, match="not a safetensors file"):
        parse(data)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_any_damage_is_refused_or_harmless(data: st.DataObject):
    whole = bytearray(dump({"a": np.arange(6.0), "b": np.ones((2, 2), np.uint8)}))
    where = data.draw(st.integers(0, len(whole) - 1))
    whole[where] = data.draw(st.integers(0, 255))
    try:
        found = parse(bytes(whole[: data.draw(st.integers(0, len(whole)))]))
    except FormatError:
        return
    assert sum(array.nbytes for array in found.values()) <= len(whole)


# Nested state


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
        {"a": {"b": np.zeros(1)}, "a/b": np.ones(1)},
        {"swapped": np.arange(6.0).reshape(2, 3).T},
        {"$reduce": "os.system", "__class__": "x", "py/object": "os.system"},
    ],
)
def test_exact_both_ways(tree):
    assert same(unpack(*pack("a", tree).values()), tree)


def test_tensors_come_back_as_tensors():
    torch = pytest.importorskip("torch")
    packed = pack("a", {"w": torch.arange(3.0), "step": torch.tensor(2.0)})
    found = unpack(*packed.values(), torch.from_numpy)
    assert torch.equal(found["w"], torch.arange(3.0))
    assert found["step"].shape == ()
    assert isinstance(unpack(*packed.values())["w"], np.ndarray)


def test_arrays_are_copies():
    array = np.zeros(2)
    packed = pack("a", [array])
    array[:] = 1
    assert unpack(*packed.values())[0].tolist() == [0, 0]


def test_what_cannot_be_saved_is_named():
    with pytest.raises(FormatError, match=r"^/a/1: expected numbers, text, arrays or nests of them, found a object$"):
        pack("a", {"a": [1, object()]})


@pytest.mark.parametrize(
    "skeleton", ['{"$array": "missing"}', "{", '{"$items": [1]}', '{"$float": "x"}', "[" * 100_000]
)
def test_a_damaged_skeleton_is_refused(skeleton):
    with pytest.raises(FormatError, match=r"^a saved state cannot be read: "):
        unpack(skeleton.encode(), pack("a", None)["a.safetensors"])
