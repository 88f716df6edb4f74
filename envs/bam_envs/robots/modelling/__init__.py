"""From model files, MJCF or URDF, to the description of an arm."""
