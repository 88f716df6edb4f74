"""The agents of every interaction loop: one, several one after the other, and all of them over time."""

from bam_train.loop.agents.agent import Agent
from bam_train.loop.agents.agents import Agents, CopyTAgent, EpisodesDone, KWAgentWrapper, PrintAgent, SeedableAgent
from bam_train.loop.agents.temporal_agent import TemporalAgent

__all__ = [
    "Agent",
    "Agents",
    "CopyTAgent",
    "EpisodesDone",
    "KWAgentWrapper",
    "PrintAgent",
    "SeedableAgent",
    "TemporalAgent",
]
