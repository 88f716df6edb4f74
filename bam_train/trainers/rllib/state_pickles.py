"""Read the states in RLlib's pickles, without running them: dicts, lists, tuples, text, numbers and arrays of numbers.

A pickle is a program that can call any function of any module. Here no name in it is imported: a few names have
stand-ins below, and others are refused, or replaced by an inert `Unread`. Instructions are counted before they run, and
values afterwards, so that memory and time are proportional to the size of the file.
"""

from __future__ import annotations

import base64
import io
import pickle
import pickletools
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_train.errors import FormatError

Array = NDArray[Any]

_MOST_INSTRUCTIONS = 5_000_000
_MOST_VALUES = 10_000_000  # shared values count at each use: 40 lists, each of the one before twice, are 2**40 values
_MOST_BYTES = 2**30  # of one array that is packed into text
_DAMAGE = (pickle.UnpicklingError, EOFError, ValueError, TypeError, LookupError, AttributeError, RecursionError)


class RefusedPickle(FormatError):  # noqa: N818 - reads as what happened
    """A pickle names a function or class that is not read."""

    def __init__(self, name: str) -> None:
        printable = "".join(letter if letter.isprintable() else "?" for letter in name[:120])
        super().__init__(f"names {printable}, which is not read without running it")


class Unread:
    """An object that is not read: it accepts all operations of a pickle, and does nothing."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Unread:
        """Ignore any arguments."""
        return object.__new__(cls)

    def _ignore(self, *args: Any, **kwargs: Any) -> Unread:
        return self

    __call__ = __setstate__ = __setitem__ = append = _ignore

    def __init__(self, *args: Any, **kwargs: Any) -> None: ...


def read_state(data: bytes, *, skip_objects: bool = False) -> Any:
    """Read a state; with `skip_objects`, an object of any other kind becomes an `Unread`.

    Raises:
        RefusedPickle: It names another function or class; nothing was imported or called.
        FormatError: It is truncated, damaged, or too large.
    """
    try:
        for count, (instruction, argument, _) in enumerate(pickletools.genops(data), 1):
            if count > _MOST_INSTRUCTIONS:
                raise FormatError(f"has more than {_MOST_INSTRUCTIONS} instructions")
            if "PUT" in instruction.name and int(argument or 0) > count:  # would allocate memory for so many values
                raise FormatError(f"numbers a value {argument} after {count} instructions")
        value = _Reader(io.BytesIO(data), skip_objects).load()
        _count(value, {})
    except FormatError:
        raise
    except (*_DAMAGE, MemoryError, OverflowError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FormatError(f"is not a whole pickle of RLlib's: {reason:.160}") from error
    return value


def unpacked_array(text: str) -> Array:
    """Read an array (any shape) that RLlib packed into text: base64 of zlib of npy, without Python objects.

    Raises:
        FormatError: The text is not such an array.
    """
    try:
        stream = zlib.decompressobj()
        data = stream.decompress(base64.b64decode(text, validate=True), _MOST_BYTES)
        if stream.unconsumed_tail or not stream.eof:
            raise ValueError(f"not whole, or more than {_MOST_BYTES} bytes")
        return np.asarray(np.lib.format.read_array(io.BytesIO(data), allow_pickle=False))
    except (ValueError, zlib.error, EOFError, OverflowError, MemoryError, TypeError) as error:
        raise FormatError(f"a packed array cannot be read: {error}") from error


def _count(value: Any, sizes: dict[int, int]) -> int:
    """Number of values in a nested value, shared ones counted at each use; raises FormatError for cycles."""
    if not isinstance(value, (dict, list, tuple, set, frozenset)):
        return 1
    if id(value) not in sizes:
        sizes[id(value)] = 0  # not yet known
        parts = [*value, *value.values()] if isinstance(value, dict) else value
        sizes[id(value)] = 1 + sum(_count(part, sizes) for part in parts)
    elif not sizes[id(value)]:
        raise FormatError(f"holds a {type(value).__name__} within itself")
    if sizes[id(value)] > _MOST_VALUES:
        raise FormatError(f"has more than {_MOST_VALUES} values")
    return sizes[id(value)]


class _Reader(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, skip_objects: bool) -> None:
        super().__init__(file)
        self._skip_objects = skip_objects

    def find_class(self, module: str, name: str) -> Any:
        known = _KNOWN.get((module.replace("numpy.core.", "numpy._core."), name))
        if known is None and not self._skip_objects:
            raise RefusedPickle(f"{module}.{name}")
        return known or Unread


class _StandIn:
    """A class in place of a function of NumPy: a pickle can call it, but not set its state."""

    def __setstate__(self, state: Any) -> None:
        raise RefusedPickle("the state of a function")


class _Dtype(_StandIn):
    """`numpy.dtype` of numbers, and the byte order that a pickle sets afterwards."""

    def __init__(self, code: Any = None, align: Any = False, copy: Any = False) -> None:
        if not isinstance(code, str) or np.dtype(code).kind not in "biuf":
            raise RefusedPickle(f"numpy.dtype({code!r:.20})")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        _, order, subarray, names, fields = state[:5]
        if (subarray, names, fields) != (None, None, None) or order not in ("<", ">", "|", "="):
            raise RefusedPickle("numpy.dtype of records")
        self.dtype = self.dtype.newbyteorder(order)


class _FromBuffer(_StandIn):
    """`numpy._core.numeric._frombuffer`."""

    def __new__(cls, buffer: Any, dtype: Any, shape: Any, order: Any = "C", axis_order: Any = None) -> Any:
        if axis_order is not None:
            raise RefusedPickle("an array with its axes in another order")
        return _numbers(buffer, dtype).copy().reshape(_shape(shape), order="F" if order == "F" else "C")


class _Scalar(_StandIn):
    """`numpy._core.multiarray.scalar`."""

    def __new__(cls, dtype: Any, data: Any) -> Any:
        return _numbers(data, dtype)[0]


class _Array(np.ndarray[Any, Any]):
    """`numpy.ndarray`, made empty by `_Reconstruct` only, and filled by its state from the file."""

    def __new__(cls, *args: Any) -> Any:
        raise RefusedPickle("numpy.ndarray called")

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, data = state
        if _numbers(data, dtype).size != int(np.prod(_shape(shape), dtype=np.int64)):
            raise RefusedPickle("an array whose data are not its numbers")
        super().__setstate__((1, shape, dtype.dtype, bool(fortran), data))  # type: ignore[arg-type]


class _Reconstruct(_StandIn):
    def __new__(cls, kind: Any, shape: Any, code: Any) -> Any:
        if kind is not _Array:
            raise RefusedPickle("an array of another class than numpy.ndarray")
        return np.zeros(0, np.int8).view(_Array)


class _DefaultDict(_StandIn):
    def __new__(cls, factory: Any = None, *args: Any) -> Any:
        return dict(*args)


def _numbers(data: Any, dtype: Any) -> Array:
    if not isinstance(data, (bytes, bytearray)):  # `bytes` of a number n would be n zeros
        raise RefusedPickle(f"an array whose data are a {type(data).__name__}")
    if not isinstance(dtype, _Dtype):
        raise RefusedPickle("an array without a plain dtype")
    return np.frombuffer(bytes(data), dtype.dtype)


def _shape(shape: Any) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or not all(type(length) is int and length >= 0 for length in shape):
        raise RefusedPickle(f"an array of shape {shape!r:.40}")
    return shape


_KNOWN: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): dict,
    ("collections", "defaultdict"): _DefaultDict,
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _Array,
    ("numpy._core.numeric", "_frombuffer"): _FromBuffer,
    ("numpy._core.multiarray", "scalar"): _Scalar,
    ("numpy._core.multiarray", "_reconstruct"): _Reconstruct,
}
"""Stand-ins by module and name."""
