"""checkpoint.zip: written whole, verified member by member, never unpickled. Needs NumPy only."""

from bam_train.checkpoint.checkpoint import GOLDEN, POLICY, Checkpoint, next_free_path, write_checkpoint
from bam_train.checkpoint.manifest import FORMAT, MANIFEST, Manifest

__all__ = ["FORMAT", "GOLDEN", "MANIFEST", "POLICY", "Checkpoint", "Manifest", "next_free_path", "write_checkpoint"]
