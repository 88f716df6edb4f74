"""Learners of our own, and the kit that they share.

The kit: `torch_trainer` (the run: checkpoints, statistics, resuming), `replay_memory` (transitions, action codes) and
`networks` (layers, moments, optimiser). Each algorithm is a file: `dagger`, `implicit_q` (with behaviour cloning),
`rlpd`, `grasp_q`; `offline_trainer` learns from data sets, `live_learner` from a live agent.
"""
