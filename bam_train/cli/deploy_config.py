"""The flags of `bam-deploy`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class DeployConfig:
    """Run the frozen policy of a checkpoint on a robot, simulated here or live, at the rate it was made for."""

    checkpoint: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CHECKPOINT")]
    """The checkpoint.zip that bam-train wrote."""
    episodes: int = 5
    """How many episodes."""
    seed: int = 1_000_000
    """Seed of the first episode; episode k gets seed + k, as in bam-eval."""
    env: Annotated[str | None, tyro.conf.arg(metavar="ID")] = None
    """Refuse the checkpoint unless it was trained on this environment; needed for some_module:Env-v0."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="URL")] = None
    """Live robot behind rosbridge, such as ws://10.0.0.5:9090; by default the simulated one here."""
    transport: Annotated[str | None, tyro.conf.arg(metavar="URL")] = None
    """Whole environment that runs elsewhere: ws://10.0.0.5:9090/bam_001 (GymAPI), tcp://10.0.0.5:9091."""
    profile: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """What the live robot's topics are: a shipped name, or a .toml or .yaml file."""
    ca_file: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Certificates that wss:// trusts instead of the system's."""
    token_file: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File with the token that the server asks for."""
    timeout: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """Longest that an answer of --transport is waited for [s]; 30 by default."""
    yes: tyro.conf.FlagCreatePairsOff[bool] = False
    """Do not ask before a real robot moves."""
    rate: Annotated[float | None, tyro.conf.arg(metavar="HZ")] = None
    """Actions a second [Hz]; by default the environment's own."""
    fast: tyro.conf.FlagCreatePairsOff[bool] = False
    """Do not wait for deadlines: as fast as it goes."""
    render: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show the robot in a window."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON report on standard output instead of a few lines."""
