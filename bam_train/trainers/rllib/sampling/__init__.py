"""Collecting samples: one batched simulation in each runner."""
