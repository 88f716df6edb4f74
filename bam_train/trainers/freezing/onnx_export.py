"""Write a frozen policy as an ONNX file."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn

_OPSET = 17
# The TorchScript exporter says that it will go; it is 20 times as fast as its successor and needs no onnxscript.
_NOTICES = ("You are using the legacy TorchScript-based ONNX export", "The feature will be removed")


def onnx_file(
    module: nn.Module,
    inputs: Mapping[str, torch.Tensor],
    outputs: Sequence[str],
    quiet: Mapping[str, Any] | None = None,
) -> bytes:
    """Trace a module into an ONNX file; the first axis of every input and output is the batch.

    Args:
        module: On the CPU.
        inputs: An example of each, in the order of ``forward``, by name.
        outputs: Their names.
        quiet: Beginnings of warnings that say nothing here, with their categories.
    """
    file = io.BytesIO()
    with torch.no_grad(), warnings.catch_warnings():
        for text, category in (dict.fromkeys(_NOTICES, DeprecationWarning) | dict(quiet or {})).items():
            warnings.filterwarnings("ignore", text, category)
        torch.onnx.export(
            module,
            tuple(inputs.values()),
            file,
            dynamo=False,
            opset_version=_OPSET,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes={name: {0: "n"} for name in [*inputs, *outputs]},
        )
    return file.getvalue()
