"""The flags of the programs: one frozen dataclass a program, one field a flag, its docstring the line of ``--help``.

The flags of `bam-serve` are in `serve_flags.py`, since they need the environments. Programs import this after they have
begun to handle signals, as tyro takes a while.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from msgspec import Meta

Count = Annotated[int, Meta(ge=1)]
Seed = Annotated[int, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0, le=sys.float_info.max)]
Assignments = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE")]
CheckpointFile = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CHECKPOINT")]
File = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
Name = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
EnvId = Annotated[str | None, tyro.conf.arg(metavar="ID")]
Url = Annotated[str | None, tyro.conf.arg(metavar="URL")]


def _unset(metavar: str) -> object:
    """A flag that shows what it takes, and no default: what is not given is not set."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


_Text = Annotated[str | None, _unset("NAME")]
_Whole = Annotated[int | None, _unset("N")]
_Share = Annotated[float | None, _unset("SHARE")]
_File = Annotated[Path | None, _unset("FILE")]


@dataclass(frozen=True)
class TrainConfig:
    """Train a policy and keep the best as one checkpoint.zip."""

    # What is not given here comes from --config, then the preset, then the algorithm's defaults.
    env: _Text = None
    """Environment: any Gymnasium id, such as bam/pick, CartPole-v1 or some_module:Env-v0."""
    algo: _Text = None
    """Algorithm: ppo, a2c, sac, td3, ddpg, dqn, tqc, trpo, qrdqn, crossq or recurrent-ppo.
    With --trainer rllib: ppo, appo, impala, sac, tqc, dqn, bc, marwil, cql or iql."""
    trainer: _Text = None
    """Library that trains: sb3 (default) or rllib."""
    steps: _Whole = None
    """Environment steps of the whole run, also after --resume."""
    seed: _Whole = None
    """Seed of weights, exploration and environments."""
    num_envs: _Whole = None
    """Environments stepped side by side, in all: the runners of rllib share them."""
    num_env_runners: _Whole = None
    """Processes of rllib that collect samples (default 0: the trainer's own does)."""
    num_learners: _Whole = None
    """Processes of rllib that update the weights (default 0: the trainer's own does)."""
    num_gpus: _Whole = None
    """GPUs that learners of rllib use in all (default RLLIB_NUM_GPUS, else 0)."""
    address: Annotated[str | None, _unset("auto|HOST:PORT")] = None
    """Ray cluster that rllib trains on; by default it starts one on this computer, for this run."""
    data: Annotated[str | None, _unset("FOLDER")] = None
    """Recorded episodes that bc, marwil, cql and iql of rllib learn from: Parquet files, also at an fsspec address."""
    device: _Text = None
    """Where to compute: auto, cpu, cuda, cuda:1."""
    threads: _Whole = None
    """Threads that torch computes with (default 1: more is slower on small networks)."""
    config: _File = None
    """File of settings, .toml or .json, such as --print-config writes."""
    set: Assignments = ()
    """One setting, any number of times: learning_rate=lin_3e-4, policy_kwargs.net_arch=[64,64],
    env_kwargs.randomize=true."""
    print_config: bool = False
    """Print all settings of the run as JSON, and do not train."""
    out: _File = None
    """Where the best checkpoint goes (default checkpoints/<env>-<algo>.zip)."""
    copy_to: Annotated[str | None, _unset("URL")] = None
    """Copy every checkpoint that goes to --out to an fsspec address too, such as s3://bucket/runs/."""
    resume: _File = None
    """Checkpoint to go on from, with its settings and up to --steps in all."""
    until_success: _Share = None
    """Stop once this share of evaluation episodes succeeds, such as 0.99."""
    eval_every: _Whole = None
    """Steps between two evaluations (default a twentieth of the run)."""
    eval_episodes: _Whole = None
    """Episodes of one evaluation."""
    transport: Annotated[str | None, _unset("URL,...")] = None
    """Train on an environment that runs elsewhere, such as ws://host:9090/name or tcp://host:port, or on several."""
    ca_file: _File = None
    """Certificates that wss:// trusts instead of the system's."""
    token_file: _File = None
    """File with the token that the servers ask for."""
    force: bool = False
    """Overwrite the checkpoint at --out instead of adding a number to its name."""
    runs: Path = Path("runs")
    """Folder in which the run's own folder is made."""


@dataclass(frozen=True)
class EvalConfig:
    """Evaluate the frozen policy of a checkpoint over seeded episodes."""

    checkpoint: CheckpointFile
    """The checkpoint.zip that bam-train wrote."""
    episodes: Count = 100
    """How many episodes."""
    seed: Seed = 1_000_000
    """Seed of the first episode; episode k gets seed + k. The default is far from the seeds that training uses."""
    env: EnvId = None
    """Refuse the checkpoint unless it was trained on this environment; needed for some_module:Env-v0, and for a plain
    stable-baselines3 zip."""
    algo: Name = None
    """Refuse the checkpoint unless it was trained by this algorithm; needed for a plain stable-baselines3 zip."""
    set: Assignments = ()
    """env_kwargs.NAME=VALUE: an argument of the environment, any number of times; it wins over the checkpoint's."""
    num_envs: Annotated[Count | None, tyro.conf.arg(metavar="N")] = None
    """Environments stepped side by side; by default as many as is quick."""
    json: bool = False
    """Print one JSON object on standard output instead of a table."""
    video: File = None
    """Film the first episodes into this .gif or .mp4 file."""
    video_episodes: Count = 3
    """How many episodes the film shows."""
    trust_pickle: bool = False
    """Load a plain stable-baselines3 zip, which runs whatever code is in it."""


@dataclass(frozen=True)
class DeployConfig:
    """Run the frozen policy of a checkpoint on a robot, simulated here or live, at the rate it was made for."""

    checkpoint: CheckpointFile
    """The checkpoint.zip that bam-train wrote."""
    episodes: Count = 5
    """How many episodes."""
    seed: Seed = 1_000_000
    """Seed of the first episode; episode k gets seed + k, as in bam-eval."""
    env: EnvId = None
    """Refuse the checkpoint unless it was trained on this environment; needed for some_module:Env-v0."""
    robot: Url = None
    """Live robot behind rosbridge, such as ws://10.0.0.5:9090; by default the simulated one here."""
    transport: Url = None
    """Whole environment that runs elsewhere: ws://10.0.0.5:9090/bam_001 (GymAPI), tcp://10.0.0.5:9091."""
    profile: Name = None
    """What the live robot's topics are: a shipped name, or a .toml or .yaml file."""
    ca_file: File = None
    """Certificates that wss:// trusts instead of the system's."""
    token_file: File = None
    """File with the token that the server asks for."""
    timeout: Annotated[Positive | None, tyro.conf.arg(metavar="S")] = None
    """Longest that an answer of --transport is waited for [s]; 30 by default."""
    yes: bool = False
    """Do not ask before a real robot moves."""
    rate: Annotated[Positive | None, tyro.conf.arg(metavar="HZ")] = None
    """Actions a second [Hz]; by default the environment's own."""
    fast: bool = False
    """Do not wait for deadlines: as fast as it goes."""
    render: bool = False
    """Show the robot in a window."""
    json: bool = False
    """Print one JSON report on standard output instead of a few lines."""


@dataclass(frozen=True)
class ExportConfig:
    """Turn a checkpoint directory of RLlib into a checkpoint.zip that can be evaluated and deployed."""

    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """What algo.save_to_path or algo.save wrote, or the folder of a policy in it; of the current API or the old one."""
    env: EnvId = None
    """Environment it was trained on; by default what the directory says."""
    out: File = None
    """Where the checkpoint goes (default checkpoints/<env>-rllib-<algo>.zip)."""
    algo: Name = None
    """Algorithm that trained it; by default what the directory says."""
    policy: Name = None
    """Which policy, where the directory has several."""
    set: Assignments = ()
    """env_kwargs.NAME=VALUE: an argument of the environment, any number of times; it wins over the directory's."""
    trust_pickle: bool = False
    """Let RLlib read a directory of its present API, which runs whatever code is in it."""
    force: bool = False
    """Overwrite the checkpoint at --out instead of adding a number to its name."""


@dataclass(frozen=True)
class EnvsConfig:
    """List our environments, or describe one (any Gymnasium id): spaces, rate, name and unit of every number."""

    env: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="[ID]")] = None
    """The environment to describe, e.g. bam/pick; without it, all of ours are listed."""
    json: bool = False
    """Print JSON."""
