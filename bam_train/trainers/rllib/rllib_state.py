"""The state of an algorithm in a checkpoint: RLlib's own tree of files, from which a run resumes without unpickling.

``bam/resume/rllib/…`` is written by ``Algorithm.save_to_path``, so that ``Algorithm.from_checkpoint`` of the unpacked
folder works for those who trust it. A resumed run here builds the algorithm from its settings and sets the states of
these files, read as arrays and plain values, without ``class_and_ctor_args.pkl``, which describes objects to make.
``bam/resume/learner.json`` has adaptive numbers of the learners that the tree lacks.

A pickle is a program that can call any function of any module. Here no name in it is imported: a few names have
stand-ins below, and others are refused, or replaced by an inert `Unread`. Instructions are counted before they run, and
values afterwards, so that memory and time are proportional to the size of the file.
"""

from __future__ import annotations

import base64
import functools
import io
import json
import pickle
import pickletools
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bam_train.checkpoint import Checkpoint
from bam_train.errors import CheckpointError, CheckpointMismatch, FormatError

Array = NDArray[Any]

FOLDER, NOTES, EXTRAS = "bam/resume/rllib/", "bam/resume/notes.json", "bam/resume/learner.json"
STATES = ("state.pkl", "algorithm_state.pkl", "module_state.pkl", "policy_state.pkl")


def members(algorithm: Any, notes: Mapping[str, Any]) -> dict[str, bytes]:
    """The members from which the run resumes, taken between two iterations; notes are JSON values."""
    with tempfile.TemporaryDirectory(prefix="bam-rllib-") as name:
        root = Path(name).resolve()  # RLlib takes absolute paths only
        algorithm.save_to_path(str(root))
        files = sorted(path for path in root.rglob("*") if path.is_file())
        tree = {FOLDER + path.relative_to(root).as_posix(): path.read_bytes() for path in files}
    return {NOTES: json.dumps(dict(notes)).encode(), EXTRAS: json.dumps(extras_of(algorithm)).encode(), **tree}


def load(checkpoint: Checkpoint, algorithm: Any) -> None:
    """Restore a checkpoint's states into a new algorithm with the same settings.

    Raises:
        CheckpointMismatch: It was made by another version of Ray.
        CheckpointError: A state cannot be read, or does not fit the algorithm.
    """
    require_version(checkpoint)
    state = read(checkpoint)
    with checkpoint.fitting(FOLDER):
        algorithm.metrics.set_state(state["metrics_logger"])
        if algorithm.env_runner_group is None:  # `Algorithm.set_state` would send the weights to runners
            algorithm.learner_group.set_state(state.pop("learner_group"))
        algorithm.set_state(state)
        hand_out(algorithm)
    if checkpoint.has(EXTRAS):
        with checkpoint.fitting(EXTRAS):
            give = functools.partial(_give, extras=json.loads(checkpoint.read(EXTRAS)))
            for result in algorithm.learner_group.foreach_learner(give):
                result.get()  # raises the learner's exception


def read(checkpoint: Checkpoint) -> dict[str, Any]:
    """The nested state of the whole algorithm: arrays and plain values.

    Raises:
        CheckpointError: A state cannot be read, or holds other objects; the message names it.
    """
    tree: dict[str, Any] = {}
    for name in sorted(checkpoint.manifest.sha256):
        path = PurePosixPath(name)
        if not name.startswith(FOLDER) or path.name not in STATES:
            continue
        try:
            state = read_state(checkpoint.read(name))
            if not isinstance(state, dict):
                raise FormatError(f"holds a {type(state).__name__}, expected a table of names")
        except FormatError as error:
            raise CheckpointError(
                checkpoint.path, f"{name} {error}. Train anew, or get it again", member=name
            ) from error
        inner = tree
        for part in path.parent.relative_to(FOLDER).parts:
            inner = inner.setdefault(part, {})
        inner.update(state)
    if not tree:
        raise CheckpointError(checkpoint.path, f"has no {FOLDER}; it was not made by RLlib", member=FOLDER)
    return tree


def hand_out(algorithm: Any) -> None:
    """Send the learner's weights and the observations' statistics to every runner, and wait for their arrival.

    RLlib's `sync_weights` skips a runner that has not answered the call before: after `set_state`, which makes two
    calls, runners would take their first samples with random weights.
    """
    group = algorithm.env_runner_group
    if group is None:
        return
    weights = algorithm.learner_group.get_state(components="learner/rl_module", inference_only=True)["learner"]
    state = algorithm.env_runner.get_state(not_components="rl_module")
    state["rl_module"] = weights["rl_module"]  # without a sequence number, so that they are not discarded as old
    algorithm.env_runner.set_state(state)
    group.foreach_env_runner("set_state", kwargs={"state": state}, local_env_runner=False)


def start_actions(algorithm: Any, log_std: float | None, scale: float) -> None:
    """Set the free standard deviation of a new algorithm's actions, and multiply its policy's last layer by `scale`."""
    if log_std is None and scale == 1.0:
        return
    group = algorithm.learner_group
    weights = group.get_weights()
    for module in weights.values():
        layers = {name: int(name.split(".")[3]) for name in module if name.startswith("pi.net.mlp.")}
        last = max(layers.values(), default=-1)
        for name in module:
            if name.startswith("pi.") and name.endswith("log_std") and log_std is not None:
                module[name] = np.full_like(module[name], log_std)
            elif layers.get(name) == last:
                module[name] = module[name] * np.float32(scale)
    group.set_weights(weights)


def require_version(checkpoint: Checkpoint) -> None:
    """Refuse to resume from the state of another major or minor version of Ray.

    Raises:
        CheckpointMismatch: The message names both versions.
    """
    import ray  # policies of the old API stack are read without it

    saved = str(checkpoint.manifest.versions.get("ray", ""))
    if saved and saved.split(".")[:2] != ray.__version__.split(".")[:2]:
        raise CheckpointMismatch(
            checkpoint.path,
            f"was trained with Ray {saved}, and this is Ray {ray.__version__}, whose states differ. "
            f'Run: pip install "ray[rllib]=={saved}" to go on; bam-eval and bam-deploy need no Ray',
        )


_NAMES = (
    "curr_kl_coeffs_per_module",
    "curr_log_alpha",
    "moving_avg_sqd_adv_norms_per_module",
    "last_update_ts_by_mid",
    "_last_update_ts_by_mid",
    "entropy_coeff_schedulers_per_module",
)
"""The KL coefficient of PPO and APPO, the temperature of SAC, TQC and CQL, MARWIL's running mean of squared advantages,
the steps of the last updates of target networks, and the current value of a schedule of the entropy's weight.
``Learner.get_state`` of Ray 2.60 lacks them."""


def extras_of(algorithm: Any) -> dict[str, dict[str, float]]:
    """Numbers that ``Learner.get_state`` lacks, equal for all learners, by the learner's attribute and module."""
    results = list(algorithm.learner_group.foreach_learner(_take))
    return dict(results[0].get()) if results else {}


def _take(learner: Any) -> dict[str, dict[str, float]]:
    tables = {name: getattr(learner, name) for name in _NAMES if hasattr(learner, name)}
    modules = list(learner.module.keys())
    return {name: {key: _number(table[key]) for key in modules} for name, table in tables.items()}


def _number(value: Any) -> Any:
    """The number of a tensor, or the current value of a schedule, which JSON stores exactly."""
    value = value.get_current_value() if hasattr(value, "use_schedule") else value
    return value.item() if isinstance(value, torch.Tensor) else value


def _give(learner: Any, extras: Mapping[str, Mapping[str, float]]) -> None:
    for name, numbers in extras.items():
        table = getattr(learner, name)
        for key, number in numbers.items():
            value = table[key]
            if hasattr(value, "use_schedule"):  # its value until the first update has ended; a fixed number stays
                value = value.get_current_value() if value.use_schedule else None
            if isinstance(value, torch.Tensor):
                value.data.fill_(number)  # in place: an optimiser may hold it
            elif value is not None:
                table[key] = number


# States without unpickling

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
