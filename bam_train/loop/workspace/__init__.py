"""The workspace: variables over time, read and written by agents; its figures, tables and replay buffer."""

from bam_train.loop.workspace.workspace import Sink, Workspace

__all__ = ["Sink", "Workspace"]
