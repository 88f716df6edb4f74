"""The agents of every interaction loop: one, several one after the other, and all of them over time."""
