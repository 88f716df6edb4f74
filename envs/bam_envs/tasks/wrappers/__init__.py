"""Tasks around tasks."""
