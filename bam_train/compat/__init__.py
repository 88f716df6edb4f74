"""Compatibility with programs and files of BBRL and RLlib."""
