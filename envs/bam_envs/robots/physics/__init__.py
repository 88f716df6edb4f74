"""Simulated robots on MuJoCo physics, stepped in batches."""
