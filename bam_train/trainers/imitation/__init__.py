"""Imitation of a teacher that acts in the environment: DAgger."""
