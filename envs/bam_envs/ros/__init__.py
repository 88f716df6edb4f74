"""States and commands as messages, and back: pure functions."""
