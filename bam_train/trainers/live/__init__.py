"""Learning from a live agent while it runs."""
