"""Every operation against onnxruntime; whole networks are compared with their trainers in trainers/sb3/test_freeze."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from bam_train.errors import FormatError
from bam_train.policy.onnx_file import parse
from bam_train.policy.onnx_mlp import OPERATIONS, MlpRunner, Plan, UnsupportedGraph
from bam_train.policy.onnx_session import OnnxSession

RNG = np.random.default_rng(0)
W = RNG.normal(size=(6, 4)).astype(np.float32)
B = RNG.normal(size=4).astype(np.float32)
ROW = RNG.normal(size=6).astype(np.float32)
ONE = np.float32(0.3)
INTS = {name: np.array(values, np.int64) for name, values in {"a": [2, 0, 5], "b": [1, 2, 3], "axes": [1]}.items()}
node = helper.make_node


def graph_of(nodes: list[Any], constants: dict[str, Any] | None = None) -> bytes:
    """Build x (n, 6) -> y."""
    casts = [attribute.i for attribute in nodes[-1].attribute if attribute.name == "to"]
    y = casts[0] if casts else TensorProto.INT64 if nodes[-1].op_type == "ArgMax" else TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 6])],
        [helper.make_tensor_value_info("y", y, None)],
        [numpy_helper.from_array(np.asarray(array), name) for name, array in (constants or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    data = model.SerializeToString()
    assert isinstance(data, bytes)
    return data


F = TensorProto.FLOAT
CASES: dict[str, tuple[list[Any], dict[str, Any]]] = {
    "Add row": ([node("Add", ["x", "r"], ["y"])], {"r": ROW}),
    "Add number": ([node("Add", ["c", "x"], ["y"])], {"c": ONE}),
    "Add itself": ([node("Add", ["x", "x"], ["y"])], {}),
    "ArgMax": ([node("ArgMax", ["x"], ["y"], axis=1, keepdims=0)], {}),
    "ArgMax keep": ([node("ArgMax", ["x"], ["y"], axis=1)], {}),
    "Cast": ([node("Cast", ["x"], ["h"], to=TensorProto.DOUBLE), node("Cast", ["h"], ["y"], to=F)], {}),
    "Cast nothing": ([node("Cast", ["x"], ["y"], to=F)], {}),
    "Clip": ([node("Clip", ["x", "l", "h"], ["y"])], {"l": np.float32(-0.5), "h": ONE}),
    "Clip low": ([node("Clip", ["x", "l"], ["y"])], {"l": np.float32(-0.5)}),
    "Clip high": ([node("Clip", ["x", "", "h"], ["y"])], {"h": ONE}),
    "Concat": ([node("Tanh", ["x"], ["t"]), node("Concat", ["x", "t", "x"], ["y"], axis=1)], {}),
    "Constant": ([node("Constant", [], ["c"], value=numpy_helper.from_array(ROW)), node("Mul", ["x", "c"], ["y"])], {}),
    "Div": ([node("Div", ["x", "r"], ["y"])], {"r": ROW}),
    "Elu": ([node("Elu", ["x"], ["y"], alpha=0.7)], {}),
    "Equal": ([node("Relu", ["x"], ["h"]), node("Equal", ["x", "h"], ["e"]), node("Cast", ["e"], ["y"], to=F)], {}),
    "Flatten": ([node("Unsqueeze", ["x", "axes"], ["h"]), node("Flatten", ["h"], ["y"])], INTS),
    "Gather": ([node("Gather", ["x", "a"], ["y"], axis=1)], INTS),
    "Gather negative": ([node("Gather", ["x", "a"], ["y"], axis=1)], {"a": np.array([-1, 2])}),
    "Gather one": ([node("Gather", ["x", "a"], ["y"], axis=1)], {"a": np.array(2)}),
    "Gemm": ([node("Gemm", ["x", "w", "b"], ["y"])], {"w": W, "b": B}),
    "Gemm transposed": ([node("Gemm", ["x", "w", "b"], ["y"], transB=1)], {"w": W.T, "b": B}),
    "Gemm without bias": ([node("Gemm", ["x", "w"], ["y"])], {"w": W}),
    "Gemm of a part": (
        [node("Split", ["x"], ["p", "q"], axis=1), node("Gemm", ["q", "w"], ["y"])], {"w": W[:3]}
    ),
    "Gemm of a transpose": (
        [node("Unsqueeze", ["x", "axes"], ["u"]), node("Transpose", ["u"], ["t"], perm=[0, 2, 1]),
         node("Reshape", ["t", "shape"], ["r"]), node("Gemm", ["r", "w"], ["y"])],
        {"w": W, "shape": np.array([0, -1]), **INTS},
    ),
    "Greater": ([node("Greater", ["x", "c"], ["e"]), node("Cast", ["e"], ["y"], to=TensorProto.INT8)], {"c": ONE}),
    "Identity": ([node("Identity", ["x"], ["h"]), node("Tanh", ["h"], ["y"])], {}),
    "Identity of a constant": ([node("Identity", ["r"], ["s"]), node("Add", ["x", "s"], ["y"])], {"r": ROW}),
    "LeakyRelu": ([node("LeakyRelu", ["x"], ["y"], alpha=0.2)], {}),
    "MatMul": ([node("MatMul", ["x", "w"], ["y"])], {"w": W}),
    "Max": ([node("Max", ["x", "r", "c"], ["y"])], {"r": ROW, "c": ONE}),
    "Min": ([node("Min", ["r", "x"], ["y"])], {"r": ROW}),
    "Mul": ([node("Mul", ["x", "r"], ["y"])], {"r": ROW}),
    "Relu": ([node("Relu", ["x"], ["y"])], {}),
    "Reshape": ([node("Reshape", ["x", "shape"], ["y"])], {"shape": np.array([-1, 2, 3])}),
    "Reshape of a transpose": (
        [node("Reshape", ["x", "shape"], ["h"]), node("Transpose", ["h"], ["t"], perm=[0, 2, 1]),
         node("Flatten", ["t"], ["y"])],
        {"shape": np.array([-1, 2, 3])},
    ),
    "Sigmoid": ([node("Sigmoid", ["x"], ["y"])], {}),
    "Split": ([node("Split", ["x", "b"], ["p", "q", "r"], axis=1), node("Concat", ["r", "p"], ["y"], axis=1)], INTS),
    "Sub": ([node("Sub", ["r", "x"], ["y"])], {"r": ROW}),
    "Tanh": ([node("Tanh", ["x"], ["y"])], {}),
    "Transpose": (
        [node("Reshape", ["x", "shape"], ["h"]), node("Transpose", ["h"], ["y"], perm=[0, 2, 1])],
        {"shape": np.array([-1, 2, 3])},
    ),
    "Unsqueeze": ([node("Unsqueeze", ["x", "axes"], ["y"])], INTS),
    "Constants folded": (
        [node("Mul", ["r", "r"], ["s"]), node("Add", ["s", "c"], ["t"]), node("Mul", ["x", "t"], ["y"])],
        {"r": ROW, "c": ONE},
    ),
}  # fmt: skip


@pytest.mark.parametrize("rows", [1, 2, 7])
@pytest.mark.parametrize("case", CASES)
def test_an_operation_gives_what_onnxruntime_gives(case: str, rows: int):
    data = graph_of(*CASES[case])
    runner, session = MlpRunner(parse(data)), OnnxSession(data)
    for _ in range(3):  # nothing may be left of the run before
        x = {"x": (RNG.normal(size=(rows, 6)) * 3).astype(np.float32)}
        found, expected = runner.run(x)["y"], session.run(x)["y"]
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_every_operation_has_a_case():
    assert {name.split()[0] for name in CASES} - {"Constants"} == set(OPERATIONS)


def test_large_numbers_do_not_overflow():
    x = np.array([[-3e38, -100, 0, 100, 3e38, 1]], np.float32)
    for op in ("Sigmoid", "Elu", "Tanh"):
        assert np.isfinite(MlpRunner(parse(graph_of([node(op, ["x"], ["y"])]))).run({"x": x})["y"]).all()


def test_constants_are_computed_once():
    plan = Plan(parse(graph_of(*CASES["Constants folded"])), 1)
    assert len(plan.calls) == 1
    np.testing.assert_array_equal(plan.inputs["x"], np.zeros((1, 6)))


def test_one_row_and_the_last_batch_are_kept_ready():
    runner = MlpRunner(parse(graph_of(*CASES["Gemm"])))
    x = RNG.normal(size=(9, 6)).astype(np.float32)
    nine = runner.run({"x": x})["y"]
    assert runner.run({"x": x[:1]})["y"] is runner.single.outputs["y"]
    assert runner.run({"x": x})["y"] is nine
    assert runner.run({"x": x[:4]})["y"].shape == (4, 4)


@pytest.mark.parametrize(
    ("nodes", "text"),
    [
        ([node("Conv", ["x", "w"], ["y"])], "operation Conv"),
        ([node("Tanh", ["x"], ["y"], domain="my")], "operation my.Tanh"),
        ([node("Gemm", ["x", "x"], ["y"])], "'x' must be constant"),
        ([node("Gemm", ["x", "w"], ["y"], alpha=2.0)], "a Gemm that scales or transposes its input"),
        ([node("Gemm", ["x", "w"], ["y"], transA=1)], "a Gemm that scales or transposes its input"),
        ([node("MatMul", ["x", "b"], ["y"])], r"a product of shapes \(1, 6\) and \(4,\)"),
        ([node("Gemm", ["nowhere", "w"], ["y"])], "operation Gemm: KeyError: 'nowhere'"),
        ([node("Add", ["x", "b"], ["y"])], "operation Add: ValueError"),
        ([node("Flatten", ["x"], ["y"], axis=0)], "a Flatten of the batch axis"),
        ([node("ArgMax", ["x"], ["y"], axis=1, select_last_index=1)], "an ArgMax that takes the last of equals"),
        ([node("LeakyRelu", ["x"], ["y"], alpha=2.0)], "LeakyRelu with alpha 2.0"),
        ([node("Gather", ["x", "far"], ["y"], axis=1)], "operation Gather: IndexError"),
        (
            [node("Cast", ["x"], ["h"], to=TensorProto.STRING), node("Tanh", ["h"], ["y"])],
            "operation Cast: KeyError: 8",
        ),
    ],
)
def test_what_numpy_does_not_run_is_left_to_onnxruntime(nodes: list[Any], text: str):
    with pytest.raises(UnsupportedGraph, match=text):
        MlpRunner(parse(graph_of(nodes, {"w": W, "b": B, "far": np.array([6])})))


def test_an_output_that_is_not_computed_is_refused():
    with pytest.raises(FormatError, match="output 'y' is not computed by the graph"):
        MlpRunner(parse(graph_of([node("Tanh", ["x"], ["z"])])))
