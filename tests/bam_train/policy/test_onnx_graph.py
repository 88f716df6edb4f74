"""Graphs: those of a policy are taken; a stranger's are refused at once or stopped, and never take a robot's memory."""

from __future__ import annotations

import contextlib
import itertools
import signal
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from bam_train.errors import FormatError, PolicyError
from bam_train.policy import FrozenPolicy, onnx_session
from bam_train.policy.onnx_graph import MOST_NODES, require_policy
from bam_train.policy.onnx_session import OnnxSession

BOX = {"type": "Box", "shape": [4], "dtype": "float32", "low": "-inf", "high": "inf"}
F = TensorProto.FLOAT
node = helper.make_node


def value(name: str) -> Any:
    return helper.make_tensor_value_info(name, F, ["n", 4])


def model(*nodes: Any, **constants: Any) -> onnx.ModelProto:
    """Build observation (n, 4) -> action (n, 4)."""
    arrays = [numpy_helper.from_array(np.asarray(array), name) for name, array in constants.items()]
    graph = helper.make_graph(list(nodes), "policy", [value("observation")], [value("action")], arrays)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def changed(change: Callable[[onnx.ModelProto], Any]) -> bytes:
    made = model(node("Softsign", ["observation"], ["action"]))
    change(made)
    data = made.SerializeToString()
    assert isinstance(data, bytes)
    return data


def of(*nodes: Any, **constants: Any) -> bytes:
    data = model(*nodes, **constants).SerializeToString()
    assert isinstance(data, bytes)
    return data


BODY = helper.make_graph(
    [node("Identity", ["go"], ["on"]), node("Tanh", ["seen"], ["then"])],
    "body",
    [
        helper.make_tensor_value_info("i", TensorProto.INT64, []),
        helper.make_tensor_value_info("go", TensorProto.BOOL, []),
        value("seen"),
    ],
    [helper.make_tensor_value_info("on", TensorProto.BOOL, []), value("then")],
)
ONCE = of(node("Softsign", ["observation"], ["action"]))
FUNCTION = helper.make_function("", "Tanh", ["x"], ["y"], [node("Exp", ["x"], ["y"])], [helper.make_opsetid("", 17)])
SPARSE = helper.make_sparse_tensor(
    helper.make_tensor("w", F, [1], [1.0]), helper.make_tensor("i", TensorProto.INT64, [1], [0]), [10**9]
)
GROWING = [
    node("Unsqueeze", ["observation", "axes"], ["h"]),
    node("Add", ["h", "tall"], ["g"]),
    node("Add", ["g", "wide"], ["action"]),
]


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (
            of(node("Loop", ["n", "go", "observation"], ["action"], body=BODY), n=np.int64(2**62), go=np.True_),
            "operation Loop: its 'body' is of a kind that no policy has",
        ),
        (
            of(node("If", ["go"], ["action"], then_branch=BODY, else_branch=BODY), go=np.True_),
            "operation If: its 'else",
        ),
        (of(node("Scan", ["observation"], ["action"], body=BODY, num_scan_inputs=1)), "operation Scan: its 'body'"),
        (
            of(node("Loop", ["n", "", "observation"], ["action"]), n=np.int64(2**62)),
            "operation 'Loop' is not allowed. Export the network without it; allowed are Abs, ",
        ),
        (of(node("Tile", ["observation", "n"], ["action"]), n=np.array([1, 10**9])), "operation 'Tile' is not allowed"),
        (
            of(node("Expand", ["observation", "n"], ["action"]), n=np.array([10**9, 4])),
            "operation 'Expand' is not allowed",
        ),
        (
            of(node("Tanh", ["observation"], ["action"], domain="com.microsoft")),
            "operation 'com.microsoft.Tanh' is not allowed",
        ),
        (of(node("RandomNormalLike", ["observation"], ["action"])), "operation 'RandomNormalLike' is not allowed"),
        (
            of(node("Shape", ["observation"], ["s"]), node("Reshape", ["observation", "s"], ["action"])),
            "operation 'Shape' is not allowed",
        ),
        (
            of(
                node("ArgMax", ["observation"], ["k"], axis=1),
                node("Concat", ["k", "k", "k", "k"], ["pads"], axis=0),
                node("Pad", ["observation", "pads"], ["action"]),
            ),
            "operation Pad: the size of its result depends on the observation",
        ),
        (of(*[node("Tanh", ["observation"], ["action"])] * (MOST_NODES + 1)), "it has 10001 operations, expected at m"),
        (changed(lambda made: made.functions.append(FUNCTION)), "it holds functions or training, expected a graph"),
        (changed(lambda made: made.training_info.add()), "it holds functions or training, expected a graph alone"),
        (changed(lambda made: made.graph.sparse_initializer.append(SPARSE)), "it holds sparse weights, which no"),
        (
            changed(lambda made: made.graph.value_info.extend([onnx.ValueInfoProto()] * 200_000)),
            "it has more than 1048576 bytes beside its weights, which no policy has",
        ),
        (
            changed(lambda made: made.graph.node[0].attribute.add(name="many", type=7).ints.extend(range(10**6))),
            "it has more than 1048576 bytes beside its weights, which no policy has",
        ),
        (
            changed(lambda made: made.graph.initializer.append(helper.make_tensor("w", F, [-1, -1], [1.0]))),
            r"tensor 'w': expected 1 numbers for shape \(-1, -1\), found 1",
        ),
    ],
)
def test_a_graph_that_no_policy_is_is_refused_before_it_is_loaded(
    data: bytes, text: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delattr(onnxruntime, "InferenceSession")
    with pytest.raises(PolicyError, match=text):
        FrozenPolicy.from_graph(data, BOX, BOX)


def test_two_graphs_as_one_are_refused():
    with pytest.raises(PolicyError, match=r"onnxruntime .* cannot run the policy"):  # protobuf merges them
        FrozenPolicy.from_graph(ONCE * 2, BOX, BOX)


def test_memory_that_no_policy_takes_is_refused():
    shape = {"tall": np.zeros((20_000, 1), "f4"), "wide": np.zeros((1, 20_000), "f4")}
    grown = [
        node("Softsign", ["observation"], ["soft"]),
        node("ConstantOfShape", ["s"], ["huge"]),
        node("ReduceSum", ["huge"], ["sum"], keepdims=0),
        node("Add", ["soft", "sum"], ["action"]),
    ]
    with pytest.raises(PolicyError, match=r"onnxruntime [\d.]+ failed: .*smaller than requested bytes"):
        FrozenPolicy.from_graph(of(*grown, s=np.array([10**6, 10**5])), BOX, BOX)
    with pytest.raises(PolicyError, match=r"onnxruntime [\d.]+ failed: .*smaller than requested bytes"):
        FrozenPolicy.from_graph(of(*GROWING, axes=np.array([2, 3]), **shape), BOX, BOX)


def slow(products: int = 100) -> bytes:
    """Take several seconds: products of matrices of 1000 x 1000 numbers that depend on the observation."""
    names = ["wide", *(f"h{i}" for i in range(products))]
    return of(
        node("Softsign", ["observation"], ["soft"]),
        node("ReduceSum", ["soft"], ["sum"], keepdims=0),
        node("Add", ["w", "sum"], ["wide"]),
        *(node("MatMul", [one, "w"], [other]) for one, other in itertools.pairwise(names)),
        node("ReduceSum", [names[-1]], ["total"], keepdims=0),
        node("Add", ["soft", "total"], ["action"]),
        w=np.zeros((1000, 1000), np.float32),
    )


def test_a_policy_that_takes_too_long_is_stopped():
    session = OnnxSession(slow())
    session.most_seconds = 0.5
    with pytest.raises(PolicyError, match=r"the policy takes more than 0\.5 s for one action"):
        session.run({"observation": np.zeros((1, 4), np.float32)}, ["action"])


def test_a_policy_that_waits_for_a_busy_computer_is_not_stopped(monkeypatch: pytest.MonkeyPatch):
    session = OnnxSession(slow(10))
    session.most_seconds = 0.01
    monkeypatch.setattr(onnx_session, "_PATIENCE", 1e6)
    monkeypatch.setattr(onnx_session.time, "process_time", lambda: 0.0)  # as if others had the CPU
    [action] = session.run({"observation": np.zeros((1, 4), np.float32)}, ["action"])
    assert action.tolist() == [[0.0] * 4]


def test_a_policy_that_takes_long_is_interrupted_by_ctrl_c():
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.5)
    try:
        with pytest.raises(KeyboardInterrupt):
            FrozenPolicy.from_graph(slow(), BOX, BOX)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_more_golden_actions_than_anybody_writes_are_refused():
    policy = FrozenPolicy.from_graph(of(node("Tanh", ["observation"], ["action"])), BOX, BOX)
    arrays = dict.fromkeys(("observation", "action"), np.zeros((2000, 4), np.float32))
    with pytest.raises(PolicyError, match="expected at most 1024 rows, found 2000"):
        policy.worst_difference(arrays)


# The file


WEIGHT = np.eye(4, dtype=np.float32)
NUMBERS = "FLOAT UINT8 INT8 UINT16 INT16 INT32 INT64 BOOL FLOAT16 DOUBLE UINT32 UINT64".split()  # noqa: SIM905


@pytest.mark.parametrize("kind", NUMBERS)
@pytest.mark.parametrize("raw", [True, False])
def test_every_type_of_number_is_accepted_however_it_is_stored(kind: str, raw: bool):
    code = getattr(TensorProto, kind)
    array = np.array([[1, 0], [3, 100]]).astype(helper.tensor_dtype_to_np_dtype(code))
    tensor = numpy_helper.from_array(array, "w")
    if not raw:
        tensor = helper.make_tensor("w", code, array.shape, array.ravel().tolist())
    assert bool(tensor.raw_data) == raw
    require_policy(changed(lambda made: made.graph.initializer.append(tensor)))


def test_large_weights_are_accepted_in_initializers_and_constants():
    large = np.zeros((600, 600), np.float32)
    require_policy(of(node("Constant", [], ["c"], value=numpy_helper.from_array(large)), w=large))


def with_weight(change: Callable[[Any], Any]) -> bytes:
    made = model(node("Gemm", ["observation", "w"], ["action"]), w=WEIGHT)
    change(made.graph.initializer[0])
    data = made.SerializeToString()
    assert isinstance(data, bytes)
    return data


WHOLE = with_weight(lambda weight: None)
IN_ANOTHER_FILE = "tensor 'w': its numbers are in another file; export with everything in one"


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "not an ONNX file, or damaged: it has no graph. Export it again, or copy it again from its source"),
        (b"PK\x03\x04 a zip", "not an ONNX file"),
        (b"\x3f", "not an ONNX file"),
        (b"\x38\x05", "not an ONNX file"),
        (b"\x08" + b"\xff" * 11, "not an ONNX file, or damaged: a number has more than 64 bits"),
        (WHOLE[:-5], "not an ONNX file"),
        (with_weight(lambda weight: setattr(weight, "data_location", TensorProto.EXTERNAL)), IN_ANOTHER_FILE),
        (with_weight(lambda weight: weight.external_data.add(key="location", value="/etc/passwd")), IN_ANOTHER_FILE),
        (
            with_weight(lambda weight: weight.dims.append(2)),
            r"'w': expected 32 numbers for shape \(4, 4, 2\), found 16",
        ),
        (of(w=np.array(["a"], object)), "tensor 'w': type 8 is not supported"),
    ],
)
def test_what_is_not_a_policy_is_refused(data: bytes, text: str):
    with pytest.raises(FormatError, match=text):
        require_policy(data)


@settings(deadline=None)
@given(st.data())
def test_any_damage_is_refused_or_harmless(data: st.DataObject):
    whole = bytearray(WHOLE)
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(FormatError):
        require_policy(bytes(whole[: data.draw(st.integers(0, len(whole)))]))
