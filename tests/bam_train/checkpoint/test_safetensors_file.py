from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import numpy as library

from bam_train.checkpoint.safetensors_file import dump, parse
from bam_train.errors import FormatError

DTYPES = [
    "bool",
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "uint64",
    "float16",
    "float32",
    "float64",
]


def arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    made = {f"{name}.{i}": (rng.random((2, 3)) * 100).astype(name) for name in DTYPES for i in range(2)}
    return {**made, "é": np.array(3.5), "empty": np.zeros((0, 3), np.float32), "transposed": np.eye(3, 2).T}


def file_of(header: object, body: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + body


def test_writes_the_bytes_that_the_library_writes():
    contiguous = {name: np.array(array, order="C") for name, array in arrays().items()}
    assert dump(arrays()) == library.save(contiguous)


def test_the_library_reads_ours_and_we_read_the_librarys():
    for read in (parse(dump(arrays())), library.load(dump(arrays())), parse(library.save(arrays(), {"made": "by"}))):
        assert set(read) == set(arrays())
    for name, array in parse(dump(arrays())).items():
        np.testing.assert_array_equal(array, arrays()[name])
        assert array.dtype == arrays()[name].dtype
        assert array.flags.writeable


def test_nothing_is_a_file_too():
    assert parse(dump({})) == {}


def test_an_object_array_is_refused():
    with pytest.raises(FormatError, match=r"array 'a': dtype object cannot be stored; expected bool, an integer or a"):
        dump({"a": np.array([{}])})


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "not a safetensors file: 0 bytes, too short for its header"),
        (b"\xff" * 20, "not a safetensors file: 20 bytes, too short"),
        (file_of(b"{nonsense"), "its header is not JSON"),
        (file_of(b"[" * 100_000), "its header is not JSON"),
        (file_of([]), "its header is a list, expected an object"),
        (file_of({"a": 3}), "array 'a': expected dtype, shape and data_offsets, found 3"),
        (file_of({"a": {"dtype": "F32", "shape": 3, "data_offsets": [0, 4]}}), "array 'a': expected dtype, shape"),
        (
            file_of({"a": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}}, bytes(4)),
            "dtype 'BF16' is not known",
        ),
        (file_of({"a": {"dtype": [], "shape": [2], "data_offsets": [0, 4]}}, bytes(4)), r"dtype \[\] is not known"),
        (file_of({"a": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}, bytes(4)), "must be whole numbers"),
        (file_of({"a": {"dtype": "F32", "shape": [1.5], "data_offsets": [0, 4]}}, bytes(4)), "must be whole numbers"),
        (file_of({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}}, bytes(4)), "expected 8 bytes within 4"),
        (
            file_of({"a": {"dtype": "F32", "shape": [1], "data_offsets": [4, 8]}}, bytes(8)),
            "a gap or overlap at byte 0",
        ),
        (file_of({}, bytes(4)), "expected 0 bytes of arrays, found 4"),
        (file_of({"a": {"dtype": "F32", "shape": [2**63, 0], "data_offsets": [0, 0]}}), "array 'a'"),
    ],
)
def test_what_is_not_safetensors_is_refused(data: bytes, text: str):
    with pytest.raises(FormatError, match=text):
        parse(data)


@settings(max_examples=300, deadline=None)
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
