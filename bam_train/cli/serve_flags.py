"""The flags of `bam-serve`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from bam_envs.remote.serve.serve_options import ServeOptions
from bam_train.cli.flags import Assignments, Count


@dataclass(frozen=True)
class ServeConfig:
    """Serve a Gymnasium environment, and the topics of its simulated robot, to clients of rosbridge, TCP or ROS 2."""

    env: Annotated[str, tyro.conf.arg(metavar="ID")] = "bam/pick"
    """Environment: any Gymnasium id."""
    num_envs: Annotated[Count, tyro.conf.arg(metavar="N")] = 1
    """Environments stepped together; several have no robot topics."""
    set: Assignments = ()
    """One keyword argument of the environment, any number of times: randomize=true."""
    yes: bool = False
    """Do not ask before clients may move a real robot (--set robot=ws://...)."""
    serving: tyro.conf.OmitArgPrefixes[ServeOptions] = field(default_factory=ServeOptions)
    """Where, and how time passes."""
