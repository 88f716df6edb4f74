"""Run an ONNX graph of dense layers in NumPy: a few microseconds a row, without onnxruntime, its import and its memory.

A `Plan` is the graph made ready for one batch size: every array is allocated, every view taken and everything that does
not depend on the inputs computed. Running it is a list of NumPy calls that write into those arrays, one thread at a
time. An array that cannot be written to is a constant. Most of the file is the table of operations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from bam_train.errors import FormatError
from bam_train.policy.onnx_file import DTYPES, Graph, Node


class UnsupportedGraph(FormatError):  # noqa: N818 - not an error: the graph is for onnxruntime
    """The graph has something else than dense layers; the text says what."""


MOST_WORK = 10**8
"""Numbers that one row may take, and products of numbers: a tenth of a second; a policy of 256 x 256 takes 10^5."""


class MlpRunner:
    """Runs a graph at any batch size; keeps the plans for one row and for the last other number of rows."""

    def __init__(self, graph: Graph) -> None:
        """Prepare the graph for one row.

        Raises:
            UnsupportedGraph: It has other operations than `OPERATIONS`.
        """
        self._graph = graph
        self.single = Plan(graph, 1)
        self._last = self.single

    def run(self, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Compute the outputs.

        Args:
            inputs: Every input by name, (n, ...).

        Returns:
            Every output by name, (n, ...); overwritten by the next run.
        """
        n = len(next(iter(inputs.values())))
        plan = self.single if n == 1 else self._last if self._last.n == n else Plan(self._graph, n)
        if n != 1:
            self._last = plan
        for name, array in inputs.items():
            plan.inputs[name][...] = array
        plan.run()
        return plan.outputs


class Plan:
    """A graph made ready for n rows.

    Attributes:
        n: Rows.
        inputs: The arrays to fill, by name.
        calls: What to call, in order.
        outputs: The arrays that are then filled, by name.
    """

    def __init__(self, graph: Graph, n: int) -> None:
        self.n = n
        self.inputs = {value.name: _input(value.name, value.shape, value.dtype, n) for value in graph.inputs}
        self.calls: list[Callable[[], Any]] = []
        self._left = n * MOST_WORK
        self._arrays: dict[str, np.ndarray] = {**graph.constants, **self.inputs}
        for node in graph.nodes:
            self._add(node)
        try:
            self.outputs = {value.name: self._arrays[value.name] for value in graph.outputs}
        except KeyError as error:
            raise FormatError(f"output {error} is not computed by the graph") from error

    def run(self) -> None:
        """Compute the outputs from what is in the inputs."""
        for call in self.calls:
            call()

    def empty(self, shape: tuple[int, ...], dtype: Any, products: int = 1) -> np.ndarray:
        """Return a new array.

        Args:
            shape: Its shape.
            dtype: Its type.
            products: That each of its numbers takes.

        Raises:
            FormatError: The graph takes more memory or time than a policy does.
        """
        self._left -= math.prod(shape) * products
        if self._left < 0:
            raise FormatError(f"it computes more than {MOST_WORK} numbers for one action, which no policy does")
        return np.empty(shape, dtype)

    def constant(self, name: str) -> np.ndarray:
        """Return an array that must not depend on the inputs."""
        if self._arrays[name].flags.writeable:
            raise UnsupportedGraph(f"{name!r} must be constant")
        return self._arrays[name]

    def elementwise(self, function: np.ufunc, *arrays: np.ndarray) -> np.ndarray:
        """Call a ufunc; the result's type is that of the arrays, or bool of a comparison."""
        shape = np.broadcast_shapes(*(array.shape for array in arrays))
        out = self.empty(shape, bool if function in (np.equal, np.greater) else arrays[0].dtype)
        operands = [_row(array, shape) for array in arrays]
        if any(operand is None for operand in operands):
            self.calls.append(partial(function, *arrays, out=out))
        else:
            self.calls.append(partial(function, *operands, out=out[0]))
        return out

    def copy(self, array: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Copy, and cast if need be, into ``out``."""
        self.calls.append(partial(out.__setitem__, ..., array))
        return out

    def reshape(self, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Return the same memory in another shape, or a copy where strides forbid that."""
        shaped = array.reshape(shape)
        if not np.shares_memory(shaped, array):
            shaped = self.copy(array, self.empty(array.shape, array.dtype)).reshape(shape)
        return shaped

    def _add(self, node: Node) -> None:
        operation = OPERATIONS.get(node.op)
        if operation is None:
            raise UnsupportedGraph(f"operation {node.op}")
        before = len(self.calls)
        try:
            arrays = [self._arrays[name] for name in node.inputs if name]
            results = list(operation(self, node, arrays))
        except (KeyError, IndexError, ValueError, TypeError) as error:
            if isinstance(error, FormatError):
                raise
            raise UnsupportedGraph(f"operation {node.op}: {type(error).__name__}: {error}") from error
        self._arrays.update(zip(node.outputs, results, strict=False))
        if not any(array.flags.writeable for array in arrays):
            for call in self.calls[before:]:
                call()
            del self.calls[before:]
            for result in results:
                result.flags.writeable = False


def _input(name: str, shape: tuple[int | None, ...], dtype: np.dtype[Any], n: int) -> np.ndarray:
    if not shape or None in shape[1:] or shape[0] not in (None, n):
        raise UnsupportedGraph(f"input {name!r} has shape {shape}")
    return np.zeros((n, *(length or 0 for length in shape[1:])), dtype)


def _row(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return the only row of an operand, at its full length: NumPy is twice as fast where it need not broadcast."""
    if len(shape) != 2 or shape[0] != 1:
        return None
    if array.shape == shape:
        return array.reshape(-1) if array.flags.c_contiguous else None
    return None if array.flags.writeable else np.ascontiguousarray(np.broadcast_to(array, shape)[0])


def _number(value: float, like: np.ndarray) -> np.ndarray:
    """Return a constant of the type of another array."""
    number = np.asarray(value, like.dtype)
    number.flags.writeable = False
    return number


# Operations: (plan, node, input arrays) -> output arrays. Arrays are the memory that holds the value at run time.

_Arrays = list[np.ndarray]
_Operation = Callable[[Plan, Node, _Arrays], Iterable[np.ndarray]]


def _ufunc(function: np.ufunc) -> _Operation:
    return lambda plan, node, arrays: [plan.elementwise(function, *arrays)]


def _fold(function: np.ufunc) -> _Operation:
    def operation(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
        result = arrays[0]
        for array in arrays[1:]:
            result = plan.elementwise(function, result, array)
        return [result]

    return operation


def _gemm(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    """A @ B + C, with constant B and C."""
    attributes = node.attributes
    if attributes.get("transA", 0) or {attributes.get("alpha", 1.0), attributes.get("beta", 1.0)} != {1.0}:
        raise UnsupportedGraph("a Gemm that scales or transposes its input")
    weight = plan.constant(node.inputs[1])
    product = _dot(plan, arrays[0], weight.T if attributes.get("transB", 0) else weight)
    return [plan.elementwise(np.add, product, arrays[2]) if len(arrays) > 2 else product]


def _matmul(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    return [_dot(plan, arrays[0], plan.constant(node.inputs[1]))]


def _dot(plan: Plan, x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return x @ weight; one row is a matrix times a vector, which BLAS does faster than a matrix times a matrix."""
    if x.ndim != 2 or weight.ndim != 2:
        raise UnsupportedGraph(f"a product of shapes {x.shape} and {weight.shape}")
    out = plan.empty((len(x), weight.shape[1]), x.dtype, products=len(weight))
    if len(x) == 1:
        plan.calls.append(partial(np.ascontiguousarray(weight.T).dot, x[0], out[0]))
    else:
        plan.calls.append(partial(x.dot, np.ascontiguousarray(weight), out))
    return out


def _sigmoid(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    """(1 + tanh(x / 2)) / 2, which cannot overflow."""
    half = _number(0.5, arrays[0])
    tanh = plan.elementwise(np.tanh, plan.elementwise(np.multiply, arrays[0], half))
    return [plan.elementwise(np.add, plan.elementwise(np.multiply, tanh, half), half)]


def _relu(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    return [plan.elementwise(np.maximum, arrays[0], _number(0, arrays[0]))]


def _elu(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    """max(x, 0) + alpha (exp(min(x, 0)) - 1)."""
    x, zero, alpha = arrays[0], _number(0, arrays[0]), _number(node.attributes.get("alpha", 1.0), arrays[0])
    below = plan.elementwise(np.expm1, plan.elementwise(np.minimum, x, zero))
    above = plan.elementwise(np.maximum, x, zero)
    return [plan.elementwise(np.add, above, plan.elementwise(np.multiply, below, alpha))]


def _leaky_relu(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    alpha = node.attributes.get("alpha", 0.01)
    if not 0 <= alpha <= 1:
        raise UnsupportedGraph(f"LeakyRelu with alpha {alpha}")
    scaled = plan.elementwise(np.multiply, arrays[0], _number(alpha, arrays[0]))
    return [plan.elementwise(np.maximum, arrays[0], scaled)]


def _clip(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    _, low, high = (*node.inputs, "", "")[:3]
    result = arrays[0]
    if low:
        result = plan.elementwise(np.maximum, result, plan.constant(low))
    if high:
        result = plan.elementwise(np.minimum, result, plan.constant(high))
    return [result]


def _cast(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    dtype = np.dtype(DTYPES[node.attributes["to"]])
    return [arrays[0] if dtype == arrays[0].dtype else plan.copy(arrays[0], plan.empty(arrays[0].shape, dtype))]


def _flatten(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    if node.attributes.get("axis", 1) != 1:
        raise UnsupportedGraph("a Flatten of the batch axis")
    return [plan.reshape(arrays[0], (len(arrays[0]), -1))]


def _reshape(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    shape = plan.constant(node.inputs[1]).tolist()
    return [plan.reshape(arrays[0], tuple(length or arrays[0].shape[axis] for axis, length in enumerate(shape)))]


def _unsqueeze(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    return [np.expand_dims(arrays[0], tuple(plan.constant(node.inputs[1]).tolist()))]


def _transpose(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    return [arrays[0].transpose(node.attributes["perm"])]


def _concat(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    axis = node.attributes["axis"]
    plan.empty((sum(array.size for array in arrays),), arrays[0].dtype)
    out = np.concatenate(arrays, axis)
    ends = np.cumsum([array.shape[axis] for array in arrays])[:-1]
    for part, array in zip(np.split(out, ends, axis), arrays, strict=True):
        plan.copy(array, part)
    return [out]


def _split(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    sizes = plan.constant(node.inputs[1]) if len(node.inputs) > 1 else None
    where = len(node.outputs) if sizes is None else np.cumsum(sizes)[:-1]
    return np.split(arrays[0], where, node.attributes.get("axis", 0))


def _gather(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    axis, chosen = node.attributes.get("axis", 0), plan.constant(node.inputs[1])
    plan.empty((arrays[0].size, chosen.size), arrays[0].dtype)
    out = np.take(arrays[0], chosen, axis)  # raises for an index that is not there
    plan.calls.append(partial(arrays[0].take, chosen % arrays[0].shape[axis], axis, out, "clip"))
    return [out]


def _argmax(plan: Plan, node: Node, arrays: _Arrays) -> _Arrays:
    axis = node.attributes.get("axis", 0)
    if node.attributes.get("select_last_index", 0):
        raise UnsupportedGraph("an ArgMax that takes the last of equals")
    out = arrays[0].argmax(axis)
    plan.calls.append(partial(arrays[0].argmax, axis, out))
    return [np.expand_dims(out, axis) if node.attributes.get("keepdims", 1) else out]


OPERATIONS: dict[str, _Operation] = {
    "Add": _ufunc(np.add),
    "ArgMax": _argmax,
    "Cast": _cast,
    "Clip": _clip,
    "Concat": _concat,
    "Constant": lambda plan, node, arrays: [node.attributes["value"]],
    "Div": _ufunc(np.divide),
    "Elu": _elu,
    "Equal": _ufunc(np.equal),
    "Flatten": _flatten,
    "Gather": _gather,
    "Gemm": _gemm,
    "Greater": _ufunc(np.greater),
    "Identity": lambda plan, node, arrays: arrays,
    "LeakyRelu": _leaky_relu,
    "MatMul": _matmul,
    "Max": _fold(np.maximum),
    "Min": _fold(np.minimum),
    "Mul": _ufunc(np.multiply),
    "Relu": _relu,
    "Reshape": _reshape,
    "Sigmoid": _sigmoid,
    "Split": _split,
    "Sub": _ufunc(np.subtract),
    "Tanh": _ufunc(np.tanh),
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
}

OF_ONNXRUNTIME = frozenset(
    """Abs AveragePool BatchNormalization Celu ConstantOfShape Conv Cos Erf Exp GlobalAveragePool HardSigmoid HardSwish
    LayerNormalization Less Log LogSoftmax MaxPool Mish Neg Or Pad Pow ReduceMean ReduceSum Selu Sin Slice Softmax
    Softplus Softsign Sqrt Squeeze Where""".split()  # noqa: SIM905 - a list of literals has one a line
)
"""Further operations that exported policies have; none repeats others, chooses among graphs or opens a file."""
_SIZES = {"ConstantOfShape": 0, "Pad": 1, "Reshape": 1, "Slice": 1}
"""Operations of which an input, this one or a later one, says how large the result is."""


def require_known(graph: Graph) -> None:
    """Refuse operations that no exported policy has, and results whose size depends on what is observed.

    Raises:
        FormatError: Names the operation.
    """
    varying = {value.name for value in graph.inputs}
    for node in graph.nodes:
        if node.op not in OPERATIONS and node.op not in OF_ONNXRUNTIME:
            raise FormatError(f"operation {node.op!r} is none of a policy's")
        if varying.intersection(node.inputs[_SIZES.get(node.op, len(node.inputs)) :]):
            raise FormatError(f"operation {node.op}: the size of its result depends on the observation")
        if varying.intersection(node.inputs):
            varying.update(node.outputs)
