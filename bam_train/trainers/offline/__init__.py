"""Offline RL: policies from data sets, with learners of our own and those of d3rlpy, and online afterwards."""
