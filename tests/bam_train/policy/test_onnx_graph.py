from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from bam_train.errors import FormatError
from bam_train.policy.onnx_graph import require_policy

WEIGHT = np.arange(6, dtype=np.float32).reshape(3, 2)
NUMBERS = (
    "FLOAT",
    "UINT8",
    "INT8",
    "UINT16",
    "INT16",
    "INT32",
    "INT64",
    "BOOL",
    "FLOAT16",
    "DOUBLE",
    "UINT32",
    "UINT64",
)


def model(*tensors: Any, **constants: np.ndarray) -> onnx.ModelProto:
    graph = helper.make_graph(
        [helper.make_node("Gemm", ["x", "w", ""], ["h"], alpha=0.5, transB=0), helper.make_node("Relu", ["h"], ["y"])],
        "policy",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 3])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [None, 2])],
        [*tensors, *(numpy_helper.from_array(array, name) for name, array in constants.items())],
    )
    return helper.make_model(graph)


@pytest.mark.parametrize("kind", NUMBERS)
@pytest.mark.parametrize("raw", [True, False])
def test_every_type_of_number_is_accepted_however_it_is_stored(kind: str, raw: bool):
    code = getattr(TensorProto, kind)
    array = np.array([[1, 0], [3, 100]]).astype(helper.tensor_dtype_to_np_dtype(code))
    tensor = (
        numpy_helper.from_array(array, "w")
        if raw
        else helper.make_tensor("w", code, array.shape, array.ravel().tolist())
    )
    assert bool(tensor.raw_data) == raw
    require_policy(model(tensor).SerializeToString())


def test_large_weights_are_accepted_in_initializers_and_constants():
    large = np.zeros((600, 600), np.float32)
    constant = helper.make_node("Constant", [], ["c"], value=numpy_helper.from_array(large))
    made = model(w=large)
    made.graph.node.insert(0, constant)
    require_policy(made.SerializeToString())


def damaged(change: str) -> bytes:
    made = model(w=WEIGHT)
    weight = made.graph.initializer[0]
    if change == "external":
        weight.data_location = TensorProto.EXTERNAL
    elif change == "short":
        weight.dims[0] = 4
    return made.SerializeToString()


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "not an ONNX file: it has no graph"),
        (b"PK\x03\x04 a zip", "not an ONNX file"),
        (b"\x3f", "not an ONNX file"),
        (b"\x38\x05", "not an ONNX file"),
        (b"\x08" + b"\xff" * 11, "not an ONNX file: a number of more than 64 bits"),
        (model(w=WEIGHT).SerializeToString()[:-5], "not an ONNX file"),
        (damaged("external"), "tensor 'w': its numbers are in another file; export with everything in one"),
        (damaged("short"), r"tensor 'w': expected 8 numbers for shape \(4, 2\), found 6"),
        (model(w=np.array(["a"], object)).SerializeToString(), "tensor 'w': type 8 is not supported"),
    ],
)
def test_what_is_not_a_policy_is_refused(data: bytes, text: str):
    with pytest.raises(FormatError, match=text):
        require_policy(data)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_any_damage_is_refused_or_harmless(data: st.DataObject):
    whole = bytearray(model(w=WEIGHT).SerializeToString())
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(FormatError):
        require_policy(bytes(whole[: data.draw(st.integers(0, len(whole)))]))
