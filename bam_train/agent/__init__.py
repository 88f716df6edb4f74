"""The live agent: resident on a robot's computer, paused and taken over by a person, given new frozen weights."""
