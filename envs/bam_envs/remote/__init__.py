"""Environments and robots that another process has, and what serves them."""
