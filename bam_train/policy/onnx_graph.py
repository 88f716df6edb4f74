"""Checks of an ONNX file before onnxruntime reads it: the file may come from an untrusted source.

A policy is one graph of known operations with its weights inside. Functions, training graphs, graphs inside nodes,
sparse weights, weights in other files and results whose size depends on the observation are refused. Field numbers are
those of https://github.com/onnx/onnx/blob/main/onnx/onnx.proto; protobuf reads the few fields that are needed.
"""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from bam_train.errors import FormatError

MOST_NODES = 10_000
"""Maximum number of operations of a graph; most policies have up to about a hundred, and LeRobot's ACT has some for
each 32 x 32 pixels of an image: 3,000 for 640 x 480."""
MOST_STRUCTURE = 2**20
"""Maximum bytes of a file besides weights, with 16 more for each field: protobuf takes many times as much memory."""

OPERATIONS = frozenset(
    """Abs Add ArgMax AveragePool BatchNormalization Cast Celu Clip Concat Constant ConstantOfShape Conv ConvTranspose
    Cos CumSum Div Elu Equal Erf Exp Flatten Gather Gemm GlobalAveragePool Greater HardSigmoid HardSwish Identity
    InstanceNormalization LayerNormalization LeakyRelu Less Log LogSoftmax MatMul Max MaxPool Min Mish Mul Neg Or Pad
    Pow ReduceMean ReduceSum Relu Reshape Selu Sigmoid Sin Slice Softmax Softplus Softsign Split Sqrt Squeeze Sub Tanh
    Transpose Unsqueeze Where""".split()  # noqa: SIM905 - a list of literals has one a line
)
"""Operations of exported policies; none loops, branches or opens a file."""
_SIZES = {"ConstantOfShape": 0, "Pad": 1, "Reshape": 1, "Slice": 1}
"""Operations whose result size depends on inputs, from this index on."""

_ITEM_SIZE = {1: 4, 2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 8, 9: 1, 10: 2, 11: 8, 12: 4, 13: 8}
"""Bytes of each TensorProto.DataType of numbers."""
_ATTRIBUTE_TYPES = frozenset({1, 2, 3, 4, 6, 7})
"""AttributeProto.AttributeType: float, int, string, tensor, floats, ints."""

_FIELDS: dict[str, str] = {
    "Model": "graph=7:Graph training_info=20:bytes* functions=25:bytes*",
    "Graph": "node=1:Node* initializer=5:Tensor* input=11:Value* sparse_initializer=15:bytes*",
    "Node": "input=1:string* output=2:string* op_type=4:string attribute=5:Attribute* domain=7:string",
    "Attribute": "name=1:string t=5:Tensor type=20:int32 g=6:bytes* tensors=10:bytes* graphs=11:bytes*"
    " sparse_tensor=22:bytes* sparse_tensors=23:bytes*",
    "Tensor": "dims=1:int64* data_type=2:int32 float_data=4:float* int32_data=5:int32* int64_data=7:int64*"
    " name=8:string raw_data=9:bytes double_data=10:double* uint64_data=11:uint64* external_data=13:bytes*"
    " data_location=14:int32",
    "Value": "name=1:string",
}
"""Messages of ONNX, as far as they are read: ``name=number:type``, ``*`` for a repeated field."""

_TO_WEIGHTS: dict[int, Any] = {7: {1: {5: {5: {9: {}}}}, 5: {9: {}}}}
"""Field numbers from a model to the raw bytes of its tensors: graph.node.attribute.t.raw_data, graph.initializer."""


def require_policy(data: bytes) -> None:
    """Raise FormatError for an ONNX file that is damaged, too large, or holds more than a policy."""
    try:
        _require_small(memoryview(data), _TO_WEIGHTS, MOST_STRUCTURE)
        model = _MODEL.FromString(data)
        if model.training_info or model.functions:
            raise FormatError("it holds functions or training, expected a graph alone")
        if not model.HasField("graph"):
            raise damaged("it has no graph")
        _require_graph(model.graph)
    except (DecodeError, IndexError, UnicodeDecodeError) as error:
        raise damaged(error) from error


def damaged(why: object) -> FormatError:
    """The error for a file that is no ONNX file, or not whole."""
    return FormatError(f"not an ONNX file, or damaged: {why}. Export it again, or copy it again from its source")


def _require_graph(graph: Any) -> None:
    if len(graph.node) > MOST_NODES:
        raise FormatError(f"it has {len(graph.node)} operations, expected at most {MOST_NODES}")
    if graph.sparse_initializer:
        raise FormatError("it holds sparse weights, which no policy has")
    for tensor in graph.initializer:
        _require_tensor(tensor)
    varying = {value.name for value in graph.input} - {tensor.name for tensor in graph.initializer}
    for node in graph.node:
        _require_node(node, varying)
        if varying.intersection(node.input):
            varying.update(node.output)


def _require_node(node: Any, varying: set[str]) -> None:
    """Refuse an unknown operation, and one whose result size depends on `varying` inputs."""
    op = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
    for attribute in node.attribute:
        inner = [attribute.g, attribute.tensors, attribute.graphs, attribute.sparse_tensor, attribute.sparse_tensors]
        if attribute.type not in _ATTRIBUTE_TYPES or any(inner):
            raise FormatError(f"operation {op}: its {attribute.name!r} is of a kind that no policy has")
        if attribute.HasField("t"):
            _require_tensor(attribute.t)
    if op not in OPERATIONS:
        allowed = ", ".join(sorted(OPERATIONS))
        raise FormatError(f"operation {op!r} is not allowed. Export the network without it; allowed are {allowed}")
    if varying.intersection(node.input[_SIZES.get(op, len(node.input)) :]):
        raise FormatError(f"operation {op}: the size of its result depends on the observation")


def _require_tensor(tensor: Any) -> None:
    """Refuse a tensor whose data are in another file, or do not match its shape."""
    name, shape = tensor.name, tuple(tensor.dims)
    if tensor.external_data or tensor.data_location:
        raise FormatError(f"tensor {name!r}: its numbers are in another file; export with everything in one")
    if tensor.data_type not in _ITEM_SIZE:
        raise FormatError(f"tensor {name!r}: type {tensor.data_type} is not supported; expected numbers")
    typed = tensor.float_data, tensor.int32_data, tensor.int64_data, tensor.double_data, tensor.uint64_data
    found = len(tensor.raw_data) / _ITEM_SIZE[tensor.data_type] if tensor.raw_data else sum(map(len, typed))
    if found != math.prod(shape) or min(shape, default=0) < 0:
        raise FormatError(f"tensor {name!r}: expected {math.prod(shape)} numbers for shape {shape}, found {found:g}")


def _require_small(data: memoryview, to_weights: Mapping[int, Any], left: int) -> int:
    """Return how many of `left` bytes remain after the parts of a message that are not weights."""
    for number, value in _split(data):
        inside = to_weights.get(number)
        left -= 16 if inside is not None else 16 + len(value)
        if inside:
            left = _require_small(value, inside, left)
        if left < 0:
            raise FormatError(f"it has more than {MOST_STRUCTURE} bytes beside its weights, which no policy has")
    return left


def _split(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield the number and the bytes of each field of a protobuf message, without parsing the content."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        start = at
        if key & 7 == 0:
            at = _varint(data, at)[1]
        elif key & 7 == 2:
            size, start = _varint(data, at)
            at = start + size
        else:
            at += {1: 8, 5: 4}.get(key & 7, len(data))
        if at > len(data):
            raise damaged("it ends in the middle of a message")
        yield key >> 3, data[start:at]


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """Read a number of 7 bits a byte, the lowest first; return its value and its end."""
    value = 0
    for shift in range(0, 70, 7):
        value |= (data[at + shift // 7] & 0x7F) << shift
        if data[at + shift // 7] < 0x80:
            return value, at + shift // 7 + 1
    raise damaged("a number has more than 64 bits")


def _model_class() -> Any:
    """Make the class of a ModelProto with `_FIELDS`."""
    file = descriptor_pb2.FileDescriptorProto(name="bam_onnx.proto", package="bam_onnx", syntax="proto2")
    for message, fields in _FIELDS.items():
        described = file.message_type.add(name=message)
        for name, number, kind, repeated in re.findall(r"(\w+)=(\d+):(\w+)(\*?)", fields):
            field = described.field.add(name=name, number=int(number), label=3 if repeated else 1)
            if kind in _FIELDS:
                field.type, field.type_name = field.TYPE_MESSAGE, f".bam_onnx.{kind}"
            else:
                field.type = field.Type.Value(f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    model = pool.FindMessageTypeByName("bam_onnx.Model")
    if not hasattr(message_factory, "GetMessageClass"):  # protobuf 3.20, which robo-gym needs
        return message_factory.MessageFactory(pool).GetPrototype(model)
    return message_factory.GetMessageClass(model)


_MODEL = _model_class()
