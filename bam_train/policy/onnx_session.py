"""Run an ONNX graph with onnxruntime, on one thread: what a policy with convolutions needs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as faults

from bam_train.errors import PolicyError

_FAULTS = (faults.Fail, faults.InvalidArgument, faults.InvalidGraph, faults.InvalidProtobuf, faults.NotImplemented)


class OnnxSession:
    """A graph in onnxruntime."""

    def __init__(self, onnx: bytes) -> None:
        """Load the graph.

        Raises:
            PolicyError: onnxruntime cannot run it.
        """
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4  # its errors come as exceptions
        try:
            self._session = onnxruntime.InferenceSession(onnx, options, providers=["CPUExecutionProvider"])
        except _FAULTS as error:
            raise PolicyError(f"onnxruntime {onnxruntime.__version__} cannot run the policy: {error}") from error
        self._outputs = [output.name for output in self._session.get_outputs()]

    def run(self, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return every output by name, (n, ...), for every input by name, (n, ...)."""
        try:
            results = self._session.run(self._outputs, dict(inputs))
        except _FAULTS as error:
            raise PolicyError(f"onnxruntime {onnxruntime.__version__} failed: {error}") from error
        return dict(zip(self._outputs, results, strict=True))
