"""Run an ONNX graph with onnxruntime, on one thread: what a policy with convolutions needs.

A graph may come from a stranger, and onnxruntime hears no Ctrl-C. So its memory is bounded, and it is loaded and run a
first time in a thread that is waited for only so long. A later run takes as long as the first: no operation of a policy
takes longer for other numbers.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as faults

from bam_train.errors import PolicyError

MOST_SECONDS = 5.0
"""Time that loading a graph and its first run may take [s]."""
MOST_MEMORY = 2**30
"""Bytes that onnxruntime may use for the weights and results of all graphs."""

_FAULTS = (faults.Fail, faults.InvalidArgument, faults.InvalidGraph, faults.InvalidProtobuf, faults.NotImplemented)
T = TypeVar("T")


class OnnxSession:
    """A graph in onnxruntime."""

    def __init__(self, onnx: bytes) -> None:
        """Load the graph.

        Raises:
            PolicyError: onnxruntime cannot run it.
        """
        try:
            self._session = _within(MOST_SECONDS, lambda: _load(onnx))
        except _FAULTS as error:
            raise PolicyError(f"onnxruntime {onnxruntime.__version__} cannot run the policy: {error}") from error
        self._outputs = [output.name for output in self._session.get_outputs()]
        self._options = onnxruntime.RunOptions()
        self._has_run = False

    def run(self, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return every output by name, (n, ...), for every input by name, (n, ...)."""
        given = dict(inputs)
        try:
            if self._has_run:
                results = self._run(given)
            else:
                results = _within(MOST_SECONDS, lambda: self._run(given), self._stop)
                self._has_run = True
        except _FAULTS as error:
            raise PolicyError(f"onnxruntime {onnxruntime.__version__} failed: {error}") from error
        return dict(zip(self._outputs, results, strict=True))

    def _run(self, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        results: list[np.ndarray] = self._session.run(self._outputs, inputs, self._options)
        return results

    def _stop(self) -> None:
        """End a run in progress before its next operation."""
        self._options.terminate = True


def _load(onnx: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.use_env_allocators", "1")  # that of `_bound_memory`
    options.log_severity_level = 4  # its errors come as exceptions
    return onnxruntime.InferenceSession(
        onnx,
        options,
        providers=["CPUExecutionProvider"],
        disabled_optimizers=["ConstantFolding"],  # it computes without bounds
    )


def _within(seconds: float, call: Callable[[], T], stop: Callable[[], None] = lambda: None) -> T:
    """What `call` returns, made in another thread: waiting for a thread, other than for C++, can be interrupted.

    Raises:
        PolicyError: It takes longer.
    """
    results: list[T] = []
    errors: list[BaseException] = []

    def work() -> None:
        try:
            results.append(call())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work, name="first run of a policy", daemon=True)
    thread.start()
    try:
        thread.join(seconds)
    finally:
        if thread.is_alive():
            stop()
    if errors:
        raise errors[0]
    if not results:
        raise PolicyError(f"the policy takes more than {seconds:g} s for one action")
    return results[0]


def _bound_memory() -> None:
    """Bound what sessions that ask for it may allocate together; onnxruntime keeps one such setting a process."""
    info = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    onnxruntime.create_and_register_allocator(info, onnxruntime.OrtArenaCfg({"max_mem": MOST_MEMORY}))


_bound_memory()
