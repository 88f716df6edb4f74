"""The interaction loop: agents that read and write a workspace over time. BBRL's model, with and without torch.

::

    from bam_train.loop import Agent, Agents, TemporalAgent, Workspace

The core needs NumPy only. What needs torch is imported when it is asked for.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from bam_train.loop.agent import Agent
from bam_train.loop.agents import Agents, CopyTAgent, EpisodesDone, KWAgentWrapper, PrintAgent
from bam_train.loop.conventions import (
    SeedableAgent,
    SeedableAgentLast,
    SeedableAgentMean,
    SeedableAgentSum,
    SerializableAgent,
    TimeAgent,
    load,
)
from bam_train.loop.temporal_agent import TemporalAgent
from bam_train.loop.workspace import Workspace

if TYPE_CHECKING:
    from bam_train.loop.gym import (
        AutoResetGymAgent,
        GymAgent,
        NoAutoResetGymAgent,
        ParallelGymAgent,
        VecGymAgent,
        make_env,
        record_video,
    )
    from bam_train.loop.instantiate import get_arguments, get_class, instantiate_class
    from bam_train.loop.policy_agent import PolicyAgent
    from bam_train.loop.robot_agent import RobotAgent
    from bam_train.loop.tensors.asynchronous import AsynchronousAgent
    from bam_train.loop.tensors.datasets import DataLoaderAgent, ShuffledDatasetAgent
    from bam_train.loop.tensors.remote import NRemoteAgent, RemoteAgent, RemoteAgentError
    from bam_train.loop.tensors.replay_buffer import ReplayBuffer
    from bam_train.loop.tensors.returns import (
        cumulated_reward,
        doubleqlearning_temporal_difference,
        gae,
        temporal_difference,
    )

_ON_USE = {
    "AsynchronousAgent": "tensors.asynchronous",
    "AutoResetGymAgent": "gym",
    "DataLoaderAgent": "tensors.datasets",
    "GymAgent": "gym",
    "NRemoteAgent": "tensors.remote",
    "NoAutoResetGymAgent": "gym",
    "ParallelGymAgent": "gym",
    "PolicyAgent": "policy_agent",
    "RemoteAgent": "tensors.remote",
    "RemoteAgentError": "tensors.remote",
    "ReplayBuffer": "tensors.replay_buffer",
    "RobotAgent": "robot_agent",
    "ShuffledDatasetAgent": "tensors.datasets",
    "VecGymAgent": "gym",
    "cumulated_reward": "tensors.returns",
    "doubleqlearning_temporal_difference": "tensors.returns",
    "gae": "tensors.returns",
    "get_arguments": "instantiate",
    "get_class": "instantiate",
    "instantiate_class": "instantiate",
    "make_env": "gym",
    "record_video": "gym",
    "temporal_difference": "tensors.returns",
}
"""Name to the module that has it."""

__all__ = [
    "Agent",
    "Agents",
    "AsynchronousAgent",
    "AutoResetGymAgent",
    "CopyTAgent",
    "DataLoaderAgent",
    "EpisodesDone",
    "GymAgent",
    "KWAgentWrapper",
    "NRemoteAgent",
    "NoAutoResetGymAgent",
    "ParallelGymAgent",
    "PolicyAgent",
    "PrintAgent",
    "RemoteAgent",
    "RemoteAgentError",
    "ReplayBuffer",
    "RobotAgent",
    "SeedableAgent",
    "SeedableAgentLast",
    "SeedableAgentMean",
    "SeedableAgentSum",
    "SerializableAgent",
    "ShuffledDatasetAgent",
    "TemporalAgent",
    "TimeAgent",
    "VecGymAgent",
    "Workspace",
    "cumulated_reward",
    "doubleqlearning_temporal_difference",
    "gae",
    "get_arguments",
    "get_class",
    "instantiate_class",
    "load",
    "make_env",
    "record_video",
    "temporal_difference",
]


def __getattr__(name: str) -> Any:
    if name not in _ON_USE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        value = getattr(importlib.import_module(f"{__name__}.{_ON_USE[name]}"), name)
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        from bam_envs.core.errors import MissingExtra  # brings Gymnasium

        raise MissingExtra("torch", "train", f"bam_train.loop.{name}") from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
