"""The network of a foreign policy with nodes around it, so that it takes an observation and gives actions of ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_train.compat.foreign_policy import Affine, ForeignPolicy, Meaning, Port
from bam_train.errors import FormatError, PolicyError
from bam_train.policy.onnx_graph import damaged, require_policy

Array = NDArray[Any]
_OWN = "theirs/"
"""Before every name of the network, so that none is the name of an input or output of ours."""


def mapped_graph(
    policy: ForeignPolicy, taken: Sequence[tuple[str, spaces.Box, Meaning]], given: tuple[spaces.Box, Meaning]
) -> bytes:
    """The ONNX file of the whole: observations and actions as the environment has them, (1, ...) each.

    Args:
        policy: The network.
        taken: For each of its inputs the name of ours, such as observation.robot, its space, and what it means.
        given: The space of the action, and what the output means.

    Raises:
        PolicyError: It is no graph of a policy, or lacks an input or the output.
    """
    from google.protobuf.message import DecodeError
    from onnx import TensorProto, compose, helper, load_model_from_string

    try:
        require_policy(policy.network)
        model = load_model_from_string(policy.network)
    except (FormatError, DecodeError) as error:
        raise PolicyError(f"{policy.place}: its network: {error}") from error
    graph = model.graph
    fixed = {tensor.name for tensor in graph.initializer}
    found = [one.name for one in graph.input if one.name not in fixed]
    if sorted(found) != sorted(port.name for port in policy.inputs):
        told = sorted(port.name for port in policy.inputs)
        raise PolicyError(f"{policy.place}: the graph's inputs are {sorted(found)}, and {told} are described")
    if policy.output.name not in [one.name for one in graph.output]:
        outputs = [one.name for one in graph.output]
        raise PolicyError(f"{policy.place}: the graph's outputs are {outputs}, and {policy.output.name} is described")
    [n] = {one.type.tensor_type.shape.dim[0].dim_value or "n" for one in graph.input if one.name in found} or {"n"}
    graph = compose.add_prefix(model, _OWN).graph
    around = _Nodes(helper)
    infos: dict[str, Any] = {}
    for port, (name, space, means) in zip(policy.inputs, taken, strict=True):
        past = [policy.chunk.history] if policy.chunk.history > 1 else []
        kind = helper.np_dtype_to_tensor_dtype(space.dtype)
        infos[name] = helper.make_tensor_value_info(name, kind, [n, *past, *space.shape])
        around.into(name, _OWN + port.name, port, means, len(past))
    nodes = [*around.nodes, *graph.node]
    around.nodes = []
    box, means = given
    around.out(_OWN + policy.output.name, policy.output, means, (policy.chunk.size, *(box.shape or ())))
    shape = [n, policy.chunk.size, *(box.shape or ())]
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, shape)]
    weights = [*graph.initializer, *around.weights]
    whole = helper.make_graph([*nodes, *around.nodes], "policy", list(infos.values()), outputs, weights)
    opsets = list(model.opset_import)
    data: bytes = helper.make_model(
        whole, opset_imports=opsets, ir_version=min(model.ir_version, 9)
    ).SerializeToString()
    return data


def with_known_sizes(policy: ForeignPolicy) -> ForeignPolicy:
    """The policy with sizes that do not depend on the observation as constants, where its graph computes them.

    Raises:
        PolicyError: It is not an ONNX file.
    """
    from google.protobuf.message import DecodeError
    from onnx import load_model_from_string, numpy_helper, shape_inference

    try:
        model = load_model_from_string(policy.network)
        inferred = shape_inference.infer_shapes(model, data_prop=True).graph
    except (DecodeError, shape_inference.InferenceError) as error:
        raise PolicyError(f"{policy.place}: its network: {damaged(error)}") from error
    values = [*inferred.value_info, *inferred.input, *inferred.output]
    sizes = {one.name: [side.dim_value for side in one.type.tensor_type.shape.dim] for one in values}
    for node in list(model.graph.node):
        size = sizes.get(node.input[0], [0]) if node.op_type == "Shape" and not node.attribute else [0]
        if all(size):
            model.graph.initializer.append(numpy_helper.from_array(np.array(size, np.int64), node.output[0]))
            model.graph.node.remove(node)
    return replace(policy, network=model.SerializeToString())


class _Nodes:
    """Nodes and weights that are added to a graph."""

    def __init__(self, helper: Any) -> None:
        self.nodes: list[Any] = []
        self.weights: list[Any] = []
        self._helper = helper

    def into(self, name: str, target: str, port: Port, means: Meaning, past: int) -> None:
        """From our array `name` to the input `target` of the network."""
        if port.is_image:
            axes = [*range(1 + past), *(1 + past + axis for axis in (2, 0, 1))]
            pixels = self._add("Transpose", [self._cast(name, 1)], perm=axes)
            self._affine(pixels, _by_channel(port), np.float32, target)
            return
        ours = self._add("Gather", [name, self._constant(means.order)], axis=-1)
        self._cast(self._affine(self._cast(ours, 11), port.data.inverse.after(means.si.inverse), np.float64), 1, target)

    def out(self, name: str, port: Port, means: Meaning, shape: tuple[int, ...]) -> None:
        """From the output `name` of the network to our action."""
        theirs = self._affine(self._cast(name, 11), means.si.after(port.data), np.float64)
        ours = self._add("Gather", [theirs, self._constant(np.argsort(means.order))], axis=-1)
        self._add("Reshape", [self._cast(ours, 1), self._constant(np.array([-1, *shape]))], "action")

    def _affine(self, name: str, by: Affine, dtype: Any, target: str = "") -> str:
        scaled = self._add("Mul", [name, self._constant(np.asarray(by.scale, dtype))])
        return self._add("Add", [scaled, self._constant(np.asarray(by.offset, dtype))], target)

    def _cast(self, name: str, to: int, target: str = "") -> str:
        return self._add("Cast", [name], target, to=to)

    def _constant(self, array: Array) -> str:
        from onnx import numpy_helper

        name = f"around/weight{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def _add(self, kind: str, inputs: Sequence[str], target: str = "", **attributes: Any) -> str:
        target = target or f"around/{len(self.nodes)}{inputs[0]}"
        self.nodes.append(self._helper.make_node(kind, list(inputs), [target], **attributes))
        return target


def _by_channel(port: Port) -> Affine:
    """From the pixels of an image, channels first, to what the network takes."""
    norm = port.data.inverse
    return Affine(norm.scale.reshape(-1, 1, 1), norm.offset.reshape(-1, 1, 1))


def as_theirs(ports: Sequence[Port], taken: Mapping[str, tuple[Array, Meaning]]) -> dict[str, Array]:
    """Arrays of ours, by names of inputs, as the network takes them: what the nodes compute, in NumPy."""
    inputs = {}
    for port in ports:
        array, means = taken[port.name]
        if port.is_image:
            pixels = np.moveaxis(array.astype(np.float64), -1, -3)
            inputs[port.name] = _by_channel(port)(pixels).astype(np.float32)
        else:
            inputs[port.name] = port.data.inverse(means.si.inverse(array[..., means.order])).astype(np.float32)
    return inputs


def as_ours(policy: ForeignPolicy, output: Array, means: Meaning, shape: tuple[int, ...]) -> Array:
    """What the network gives as actions of ours, float32."""
    theirs = means.si(policy.output.data(output))
    return theirs[..., np.argsort(means.order)].reshape(-1, *shape).astype(np.float32)
