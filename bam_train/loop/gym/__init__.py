"""Gymnasium environments as agents of the loop."""
