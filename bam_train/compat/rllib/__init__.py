"""Checkpoint folders that RLlib itself wrote, read without running code, and made into a checkpoint.zip."""
