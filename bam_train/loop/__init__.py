"""The interaction loop: agents that read and write a workspace over time. BBRL's model, with and without torch.

::

    from bam_train.loop import Agent, Agents, TemporalAgent, Workspace

The core needs NumPy only. Names that need torch, and names for programs written for BBRL, are imported on use.
"""

import importlib
from typing import TYPE_CHECKING, Any

from bam_train.loop.agent import Agent, import_torch
from bam_train.loop.agents import Agents, CopyTAgent, EpisodesDone, KWAgentWrapper, PrintAgent, SeedableAgent
from bam_train.loop.temporal_agent import TemporalAgent
from bam_train.loop.workspace.workspace import Workspace

if TYPE_CHECKING:
    from bam_train.loop.gym_agent import GymAgent as GymAgent
    from bam_train.loop.parallel_gym_agent import ParallelGymAgent as ParallelGymAgent
    from bam_train.loop.parallel_gym_agent import make_env as make_env
    from bam_train.loop.parallel_gym_agent import record_video as record_video
    from bam_train.loop.robot_agent import ObservingAgents as ObservingAgents
    from bam_train.loop.robot_agent import PolicyAgent as PolicyAgent
    from bam_train.loop.robot_agent import RobotAgent as RobotAgent
    from bam_train.loop.vec_gym_agent import VecGymAgent as VecGymAgent
    from bam_train.loop.workspace.replay_buffer import ReplayBuffer as ReplayBuffer
    from bam_train.loop.workspace.returns import gae as gae

_ON_USE = {
    "loop.gym_agent": ("GymAgent",),
    "loop.parallel_gym_agent": ("ParallelGymAgent", "make_env", "record_video"),
    "loop.vec_gym_agent": ("VecGymAgent",),
    "loop.robot_agent": ("ObservingAgents", "PolicyAgent", "RobotAgent"),
    "loop.workspace.replay_buffer": ("ReplayBuffer",),
    "loop.workspace.returns": ("cumulated_reward", "doubleqlearning_temporal_difference", "gae", "temporal_difference"),
    "compat.bbrl.conventions": (
        *("SeedableAgentLast", "SeedableAgentMean", "SeedableAgentSum", "SerializableAgent", "TimeAgent", "load"),
        *("get_arguments", "get_class", "instantiate_class"),
    ),
    "compat.bbrl.dataset_agents": ("DataLoaderAgent", "ShuffledDatasetAgent"),
    "compat.bbrl.old_gym_agents": ("AutoResetGymAgent", "NoAutoResetGymAgent"),
    "compat.bbrl.remote_agents": ("AsynchronousAgent", "NRemoteAgent", "RemoteAgent"),
}
"""Names by module of `bam_train`."""
_MODULES = {name: module for module, names in _ON_USE.items() for name in names}

__all__ = [
    "Agent",
    "Agents",
    "CopyTAgent",
    "EpisodesDone",
    "KWAgentWrapper",
    "PrintAgent",
    "SeedableAgent",
    "TemporalAgent",
    "Workspace",
    *_MODULES,
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        value = getattr(importlib.import_module(f"bam_train.{_MODULES[name]}"), name)
    except ModuleNotFoundError as error:
        if error.name == "torch":
            import_torch(f"bam_train.loop.{name}")  # its error message tells how to install torch
        raise
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
