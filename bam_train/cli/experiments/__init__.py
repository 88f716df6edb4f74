"""Programs of experiments: several seeds of a run, and the comparison of runs."""
