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
from bam_train.policy.onnx_file import DTYPES, parse


def model(nodes: list[Any], constants: dict[str, np.ndarray], **changes: Any) -> bytes:
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 3])],
        [helper.make_tensor_value_info("y", TensorProto.INT64, [None, 2])],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    return helper.make_model(graph, **changes).SerializeToString()


WEIGHT = np.arange(6, dtype=np.float32).reshape(3, 2)
NODES = [helper.make_node("Gemm", ["x", "w", ""], ["h"], alpha=0.5, transB=-1), helper.make_node("Relu", ["h"], ["y"])]


def test_a_graph_is_read():
    graph = parse(model(NODES, {"w": WEIGHT}))
    assert [(node.op, node.inputs, node.outputs, node.attributes) for node in graph.nodes] == [
        ("Gemm", ("x", "w", ""), ("h",), {"alpha": 0.5, "transB": -1}),
        ("Relu", ("h",), ("y",), {}),
    ]
    assert [(value.name, value.dtype, value.shape) for value in graph.inputs] == [("x", np.float32, (None, 3))]
    assert [(value.name, value.dtype, value.shape) for value in graph.outputs] == [("y", np.int64, (None, 2))]
    np.testing.assert_array_equal(graph.constants["w"], WEIGHT)
    assert not graph.constants["w"].flags.writeable


def test_every_kind_of_attribute_is_read():
    values = {"f": 1.5, "i": -(2**40), "s": b"text", "floats": [0.5, -1.0], "ints": [-1, 2**40], "t": WEIGHT}
    given_values = {**values, "t": numpy_helper.from_array(WEIGHT)}
    found = parse(model([helper.make_node("Any", [], ["y"], domain="my", **given_values)], {})).nodes[0]
    assert found.op == "my.Any"
    np.testing.assert_array_equal(found.attributes.pop("t"), values.pop("t"))
    assert found.attributes == values


@pytest.mark.parametrize("code", DTYPES)
@pytest.mark.parametrize("raw", [True, False])
def test_every_type_of_number_is_read_however_it_is_stored(code: int, raw: bool):
    array = np.array([[1, 0], [3, 100]]).astype(DTYPES[code])
    tensor = (
        numpy_helper.from_array(array, "w")
        if raw
        else helper.make_tensor("w", code, array.shape, array.ravel().tolist())
    )
    assert bool(tensor.raw_data) == raw
    graph = helper.make_graph([], "g", [], [], [tensor])
    found = parse(helper.make_model(graph).SerializeToString()).constants["w"]
    np.testing.assert_array_equal(found, array)
    assert found.dtype == array.dtype


def test_weights_that_are_inputs_too_are_no_inputs():
    weight = helper.make_tensor_value_info("w", TensorProto.FLOAT, [3, 2])
    loaded = onnx.load_from_string(model(NODES, {"w": WEIGHT}))
    loaded.graph.input.append(weight)
    assert [value.name for value in parse(loaded.SerializeToString()).inputs] == ["x"]


def external() -> bytes:
    loaded = onnx.load_from_string(model(NODES, {"w": WEIGHT}))
    loaded.graph.initializer[0].data_location = TensorProto.EXTERNAL
    return loaded.SerializeToString()


def short() -> bytes:
    loaded = onnx.load_from_string(model(NODES, {"w": WEIGHT}))
    loaded.graph.initializer[0].dims[0] = 4
    return loaded.SerializeToString()


def texts() -> bytes:
    return model(NODES, {"w": np.array(["a"], object)})


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "not an ONNX file: field 7 is missing"),
        (b"PK\x03\x04 a zip", "not an ONNX file"),
        (b"\x3f", "not an ONNX file: wire type 7"),
        (b"\x38\x05", "not an ONNX file: a number where a message should be"),
        (b"\x08" + b"\xff" * 11, "not an ONNX file: a number of more than 64 bits"),
        (model(NODES, {"w": WEIGHT})[:-5], "not an ONNX file"),
        (external(), "tensor 'w': its numbers are in another file; export with everything in one"),
        (short(), r"tensor 'w': expected 8 numbers for shape \(4, 2\), found 6"),
        (texts(), "tensor 'w': type 8 is not supported"),
    ],
)
def test_what_is_not_onnx_is_refused(data: bytes, text: str):
    with pytest.raises(FormatError, match=text):
        parse(data)


@settings(max_examples=500, deadline=None)
@given(st.data())
def test_any_damage_is_refused_or_harmless(data: st.DataObject):
    whole = bytearray(model(NODES, {"w": WEIGHT}))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(FormatError):
        parse(bytes(whole[: data.draw(st.integers(0, len(whole)))]))
