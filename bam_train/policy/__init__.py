"""Frozen policies: raw observation in, action out, with onnxruntime and without torch."""

from bam_train.policy.frozen_policy import FrozenPolicy

__all__ = ["FrozenPolicy"]
