"""Robots: they take commands and give states, in SI units; and the profiles of live ones."""
