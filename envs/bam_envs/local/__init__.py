"""BAM's local environments: bandits, a grid world, digits, grasps from a picture. None has a robot."""
