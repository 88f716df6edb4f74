from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bam_train.checkpoint.safetensors_file import dump, parse
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
