"""The workspace: variables over time, read and written by agents; its figures, tables and replay buffer."""
