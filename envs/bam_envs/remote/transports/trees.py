"""Trees (see `values`), infos and descriptions of environments through strict JSON, without losing a bit."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError
from bam_envs.core.spaces import space_from_json, space_to_json
from bam_envs.remote.transports.transport import EnvSpecMessage
from bam_envs.remote.transports.values import Tree, shown

_INT64 = range(-(2**63), 2**63)
_DTYPE = re.compile("[<>|=]?[biuf][0-9]{1,2}")


def plain_info(value: Any) -> Tree:
    """An info as a tree: tuples and sets become lists, keys and other objects their text.

    Numbers keep their values and NumPy's keep their dtypes; NaN is let through: an info is for people.
    """
    if isinstance(value, str):
        return str(value)  # also NumPy's, which would be taken for a number
    if value is None or isinstance(value, (bool, float, np.bool_, np.number)):
        return value
    if isinstance(value, int):
        return value if value in _INT64 else str(value)
    if isinstance(value, Mapping):
        return {str(key): plain_info(one) for key, one in value.items()}
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return np.ascontiguousarray(value).reshape(value.shape)
    if isinstance(value, np.ndarray):
        return plain_info(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain_info(one) for one in value]
    return str(value)


def tree_to_json(tree: Tree) -> Any:
    """`tree` as strict JSON values.

    Arrays are ``{"array": [dtype, shape, base64]}``, NumPy's scalars ``{"scalar": [dtype, base64]}``, NaN and
    infinities ``{"float": "nan"}``. A dict with one of these keys alone is ``{"dict": …}``.
    """
    if isinstance(tree, np.ndarray):
        return {"array": [tree.dtype.str, list(tree.shape), _base64(tree)]}
    if isinstance(tree, np.generic):
        return {"scalar": [tree.dtype.str, _base64(tree)]}
    if isinstance(tree, float):
        return tree if math.isfinite(tree) else {"float": repr(tree)}
    if isinstance(tree, Mapping):
        plain = {key: tree_to_json(one) for key, one in tree.items()}
        return {"dict": plain} if len(plain) == 1 and plain.keys() <= _MARKS.keys() | {"dict"} else plain
    if isinstance(tree, (list, tuple)):
        return [tree_to_json(one) for one in tree]
    return tree


def tree_from_json(value: Any) -> Tree:
    """The tree that `tree_to_json` was given.

    Raises:
        ProtocolError: An array in it is not one.
    """
    if isinstance(value, list):
        return [tree_from_json(one) for one in value]
    if not isinstance(value, Mapping):
        return value
    if len(value) == 1:
        [(mark, content)] = value.items()
        if mark == "dict" and isinstance(content, Mapping):
            return {key: tree_from_json(one) for key, one in content.items()}
        if mark in _MARKS:
            return _unmarked(mark, content)
    return {key: tree_from_json(one) for key, one in value.items()}


def _unmarked(mark: str, content: Any) -> Any:
    try:
        return _MARKS[mark](content)
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        raise ProtocolError(f"Expected the {mark} of a value, found {shown(content)}: {error}.") from error


def _base64(array: NDArray[Any] | np.generic) -> str:
    return base64.b64encode(array.tobytes()).decode()


def _array_of(content: Any) -> NDArray[Any]:
    dtype, shape, data = content
    flat = np.frombuffer(bytearray(base64.b64decode(data, validate=True)), plain_dtype(dtype))
    return flat.reshape([int(length) for length in shape])


def plain_dtype(text: Any) -> np.dtype[Any]:
    """The dtype of a message, which must be of numbers: no objects, no records.

    Raises:
        ValueError: It is not.
    """
    if not isinstance(text, str) or not _DTYPE.fullmatch(text):
        raise ValueError(f"{shown(text)} is no dtype of numbers")
    return np.dtype(text)


_MARKS: dict[str, Callable[[Any], Any]] = {
    "array": _array_of,
    "scalar": lambda content: _array_of([content[0], [1], content[1]])[0],
    "float": float,
}


def spec_to_json(spec: EnvSpecMessage) -> dict[str, Any]:
    """What a server says of its environment, as strict JSON values."""
    return {
        "env_id": spec.env_id,
        "observation_space": space_to_json(spec.observation_space),
        "action_space": space_to_json(spec.action_space),
        "num_envs": spec.num_envs,
        "vector": spec.vector,
        "period": spec.period,
        "max_episode_steps": spec.max_episode_steps,
        "signals": tree_to_json(plain_info(spec.signals)),
    }


def spec_from_json(value: Mapping[str, Any]) -> EnvSpecMessage:
    """What `spec_to_json` was given.

    Raises:
        ProtocolError: It says something else.
    """
    try:
        return EnvSpecMessage(
            env_id=str(value["env_id"]),
            observation_space=space_from_json(value["observation_space"]),
            action_space=space_from_json(value["action_space"]),
            num_envs=int(value["num_envs"]),
            vector=bool(value["vector"]),
            period=None if value["period"] is None else float(value["period"]),
            max_episode_steps=None if value["max_episode_steps"] is None else int(value["max_episode_steps"]),
            signals=tree_from_json(value["signals"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"Expected the description of an environment, found {shown(value)}: {error}.") from error
