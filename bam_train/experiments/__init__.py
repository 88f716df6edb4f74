"""Experiments of several runs: one run a seed, and the comparison of what the runs of each row have reached."""
