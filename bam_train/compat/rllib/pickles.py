"""Read RLlib's pickles without running what is in them.

A pickle is a program for a small machine, and one of its instructions calls any function of any module. Here no such
name is ever looked up. `read_state` knows a handful of names, for which it has functions of its own, and refuses every
other: it gives arrays and plain values. `read_record` takes names of RLlib, Gymnasium and NumPy too, and puts an inert
`Record` in the place of whatever would be made of them: it says what a file says, not what it would do. `read_outline`
does so with every name.

Before the machine starts, the instructions are counted and checked, and what it made is measured, so that a file can
waste no more memory and time than its own size explains. The format: `pickletools` of the standard library. The file is
long because it has a stand-in of its own for each of NumPy's functions that RLlib's files call, and is read best in one
piece.
"""

from __future__ import annotations

import base64
import io
import pickle
import pickletools
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from bam_train.errors import FormatError
from bam_train.trainers.rllib.freezing.parts import Array

_MOST_BYTES = 2**31
_MOST_INSTRUCTIONS = 5_000_000
_MOST_NAMES = 10_000
_MOST_VALUES = 10_000_000  # shared ones counted wherever they are: forty lists of the one before, twice, are 2**40
_MOST_NPY = 2**30  # bytes of one array that is packed into text
# Instructions that no file of RLlib's has: names from a registry, objects from outside, and the oldest forms.
_REFUSED = frozenset(
    {"PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4", "NEXT_BUFFER", "READONLY_BUFFER", "INST", "OBJ", "PUT", "GET"}
)
_DAMAGE = (
    pickle.UnpicklingError,
    EOFError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    RecursionError,
    MemoryError,
    OverflowError,
    UnicodeDecodeError,
)
_INERT = (
    "ray.rllib.",
    "ray.tune.",
    "ray.cloudpickle.",
    "cloudpickle.",
    "gymnasium.",
    "numpy.random.",
    "packaging.version",
    "bam_envs.",
    "bam_train.",
)
_INERT_NAMES = frozenset(
    {
        ("torch", "device"),
        ("functools", "partial"),
        ("builtins", "int"),
        ("builtins", "float"),
        ("builtins", "str"),
        ("builtins", "bool"),
        ("builtins", "list"),
        ("builtins", "dict"),
        ("builtins", "object"),
        ("pathlib", "PosixPath"),
    }
)


class RefusedPickle(FormatError):  # noqa: N818 - reads as what happened
    """A pickle that names what this reader does not know.

    Attributes:
        name: Dotted name of the function or class.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        said = "".join(letter if letter.isprintable() else "?" for letter in name[:120])
        super().__init__(f"names {said}, which is not read without running it")


class Record:
    """What a pickle says of an object, in place of the object; a class or function is a record that was never called.

    Attributes:
        name: Dotted name of the class or function.
        args: What it is called with; None if it is not.
        state: What is then set: usually a dict of its attributes.
        items: What is put into it by key, and what is appended.
    """

    name: str = ""

    def __init__(self, name: str, args: tuple[Any, ...] | None = None) -> None:
        self.name, self.args = name, args
        self.state: Any = None
        self.items: dict[Any, Any] = {}
        self.appended: list[Any] = []

    def __call__(self, *args: Any) -> Record:
        """Note a call; nothing is called."""
        return Record(self.name, args)

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __setitem__(self, key: Any, value: Any) -> None:
        self.items[key] = value

    def append(self, value: Any) -> None:
        """Note what a list's own `append` would be given."""
        self.appended.append(value)

    def extend(self, values: Any) -> None:
        """Note what a list's own `extend` would be given."""
        self.appended.extend(values)

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes that are set on the object, {} if there are none."""
        parts = self.state if isinstance(self.state, tuple) else (self.state,)
        found: dict[str, Any] = {}
        for part in parts:
            found |= part if isinstance(part, dict) else {}
        return found

    def __repr__(self) -> str:
        return f"Record({self.name})"


def read_state(data: bytes) -> Any:
    """Read a state: dicts, lists, tuples, text, numbers and arrays of numbers.

    Raises:
        RefusedPickle: It names something else; nothing was looked up or called.
        FormatError: Truncated, damaged, or made to exhaust its reader.
    """
    return _read(data, _StateReader)


def read_record(data: bytes) -> Any:
    """Read what a pickle says of RLlib's, Gymnasium's and NumPy's objects, as `Record`; nothing of theirs is called.

    Raises:
        RefusedPickle: It names something else; nothing was looked up or called.
        FormatError: Truncated, damaged, or made to exhaust its reader.
    """
    return _read(data, _RecordReader)


def read_outline(data: bytes) -> Any:
    """Read what a pickle says of objects of any kind, as `Record`; nothing is looked up or called.

    For what is asked for a few plain values among objects that do not matter, such as an algorithm's settings.

    Raises:
        FormatError: Truncated, damaged, made to exhaust its reader, or with arrays that are not of numbers.
    """
    return _read(data, _OutlineReader)


def unpacked_array(text: str) -> Array:
    """Read an array that RLlib packed into text: base64 of zlib of npy. Python objects in it are refused.

    Raises:
        FormatError: It is something else.
    """
    try:
        stream = zlib.decompressobj()
        data = stream.decompress(base64.b64decode(text, validate=True), _MOST_NPY)
        if stream.unconsumed_tail or not stream.eof:
            raise ValueError(f"not whole, or more than {_MOST_NPY} bytes")
        array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except (ValueError, zlib.error, EOFError, OverflowError, MemoryError, TypeError) as error:
        raise FormatError(f"a packed array cannot be read: {error}") from error
    return np.asarray(array)


def _read(data: bytes, reader: Callable[[io.BytesIO], pickle.Unpickler]) -> Any:
    try:
        _require_sane(data)
        value = reader(io.BytesIO(data)).load()
        _require_small(value)
    except FormatError:
        raise
    except _DAMAGE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FormatError(f"is not a whole pickle of RLlib's: {reason:.160}") from error
    return value


def _require_sane(data: bytes) -> None:
    """Refuse instructions that RLlib's files do not have, and numbers that only exhaust memory."""
    if len(data) > _MOST_BYTES:
        raise FormatError(f"has {len(data)} bytes, expected at most {_MOST_BYTES}")
    for count, (instruction, argument, _) in enumerate(pickletools.genops(data), 1):
        if count > _MOST_INSTRUCTIONS:
            raise FormatError(f"has more than {_MOST_INSTRUCTIONS} instructions")
        if instruction.name in _REFUSED:
            raise FormatError(f"has the instruction {instruction.name}, which RLlib does not write")
        if instruction.name in ("BINPUT", "LONG_BINPUT") and int(argument or 0) > count:
            raise FormatError(f"numbers a value {argument} after {count} instructions")


def _require_small(value: Any) -> None:
    """Refuse plain values that hold themselves, and those that are many more written out than they are in memory."""
    sizes: dict[int, int] = {}
    seen: set[int] = set()
    roots = [value]
    while roots:
        _size(roots.pop(), sizes, seen, roots)


def _size(value: Any, sizes: dict[int, int], seen: set[int], roots: list[Any]) -> int:
    """How many values there are in one, written out; what is in a record is left in `roots`, measured by itself."""
    if isinstance(value, Record):
        if id(value) not in seen:
            seen.add(id(value))
            roots += [value.args, value.state, value.items, value.appended]
        return 1
    if not isinstance(value, (dict, list, tuple, set, frozenset)):
        return 1
    if id(value) not in sizes:
        sizes[id(value)] = 0  # not yet known
        parts = [*value, *value.values()] if isinstance(value, dict) else value
        sizes[id(value)] = 1 + sum(_size(part, sizes, seen, roots) for part in parts)
    elif not sizes[id(value)]:
        raise FormatError(f"holds a {type(value).__name__} within itself")
    if sizes[id(value)] > _MOST_VALUES:
        raise FormatError(f"has more than {_MOST_VALUES} values")
    return sizes[id(value)]


class _StateReader(pickle.Unpickler):
    """Arrays and plain values."""

    def find_class(self, module: str, name: str) -> Any:
        """The reader's own function of that name."""
        known = _STATES.get((module, name))
        if known is None:
            raise RefusedPickle(f"{module}.{name}")
        return known

    def persistent_load(self, pid: Any) -> Any:
        """Refuse objects from outside."""
        raise RefusedPickle(f"the outside object {pid!r:.40}")


class _RecordReader(_StateReader):
    """Arrays, plain values and records."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.classes: dict[str, type[Record]] = {}

    def find_class(self, module: str, name: str) -> Any:
        """A record, which nothing is looked up for."""
        known = _STATES.get((module, name))
        if known is not None:
            return known
        if not self.admits(module, name):
            raise RefusedPickle(f"{module}.{name}")
        if len(self.classes) > _MOST_NAMES:
            raise FormatError(f"has more than {_MOST_NAMES} names of classes and functions")
        return self.classes.setdefault(f"{module}.{name}", _class(f"{module}.{name}"))

    def admits(self, module: str, name: str) -> bool:
        """Whether a record may have this name."""
        return f"{module}.".startswith(_INERT) or (module, name) in _INERT_NAMES


class _OutlineReader(_RecordReader):
    """Arrays, plain values and records of any name."""

    def admits(self, module: str, name: str) -> bool:
        """Any: nothing is looked up."""
        return True


def _class(name: str) -> type[Record]:
    """A class of records with this name: pickles call classes, and make instances of them without calling."""

    class Named(Record):
        def __new__(cls, *args: Any) -> Any:
            made = object.__new__(cls)
            Record.__init__(made, name, args)
            return made

        def __init__(self, *args: Any) -> None:
            pass

    Named.name = name
    return Named


def dtype_of(value: Any) -> np.dtype[Any]:
    """The dtype that a pickle names.

    Raises:
        FormatError: It names something else.
    """
    try:
        return value.dtype if isinstance(value, _Dtype) else np.dtype(value)
    except TypeError as error:
        raise FormatError(f"{value!r:.40} is not a dtype") from error


class _Dtype:
    """A dtype of plain numbers: `numpy.dtype` and what its pickle sets afterwards, checked."""

    def __init__(self, code: Any = None, align: Any = False, copy: Any = False) -> None:
        if not isinstance(code, str):
            raise RefusedPickle("numpy.dtype of something else than numbers")
        self.dtype = np.dtype(_require_plain(code))

    def __setstate__(self, state: Any) -> None:
        _, order, subarray, names, fields = state[:5]
        if (subarray, names, fields) != (None, None, None) or order not in ("<", ">", "|", "="):
            raise RefusedPickle("numpy.dtype of records")
        self.dtype = self.dtype.newbyteorder(order)


def _require_plain(code: str) -> str:
    kind = code.lstrip("<>=|")
    if kind[:1] not in "biuf?" or len(kind) > 3 or np.dtype(code).kind not in "biuf":
        raise RefusedPickle(f"numpy.dtype({code!r:.20})")
    return code


def _from_buffer(buffer: Any, dtype: Any, shape: Any, order: Any = "C", axis_order: Any = None) -> Array:
    """`numpy._core.numeric._frombuffer`."""
    if axis_order is not None:
        raise RefusedPickle("an array with its axes in another order")
    array: Array = np.frombuffer(_bytes(buffer), _dtype(dtype)).copy()
    return array.reshape(_shape(shape), order="F" if order == "F" else "C")


def _scalar(dtype: Any, data: Any) -> Any:
    """`numpy._core.multiarray.scalar`."""
    value: Any = np.frombuffer(_bytes(data), _dtype(dtype))[0]
    return value


def _bytes(data: Any) -> bytes:
    """Refuse a number, of which `bytes` would make so many zeros."""
    if not isinstance(data, (bytes, bytearray)):
        raise RefusedPickle(f"an array whose data are a {type(data).__name__}")
    return bytes(data)


class _Array(np.ndarray[Any, Any]):
    """An array of plain numbers that is filled when its state is set; `numpy.ndarray.__reduce__`."""

    def __new__(cls, *args: Any) -> Any:
        """Refuse: only `_empty` makes one, so that no memory is taken that the file does not fill."""
        raise RefusedPickle("numpy.ndarray called")

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, data = state
        plain = _dtype(dtype)
        if not isinstance(data, bytes) or len(data) != plain.itemsize * int(np.prod(_shape(shape), dtype=np.int64)):
            raise RefusedPickle("an array whose data are not its numbers")
        super().__setstate__((1, _shape(shape), plain, bool(fortran), data))  # type: ignore[arg-type]


def _empty(kind: Any, shape: Any, code: Any) -> Array:
    """`numpy._core.multiarray._reconstruct`: an array without anything in it."""
    if kind is not _Array:
        raise RefusedPickle("an array of another class than numpy.ndarray")
    empty: Array = np.zeros(0, np.int8).view(_Array)
    return empty


def _shape(shape: Any) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or not all(type(length) is int and length >= 0 for length in shape):
        raise RefusedPickle(f"an array of shape {shape!r:.40}")
    return shape


def _dtype(value: Any) -> np.dtype[Any]:
    if not isinstance(value, _Dtype):
        raise RefusedPickle("an array without a plain dtype")
    return value.dtype


def _default_dict(factory: Any = None, *args: Any) -> dict[Any, Any]:
    return dict(*args)


class _Call:
    """One of the functions above; a pickle can call it, and set nothing on it."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: Any) -> Any:
        return self._function(*args)

    def __setstate__(self, state: Any) -> None:
        raise RefusedPickle("the state of a function")


_STATES: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): _Call(dict),
    ("collections", "defaultdict"): _Call(_default_dict),
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _Array,
    **{(f"numpy.{core}.numeric", "_frombuffer"): _Call(_from_buffer) for core in ("_core", "core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _Call(_scalar) for core in ("_core", "core")},
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _Call(_empty) for core in ("_core", "core")},
}
"""Module and name to what is called in its place."""
