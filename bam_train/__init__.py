"""Train a robot policy, save one checkpoint.zip, run it frozen; importing this imports nothing heavy."""

__version__ = "0.1.0"
