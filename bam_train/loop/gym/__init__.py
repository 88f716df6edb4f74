"""Gymnasium environments as agents of the loop."""

from bam_train.loop.gym.gym_agent import GymAgent
from bam_train.loop.gym.legacy import AutoResetGymAgent, NoAutoResetGymAgent
from bam_train.loop.gym.making import make_env, record_video
from bam_train.loop.gym.parallel import ParallelGymAgent
from bam_train.loop.gym.vector import VecGymAgent

__all__ = [
    "AutoResetGymAgent",
    "GymAgent",
    "NoAutoResetGymAgent",
    "ParallelGymAgent",
    "VecGymAgent",
    "make_env",
    "record_video",
]
