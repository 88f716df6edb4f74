"""Read an ONNX file with the standard library and NumPy: the parts of its protobuf that say what is computed.

Field numbers are those of https://github.com/onnx/onnx/blob/main/onnx/onnx.proto.
"""

from __future__ import annotations

import math
import struct
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bam_train.errors import FormatError

DTYPES: dict[int, np.dtype[Any]] = {
    1: np.dtype("<f4"),
    2: np.dtype("u1"),
    3: np.dtype("i1"),
    4: np.dtype("<u2"),
    5: np.dtype("<i2"),
    6: np.dtype("<i4"),
    7: np.dtype("<i8"),
    9: np.dtype("?"),
    10: np.dtype("<f2"),
    11: np.dtype("<f8"),
    12: np.dtype("<u4"),
    13: np.dtype("<u8"),
}
# TensorProto: where a tensor's numbers are if they are not raw bytes, and how they are packed there.
_TYPED_DATA: dict[int, np.dtype[Any]] = {4: np.dtype("<f4"), 10: np.dtype("<f8")}
_VARINT_DATA = (5, 7, 11)


@dataclass(frozen=True)
class Node:
    """One operation."""

    op: str
    """Its type, such as Gemm."""
    inputs: tuple[str, ...]
    """Names; an empty one is an optional input that is not given."""
    outputs: tuple[str, ...]
    """Names."""
    attributes: dict[str, Any]
    """float, int, bytes, ndarray, or lists of float or int."""


@dataclass(frozen=True)
class Value:
    """An input or output of the graph."""

    name: str
    """Its name."""
    dtype: np.dtype[Any]
    """Its type."""
    shape: tuple[int | None, ...]
    """None where the length is free, as the batch axis is."""


@dataclass(frozen=True)
class Graph:
    """What the file computes."""

    nodes: tuple[Node, ...]
    """In an order in which they can run."""
    constants: dict[str, np.ndarray]
    """Weights."""
    inputs: tuple[Value, ...]
    """Without the weights."""
    outputs: tuple[Value, ...]
    """Results."""


MOST_NODES = 1000
"""Operations of a graph at most; the largest that is exported has about a hundred."""
_MOST_FIELDS = 100_000
"""Fields and whole numbers of a file at most, so that reading it takes a tenth of a second; weights are one field."""


def parse(data: bytes) -> Graph:
    """Read an ONNX file.

    Raises:
        FormatError: Not ONNX, damaged, of too many parts, or something in it is more than a graph of operations.
    """
    try:
        return _Reader().model(memoryview(data))
    except (IndexError, KeyError, TypeError, ValueError, struct.error) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"not an ONNX file, or damaged: {type(error).__name__}: {error}") from error


_Message = dict[int, list[Any]]


class _Reader:
    """Reads one file, up to so many fields.

    What is read here is what onnxruntime reads: a part that would be merged with another, or that only onnxruntime
    knows (functions, sparse weights, graphs inside nodes), is refused.
    """

    def __init__(self) -> None:
        self._left = _MOST_FIELDS

    def model(self, data: memoryview) -> Graph:
        """The graph of a ModelProto."""
        fields = self._message(data)
        if fields[20] or fields[25]:
            raise FormatError("it holds functions or training, expected a graph alone")
        return self._graph(_one(fields, 7))

    def _count(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise FormatError(f"it has more than {_MOST_FIELDS} fields, which no policy has")

    def _message(self, data: memoryview) -> _Message:
        """Split a protobuf message into its fields: ints for varints, memoryviews for everything else."""
        if not isinstance(data, memoryview):
            raise FormatError("not an ONNX file: a number where a message should be")
        fields: _Message = defaultdict(list)
        at = 0
        while at < len(data):
            self._count()
            key, at = _varint(data, at)
            value: Any
            if key & 7 == 0:
                value, at = _varint(data, at)
            else:
                size, at = _size(key & 7, data, at)
                value = data[at : at + size]
                at += size
            fields[key >> 3].append(value)
        if at != len(data):
            raise FormatError("not an ONNX file: it ends in the middle of a message")
        return fields

    def varints(self, values: Iterable[Any]) -> list[int]:
        """Read repeated whole numbers, which may be packed into one field or not."""
        found: list[int] = []
        for value in values:
            if isinstance(value, int):
                found.append(_signed(value))
                continue
            at = 0
            while at < len(value):
                self._count()
                number, at = _varint(value, at)
                found.append(_signed(number))
        return found

    def _graph(self, data: memoryview) -> Graph:
        fields = self._message(data)
        if len(fields[1]) > MOST_NODES:
            raise FormatError(f"it has {len(fields[1])} operations, expected at most {MOST_NODES}")
        if fields[15]:
            raise FormatError("it holds sparse weights, which no policy has")
        constants = dict(self.tensor(tensor) for tensor in fields[5])
        inputs = tuple(self._value(value) for value in fields[11])
        return Graph(
            nodes=tuple(self._node(node) for node in fields[1]),
            constants=constants,
            inputs=tuple(value for value in inputs if value.name not in constants),
            outputs=tuple(self._value(value) for value in fields[12]),
        )

    def _node(self, data: memoryview) -> Node:
        fields = self._message(data)
        domain = _text(_one(fields, 7)) if fields[7] else ""
        op = _text(_one(fields, 4))
        return Node(
            op=f"{domain}.{op}" if domain else op,
            inputs=_texts(fields[1]),
            outputs=_texts(fields[2]),
            attributes=dict(self._attribute(op, attribute) for attribute in fields[5]),
        )

    def _attribute(self, op: str, data: memoryview) -> tuple[str, Any]:
        fields = self._message(data)
        name, kind = _text(_one(fields, 1)), _one(fields, 20)
        if kind not in _ATTRIBUTES or (fields.keys() & _OF_GRAPHS):
            raise FormatError(f"operation {op}: its {name!r} is of a kind that no policy has")
        return name, _ATTRIBUTES[kind](self, fields)

    def _value(self, data: memoryview) -> Value:
        fields = self._message(data)
        name = _text(_one(fields, 1))
        tensor = self._message(_one(self._message(_one(fields, 2)), 1))
        dims = self._message(_one(tensor, 2))[1] if tensor[2] else []
        shape = tuple(self._message(dim).get(1, [None])[-1] for dim in dims)
        return Value(name, _dtype(name, _one(tensor, 1)), shape)

    def tensor(self, data: memoryview) -> tuple[str, np.ndarray]:
        """Name and numbers of a TensorProto."""
        fields = self._message(data)
        name = _text(_one(fields, 8)) if fields[8] else ""
        if fields[13] or (fields[14] and fields[14] != [0]):
            raise FormatError(f"tensor {name!r}: its numbers are in another file; export with everything in one")
        dtype, shape = _dtype(name, _one(fields, 2)), tuple(self.varints(fields[1]))
        numbers = self._numbers(fields, dtype)
        if numbers.size != math.prod(shape) or min(shape, default=0) < 0:
            raise FormatError(
                f"tensor {name!r}: expected {math.prod(shape)} numbers for shape {shape}, found {numbers.size}"
            )
        numbers = numbers.reshape(shape)
        numbers.flags.writeable = False
        return name, numbers

    def _numbers(self, fields: _Message, dtype: np.dtype[Any]) -> np.ndarray:
        if fields[9]:
            return np.frombuffer(_one(fields, 9), dtype)
        for number, stored in _TYPED_DATA.items():
            if fields[number]:
                return np.frombuffer(b"".join(fields[number]), stored).astype(dtype)
        varints = [value for number in _VARINT_DATA for value in self.varints(fields[number])]
        if dtype == np.float16:  # kept as its bits
            return np.array(varints, np.uint16).view(dtype)
        return np.array(varints).astype(dtype)


_OF_GRAPHS = {6, 10, 11, 22, 23}
"""AttributeProto: graphs, tensors and sparse tensors."""
_ATTRIBUTES: dict[int, Callable[[_Reader, _Message], Any]] = {
    1: lambda reader, fields: struct.unpack("<f", _one(fields, 2))[0],
    2: lambda reader, fields: _signed(_one(fields, 3)) if fields[3] else 0,
    3: lambda reader, fields: bytes(_one(fields, 4)),
    4: lambda reader, fields: reader.tensor(_one(fields, 5))[1],
    6: lambda reader, fields: [number for part in fields[7] for number in np.frombuffer(part, "<f4").tolist()],
    7: lambda reader, fields: reader.varints(fields[8]),
}


def _size(wire: int, data: memoryview, at: int) -> tuple[int, int]:
    if wire == 2:
        return _varint(data, at)
    if wire not in (1, 5):
        raise FormatError(f"not an ONNX file: wire type {wire}")
    return (8 if wire == 1 else 4), at


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """Read a number of 7 bits a byte, the lowest first."""
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
        if shift > 63:
            raise FormatError("not an ONNX file: a number of more than 64 bits")


def _signed(value: int) -> int:
    return value - 2**64 if value >= 2**63 else value


def _one(fields: _Message, number: int) -> Any:
    """A field that is there once: protobuf merges those that come twice."""
    if len(fields[number]) != 1:
        raise FormatError(f"not an ONNX file: field {number} is {'there twice' if fields[number] else 'missing'}")
    return fields[number][0]


def _text(value: memoryview) -> str:
    return bytes(value).decode()


def _texts(values: Iterable[memoryview]) -> tuple[str, ...]:
    return tuple(_text(value) for value in values)


def _dtype(name: str, code: int) -> np.dtype[Any]:
    if code not in DTYPES:
        raise FormatError(f"tensor {name!r}: type {code} is not supported; expected one of {list(DTYPES)}")
    return DTYPES[code]
