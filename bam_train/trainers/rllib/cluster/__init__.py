"""Ray: starting or joining it, what there is to compute with, and what is done when a process dies."""
