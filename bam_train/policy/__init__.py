"""Frozen policies: raw observation in, action out, with onnxruntime and without torch."""

import os

from bam_train.policy.frozen_policy import FrozenPolicy

__all__ = ["FrozenPolicy"]

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
"""Read when onnxruntime is imported, later than this package: it reports on each graph to its maker otherwise."""
