"""Contextual bandits: one decision at a time, such as a grasp from a picture."""
