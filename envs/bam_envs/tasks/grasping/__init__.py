"""Grasps from a picture: the tasks, and a policy written by hand."""
