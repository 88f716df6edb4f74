"""Frozen policies: raw observation in, action out, without torch; NumPy for dense layers, onnxruntime for the rest."""

from bam_train.policy.frozen_policy import FrozenPolicy

__all__ = ["FrozenPolicy"]
