"""ROS 2 message objects from plain dicts and back, by what their classes say of their fields; imports no ROS."""

from __future__ import annotations

import importlib
import math
import re
from array import array
from collections.abc import Mapping, Sequence
from typing import Any

from bam_envs.core.errors import InvalidValue

_KIND = re.compile(r"(?P<package>[A-Za-z]\w*)/(?:(?:msg|srv)/)?(?P<name>[A-Za-z]\w*)")
_LIST = re.compile(r"sequence<(?P<open>.+?)(?:, \d+)?>|(?P<fixed>.+)\[\d+\]")
_BYTES = {"uint8", "octet", "byte"}
_FLOATS = {"float": "f", "double": "d"}
_INTEGERS = {f"{sign}int{bits}": (sign, bits) for sign in ("", "u") for bits in (8, 16, 32, 64)}
_INSTALL = "pip install 'ros-jazzy-rclpy[fastrtps]' ros-jazzy-std-msgs ros-jazzy-sensor-msgs ros-jazzy-geometry-msgs"


def need_rclpy(purpose: str) -> Any:
    """The package rclpy.

    Raises:
        InvalidValue: It is not here.
    """
    try:
        return importlib.import_module("rclpy")
    except ModuleNotFoundError as error:
        raise InvalidValue(
            f"{purpose} needs {error.name}, which this Python does not have. Source a ROS 2 installation, such as "
            f"/opt/ros/jazzy/setup.bash, or run: {_INSTALL}"
        ) from error


def interface(kind: str, family: str) -> Any:
    """The class of `kind`, such as ``std_msgs/String``; `family` is ``msg`` or ``srv``.

    Raises:
        InvalidValue: It is no such name, or its package is not here.
    """
    match = _KIND.fullmatch(kind)
    if match is None:
        raise InvalidValue(f"A ROS type is called pkg/Type, not {kind!r}.")
    module = f"{match['package']}.{family}"
    try:
        return getattr(importlib.import_module(module), match["name"])
    except (ModuleNotFoundError, AttributeError) as error:
        raise InvalidValue(f"{kind} is in no package of this Python; source a ROS 2 workspace that has it.") from error


def to_dict(message: Any) -> dict[str, Any]:
    """The fields of `message`, as rosbridge writes them; a byte array is `bytes`."""
    types = message.get_fields_and_field_types()
    return {name: _plain(getattr(message, name), kind) for name, kind in types.items()}


def _plain(value: Any, kind: str) -> Any:
    element = _element(kind)
    if element in _BYTES:
        return b"".join(value) if element == "octet" else bytes(value)
    if element is not None:
        return [_plain(one, element) for one in value] if "/" in element else _listed(value)
    if "/" in kind:
        return to_dict(value)
    return value[0] if isinstance(value, bytes) else value


def _listed(value: Any) -> list[Any]:
    return value.tolist() if hasattr(value, "tolist") else list(value)


def is_list(kind: str) -> bool:
    """Whether fields of the type `kind`, as ROS 2 writes it, are lists."""
    return _element(kind) is not None


def _element(kind: str) -> str | None:
    """What a list type is a list of; None for what is no list."""
    match = _LIST.fullmatch(kind)
    return None if match is None else match["open"] or match["fixed"]


def to_message(make: Any, fields: Mapping[str, Any], where: str) -> Any:
    """A message of the class `make`; fields that `fields` has not are as ROS makes them.

    Raises:
        InvalidValue: A field that the type has not, or a value that does not fit or is not finite.
    """
    message = make()
    types = make.get_fields_and_field_types()
    for name, value in fields.items():
        if name not in types:
            raise InvalidValue(f"{where} has no field {name!r}; it has {', '.join(types)}.")
        setattr(message, name, _ros(value, types[name], getattr(message, name), f"{where}.{name}"))
    return message


def _ros(value: Any, kind: str, default: Any, where: str) -> Any:
    element = _element(kind)
    if element is None:
        return _single(value, kind, type(default), where)
    if element in _BYTES and isinstance(value, (bytes, bytearray)):
        return [bytes([one]) for one in value] if element == "octet" else array("B", value)
    if not isinstance(value, Sequence) or isinstance(value, (str, bytes, bytearray)):
        raise InvalidValue(f"{where} must be {kind}, not {value!r}.")
    make = interface(element, "msg") if "/" in element else None
    values = [_single(one, element, make, f"{where}[{i}]") for i, one in enumerate(value)]
    return array(_FLOATS[element], values) if kind.startswith("sequence") and element in _FLOATS else values


def _single(value: Any, kind: str, make: Any, where: str) -> Any:
    """The generated setters check nothing unless they are asked to, and what is wrong then goes wrong in C."""
    if "/" in kind:
        if not isinstance(value, Mapping):
            raise InvalidValue(f"{where} must be an object with the fields of {kind}, not {value!r}.")
        return to_message(make, value, where)
    if kind in _FLOATS and _is_number(value):
        return float(value)
    if kind in _INTEGERS and _is_number(value) and value == int(value) and _fits(int(value), kind):
        return int(value)
    if kind == "boolean" and isinstance(value, bool):
        return value
    if kind.startswith(("string", "wstring")) and isinstance(value, str):
        return value
    if kind == "octet" and _is_number(value) and _fits(int(value), "uint8"):
        return bytes([int(value)])
    raise InvalidValue(f"{where} must be a {'finite ' if kind in _FLOATS else ''}{kind}, not {value!r}.")


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _fits(value: int, kind: str) -> bool:
    sign, bits = _INTEGERS[kind]
    low, high = (0, 2**bits) if sign == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1))
    return bool(low <= value < high)
