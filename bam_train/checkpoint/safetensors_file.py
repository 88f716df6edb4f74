"""Arrays (`dump`, `parse`) and nested states (`pack`, `unpack`) in formats that cannot execute code.

A state is a JSON skeleton and a safetensors file with its arrays. Packing is lossless: ints of any size, floats to the
last bit, arrays and torch tensors with dtype and shape, tuples, and mappings with keys other than text.
"""

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from bam_train.errors import FormatError

MOST_HEADER = 2**23
"""Maximum bytes of a file's JSON header, which takes many times as much memory once it is parsed."""
_MARKS = {"$array", "$scalar", "$tensor", "$tuple", "$items", "$float"}


def dump(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Write arrays of bool, (u)int8-64 and float16-64 as one safetensors file; raises FormatError for others."""
    for name, array in arrays.items():
        if np.asarray(array).dtype.kind not in "biuf":
            expected = "expected bool, an integer or a float type"
            raise FormatError(f"array {name!r}: dtype {np.asarray(array).dtype} cannot be stored; {expected}")
    data: bytes = safetensors.numpy.save({name: np.asarray(array, order="C") for name, array in arrays.items()})
    return data


def parse(data: bytes) -> dict[str, np.ndarray]:
    """Read a safetensors file; every array is a writable copy. Raises FormatError if it is damaged."""
    size = int.from_bytes(data[:8], "little")
    if len(data) < 8 or size > min(MOST_HEADER, len(data) - 8):
        raise FormatError(f"not a safetensors file: {len(data)} bytes, too short for its header")
    try:
        return {name: np.array(array) for name, array in safetensors.numpy.load(data).items()}
    except KeyError as error:
        raise FormatError(f"not a safetensors file of numbers: dtype {error} is not known") from error
    except (SafetensorError, ValueError, OverflowError) as error:
        raise FormatError(f"not a safetensors file: {error}") from error


def pack(name: str, tree: Any) -> dict[str, bytes]:
    """Turn a tree into the members ``name.json``, its skeleton, and ``name.safetensors``.

    It may hold None, bool, int, float, str, NumPy scalars and arrays, torch tensors; lists, tuples and mappings of
    these. Any other value raises a FormatError that names its place.
    """
    arrays: dict[str, np.ndarray] = {}

    def keep(mark: str, array: np.ndarray, path: str) -> dict[str, str]:
        name = path or "/"
        while name in arrays:  # "a/b", and "b" in "a"
            name += "'"
        arrays[name] = array
        return {mark: name}

    def put(value: Any, path: str) -> Any:
        if value is None or isinstance(value, (bool, int, str)):
            return value
        if isinstance(value, np.generic):
            return keep("$scalar", np.asarray(value), path)
        if isinstance(value, float):
            return value if math.isfinite(value) else {"$float": repr(value)}
        if isinstance(value, np.ndarray):
            return keep("$array", value, path)
        if hasattr(value, "detach"):
            return keep("$tensor", value.detach().cpu().numpy().copy(), path)
        if isinstance(value, (tuple, list)):
            items = [put(item, f"{path}/{i}") for i, item in enumerate(value)]
            return items if isinstance(value, list) else {"$tuple": items}
        if not isinstance(value, Mapping):
            expected = "expected numbers, text, arrays or nests of them"
            raise FormatError(f"{path or '/'}: {expected}, found a {type(value).__name__}")
        if all(isinstance(key, str) for key in value) and not _MARKS & value.keys():
            return {key: put(item, f"{path}/{key}") for key, item in value.items()}
        return {"$items": [[put(key, path), put(item, f"{path}/{key}")] for key, item in value.items()]}

    skeleton = put(tree, "")
    return {f"{name}.json": json.dumps(skeleton, allow_nan=False).encode(), f"{name}.safetensors": dump(arrays)}


def unpack(skeleton: bytes, arrays: bytes, to_tensor: Callable[[np.ndarray], Any] | None = None) -> Any:
    """Restore the tree that `pack` wrote; `to_tensor` makes its tensors, which are arrays without it.

    Raises FormatError if the two members do not belong together, or do not have the form that `pack` writes.
    """

    def get(value: Any) -> Any:
        if isinstance(value, list):
            return [get(item) for item in value]
        if not isinstance(value, dict):
            return value
        mark = next(iter(value)) if len(value) == 1 else None
        if mark not in _MARKS:
            return {key: get(item) for key, item in value.items()}
        inside = value[mark]
        if mark == "$items":
            return {get(key): get(item) for key, item in inside}
        if mark == "$tuple":
            return tuple(get(item) for item in inside)
        if mark == "$float":
            return float(inside)
        array = stored[inside]
        if mark == "$tensor" and to_tensor is not None:
            return to_tensor(array)
        return array[()] if mark == "$scalar" else array

    try:
        stored = parse(arrays)
        return get(json.loads(skeleton))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise FormatError(f"a saved state cannot be read: {type(error).__name__}: {error}") from error
