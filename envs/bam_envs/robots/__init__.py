"""Robots: they take commands and give states, in SI units."""
