"""checkpoint.zip: written whole, verified member by member, never unpickled. Needs NumPy only."""

from bam_train.checkpoint.checkpoint import GOLDEN, POLICY, Checkpoint, write_checkpoint
from bam_train.checkpoint.manifest import FORMAT, MANIFEST, Manifest

__all__ = ["FORMAT", "GOLDEN", "MANIFEST", "POLICY", "Checkpoint", "Manifest", "write_checkpoint"]
