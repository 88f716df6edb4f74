"""Arms as data: their descriptions, kinematics, outlines and work areas; no simulator is needed."""
