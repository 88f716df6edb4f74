"""Any nested state as two files without code in them: a JSON skeleton and the arrays it names, as safetensors.

Exact both ways: ints of any size, floats to the last bit (NaN and infinities too), arrays and torch tensors with dtype
and shape, tuples, and mappings with keys other than text. Nothing is ever unpickled.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bam_train.checkpoint.safetensors_file import dump, parse
from bam_train.errors import FormatError

_MARKS = {"$array", "$scalar", "$tensor", "$tuple", "$items", "$float"}


def pack(tree: Any) -> tuple[bytes, bytes]:
    """Turn a tree into (JSON skeleton, safetensors).

    Args:
        tree: None, bool, int, float, str, NumPy scalars and arrays, torch tensors; lists, tuples, mappings of these.

    Raises:
        FormatError: Something else is in it; names where.
    """
    arrays: dict[str, np.ndarray] = {}
    skeleton = _pack(tree, "", arrays)
    return json.dumps(skeleton, allow_nan=False).encode(), dump(arrays)


def unpack(skeleton: bytes, arrays: bytes, to_tensor: Callable[[np.ndarray], Any] | None = None) -> Any:
    """Turn what `pack` wrote into the tree again.

    Args:
        skeleton: The JSON.
        arrays: The safetensors.
        to_tensor: Makes a torch tensor of an array; tensors stay arrays without it.

    Raises:
        FormatError: The two do not belong together, or are not as `pack` writes them.
    """
    try:
        return _unpack(json.loads(skeleton), parse(arrays), to_tensor or (lambda array: array))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise FormatError(f"a saved state cannot be read: {type(error).__name__}: {error}") from error


def _pack(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, np.generic):
        return _keep("$scalar", np.asarray(value), path, arrays)
    if isinstance(value, float):
        return value if math.isfinite(value) else {"$float": repr(value)}
    if isinstance(value, np.ndarray):
        return _keep("$array", value, path, arrays)
    if hasattr(value, "detach"):
        return _keep("$tensor", value.detach().cpu().numpy().copy(), path, arrays)
    if isinstance(value, tuple):
        return {"$tuple": [_pack(item, f"{path}/{i}", arrays) for i, item in enumerate(value)]}
    if isinstance(value, list):
        return [_pack(item, f"{path}/{i}", arrays) for i, item in enumerate(value)]
    if isinstance(value, Mapping):
        return _pack_mapping(value, path, arrays)
    raise FormatError(f"{path or '/'}: expected numbers, text, arrays or nests of them, found a {type(value).__name__}")


def _pack_mapping(value: Mapping[Any, Any], path: str, arrays: dict[str, np.ndarray]) -> Any:
    if all(isinstance(key, str) for key in value) and not _MARKS & value.keys():
        return {key: _pack(item, f"{path}/{key}", arrays) for key, item in value.items()}
    return {"$items": [[_pack(key, path, arrays), _pack(item, f"{path}/{key}", arrays)] for key, item in value.items()]}


def _keep(mark: str, array: np.ndarray, path: str, arrays: dict[str, np.ndarray]) -> dict[str, str]:
    name = path or "/"
    if name in arrays:
        raise FormatError(f"{name}: two entries of a saved state have this name")
    arrays[name] = array
    return {mark: name}


def _unpack(value: Any, arrays: Mapping[str, np.ndarray], to_tensor: Callable[[np.ndarray], Any]) -> Any:
    if isinstance(value, list):
        return [_unpack(item, arrays, to_tensor) for item in value]
    if not isinstance(value, dict):
        return value
    mark = next(iter(value)) if len(value) == 1 else None
    if mark not in _MARKS:
        return {key: _unpack(item, arrays, to_tensor) for key, item in value.items()}
    inside = value[mark]
    if mark == "$items":
        return {_unpack(key, arrays, to_tensor): _unpack(item, arrays, to_tensor) for key, item in inside}
    if mark == "$tuple":
        return tuple(_unpack(item, arrays, to_tensor) for item in inside)
    return _LEAVES[mark](inside, arrays, to_tensor)


_LEAVES: dict[str, Callable[[Any, Mapping[str, np.ndarray], Callable[[np.ndarray], Any]], Any]] = {
    "$array": lambda name, arrays, _: arrays[name],
    "$scalar": lambda name, arrays, _: arrays[name][()],
    "$tensor": lambda name, arrays, to_tensor: to_tensor(arrays[name]),
    "$float": lambda text, _, __: float(text),
}
