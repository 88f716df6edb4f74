"""Run a policy's ONNX graph with onnxruntime, on one thread, or on all of a policy server's.

A graph may be untrusted, and onnxruntime cannot be interrupted by Ctrl-C. So its memory is bounded, and loading and the
first run happen in a thread with a limit of CPU time, as a busy computer is no fault of the graph. Later runs take as
long as the first: the time of an operation does not depend on the values.
"""

import functools
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as faults

from bam_train.errors import PolicyError
from bam_train.policy.chunks import TOO_SLOW

MOST_SECONDS = 5.0
"""Most CPU time of this process for loading a graph, and for its first run [s]."""
_PATIENCE = 20.0
"""Longest time for either, in multiples of that."""
_ENDING = 10.0
"""Longest wait for an operation that runs when it is too late [s]."""
MOST_MEMORY = 2**30
"""Bytes that onnxruntime may use for the weights and results of all graphs."""

_FAULTS = (faults.Fail, faults.InvalidArgument, faults.InvalidGraph, faults.InvalidProtobuf, faults.NotImplemented)
_DTYPES = {"float": "float32", "double": "float64"}
"""Names of dtypes in onnxruntime that differ from NumPy's."""
T = TypeVar("T")


@dataclass(frozen=True)
class Tensor:
    """An input of the graph."""

    shape: tuple[int | None, ...]
    """None where the length is free, such as that of the batch axis."""
    dtype: str
    """Name of the NumPy dtype."""


class PolicyRunner(Protocol):
    """What computes actions: a graph, the library of a policy, or a policy server."""

    @property
    def slow(self) -> str:
        """What to say of a late chunk."""

    @property
    def inputs(self) -> Mapping[str, Tensor]:
        """The policy's inputs, by name."""

    @property
    def outputs(self) -> Sequence[str]:
        """Names of its outputs."""

    def run(self, inputs: Mapping[str, Any], outputs: Sequence[str], /) -> list[Any]:
        """The named outputs, (n, ...), for every input by name, (n, ...)."""


class OnnxSession:
    """A graph that `require_policy` accepted, in onnxruntime; raises PolicyError if onnxruntime cannot run it.

    Attributes:
        inputs: Its inputs, by name.
        outputs: Names of its outputs.
        most_seconds: Most CPU time for the first run [s].
        slow: What to say of a late chunk.
    """

    slow = TOO_SLOW

    def __init__(self, onnx: bytes, threads: int = 1) -> None:
        try:
            self._session = _within(MOST_SECONDS, lambda: _load(onnx, threads))
        except _FAULTS as error:
            raise PolicyError(f"onnxruntime {onnxruntime.__version__} cannot run the policy: {error}") from error
        self.inputs: dict[str, Tensor] = {}
        for node in self._session.get_inputs():  # described as ``tensor(float)`` and ``['n', 3]``
            dtype = re.sub(r"^tensor\((\w+)\)$", r"\1", node.type)
            shape = tuple(n if isinstance(n, int) else None for n in node.shape)
            self.inputs[node.name] = Tensor(shape, _DTYPES.get(dtype, dtype))
        self.outputs = [node.name for node in self._session.get_outputs()]
        self.most_seconds = MOST_SECONDS
        self._options = onnxruntime.RunOptions()
        self._has_run = False

    def run(self, inputs: Mapping[str, np.ndarray], outputs: Sequence[str]) -> list[np.ndarray]:
        """Return the named outputs, new arrays (n, ...), for every input by name, (n, ...)."""
        try:
            # Without these options, onnxruntime makes new ones for each run: 3 of 13 µs.
            if self._has_run:
                results: list[np.ndarray] = self._session.run(outputs, inputs, self._options)
                return results
            end = functools.partial(setattr, self._options, "terminate", True)  # stops before the next operation
            results = _within(self.most_seconds, lambda: self._session.run(outputs, inputs, self._options), end)
        except _FAULTS as error:
            raise PolicyError(f"onnxruntime {onnxruntime.__version__} failed: {error}") from error
        self._has_run = True
        return results


def _load(onnx: bytes, threads: int) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.use_env_allocators", "1")  # the bounded one, see the end of this file
    options.log_severity_level = 4  # its errors come as exceptions
    return onnxruntime.InferenceSession(
        onnx,
        options,
        providers=["CPUExecutionProvider"],
        disabled_optimizers=["ConstantFolding"],  # it computes without bounds
    )


def _within(seconds: float, call: Callable[[], T], stop: Callable[[], None] = lambda: None) -> T:
    """Run `call`, which may take so much CPU time [s], in another thread: Ctrl-C interrupts waiting, but not C++."""
    results: list[T] = []
    errors: list[BaseException] = []
    done = threading.Event()  # Ctrl-C in Thread.join makes the thread look ended in Python 3.11

    def work() -> None:
        try:
            results.append(call())
        except BaseException as error:
            errors.append(error)
        done.set()

    begun, last = time.process_time(), time.monotonic() + _PATIENCE * seconds
    threading.Thread(target=work, name="first run of a policy", daemon=True).start()
    try:
        while not done.wait(seconds / 5):
            if time.process_time() - begun > seconds or time.monotonic() > last:
                raise PolicyError(f"the policy takes more than {seconds:g} s for one action")
    finally:
        if not done.is_set():
            stop()
            done.wait(_ENDING)  # a thread that is inside onnxruntime while Python ends would abort the process
    if errors:
        raise errors[0]
    return results[0]


# Bounds the memory of all sessions with ``session.use_env_allocators``; onnxruntime has one such bound per process.
onnxruntime.create_and_register_allocator(
    onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    ),
    onnxruntime.OrtArenaCfg({"max_mem": MOST_MEMORY}),
)
