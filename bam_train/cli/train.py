"""`bam-train`: train a policy, keep the best as one checkpoint.zip."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from bam_train.cli.console import count, tell
from bam_train.cli.program import run_program

if TYPE_CHECKING:
    from bam_train.checkpoint import Checkpoint
    from bam_train.settings import TrainSettings
    from bam_train.trainers.copies import Copies
    from bam_train.trainers.output import Output
    from bam_train.trainers.run_folder import RunFolder
    from bam_train.trainers.trainer import Trainer

_STARTED = time.monotonic()


def _flag(metavar: str) -> object:
    """A flag that shows what it takes, and no default: what is not given is not set."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


Text = Annotated[str | None, _flag("NAME")]
Whole = Annotated[int | None, _flag("N")]
Share = Annotated[float | None, _flag("SHARE")]
File = Annotated[Path | None, _flag("FILE")]


@dataclass(frozen=True)
class TrainConfig:
    """Flags of `bam-train`; what is not given comes from ``--config``, the preset, then the algorithm's defaults."""

    env: Text = None
    """Environment: any Gymnasium id, such as bam/pick, CartPole-v1 or some_module:Env-v0."""
    algo: Text = None
    """Algorithm: ppo, a2c, sac, td3, ddpg, dqn, tqc, trpo, qrdqn, crossq or recurrent-ppo.
    With --trainer rllib: ppo, appo, impala, sac, tqc, dqn, bc, marwil, cql or iql."""
    trainer: Text = None
    """Library that trains: sb3 (default) or rllib."""
    steps: Whole = None
    """Environment steps of the whole run, also after --resume."""
    seed: Whole = None
    """Seed of weights, exploration and environments."""
    num_envs: Whole = None
    """Environments stepped side by side, in all: the runners of rllib share them."""
    num_env_runners: Whole = None
    """Processes of rllib that collect samples (default 0: the trainer's own does)."""
    num_learners: Whole = None
    """Processes of rllib that update the weights (default 0: the trainer's own does)."""
    num_gpus: Whole = None
    """GPUs that learners of rllib use in all (default RLLIB_NUM_GPUS, else 0)."""
    address: Annotated[str | None, _flag("auto|HOST:PORT")] = None
    """Ray cluster that rllib trains on; by default it starts one on this computer, for this run."""
    data: Annotated[str | None, _flag("FOLDER")] = None
    """Recorded episodes that bc, marwil, cql and iql of rllib learn from: Parquet files, also at an fsspec address."""
    device: Text = None
    """Where to compute: auto, cpu, cuda, cuda:1."""
    threads: Whole = None
    """Threads that torch computes with (default 1: more is slower on small networks)."""
    config: File = None
    """File of settings, .toml or .json, such as --print-config writes."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """One setting, any number of times: learning_rate=lin_3e-4, policy_kwargs.net_arch=[64,64],
    env_kwargs.randomize=true."""
    print_config: bool = False
    """Print all settings of the run as JSON, and do not train."""
    out: File = None
    """Where the best checkpoint goes (default checkpoints/<env>-<algo>.zip)."""
    copy_to: Annotated[str | None, _flag("URL")] = None
    """Copy every checkpoint that goes to --out to an fsspec address too, such as s3://bucket/runs/."""
    resume: File = None
    """Checkpoint to go on from, with its settings and up to --steps in all."""
    until_success: Share = None
    """Stop once this share of evaluation episodes succeeds, such as 0.99."""
    eval_every: Whole = None
    """Steps between two evaluations (default a twentieth of the run)."""
    eval_episodes: Whole = None
    """Episodes of one evaluation."""
    transport: Annotated[str | None, _flag("URL,...")] = None
    """Train on an environment that runs elsewhere, such as ws://host:9090/name or tcp://host:port, or on several."""
    ca_file: File = None
    """Certificates that wss:// trusts instead of the system's."""
    token_file: File = None
    """File with the token that the servers ask for."""
    force: bool = False
    """Overwrite the checkpoint at --out instead of adding a number to its name."""
    runs: Path = Path("runs")
    """Folder in which the run's own folder is made."""


_NOT_SETTINGS = frozenset({"config", "set", "print_config", "out", "copy_to", "resume", "force", "runs"})


def main() -> None:
    """Run the program."""
    description = "Train a policy and keep the best as one checkpoint.zip."
    run_program(train, TrainConfig, prog="bam-train", description=description)


def train(config: TrainConfig) -> int:
    """Do what the flags say; returns the exit status."""
    from bam_train.checkpoint import Checkpoint

    checkpoint = None if config.resume is None else Checkpoint.open(config.resume)
    settings = _settings(config, checkpoint)
    if config.print_config:
        tell(*json.dumps(settings.to_mapping(), indent=2).split("\n"))
        return 0
    return _train(config, settings, checkpoint)


def _settings(config: TrainConfig, checkpoint: Checkpoint | None) -> TrainSettings:
    from bam_train.place import addresses
    from bam_train.settings import merge, read_assignments, read_config
    from bam_train.trainers.resolve import resolve, resolve_resumed

    file = {} if config.config is None else read_config(config.config)
    flags = {
        field.name: getattr(config, field.name)
        for field in fields(config)
        if field.name not in _NOT_SETTINGS and getattr(config, field.name) is not None
    }
    flags |= {name: str(flags[name]) for name in ("ca_file", "token_file") if name in flags}
    if "transport" in flags:
        flags["transport"] = list(addresses(flags["transport"]))
    given = merge(file, read_assignments(config.set), flags)
    return resolve(given) if checkpoint is None else resolve_resumed(given, checkpoint)


def _train(config: TrainConfig, settings: TrainSettings, checkpoint: Checkpoint | None) -> int:
    """Train with complete settings; returns the exit status."""
    from bam_train.cli.train_display import nobody_need_read
    from bam_train.trainers import load_trainer
    from bam_train.trainers.copies import Copies
    from bam_train.trainers.output import choose_output
    from bam_train.trainers.run_folder import require_room

    require_room(config.runs.expanduser())
    output = choose_output(settings, config.out, config.force, checkpoint)
    kind = load_trainer(settings.trainer)
    copies = None if config.copy_to is None else Copies(config.copy_to)
    made = kind.create(settings) if checkpoint is None else kind.load(checkpoint, settings)
    try:
        folder = _folder(config.runs.expanduser(), made)
    except BaseException:
        made.close()
        raise
    with nobody_need_read():
        return _run(made, folder, output, copies, _title(settings, checkpoint))


def _folder(runs: Path, trainer: Trainer) -> RunFolder:
    """The run's own folder, with its settings and log files."""
    from bam_train.settings import file_stem
    from bam_train.trainers.run_folder import RunFolder

    settings = trainer.settings
    folder = RunFolder(runs, file_stem(settings.env, settings.algo, settings.trainer))
    folder.write_config(settings.to_mapping())
    trainer.log_to(folder.tensorboard)
    return folder


def _title(settings: TrainSettings, checkpoint: Checkpoint | None) -> str:
    """What is trained, and from where."""
    title = f"{settings.algo} on {settings.env}, seed {settings.seed}"
    if checkpoint is None:
        return title
    return f"{title}, going on from {checkpoint.path} at {count(checkpoint.manifest.steps)} steps"


def _run(trainer: Trainer, folder: RunFolder, output: Output, copies: Copies | None, title: str) -> int:
    """Train to the end and say how it went; returns the exit status."""
    from bam_train.cli.stop_signals import StopSignals
    from bam_train.cli.train_display import make_display
    from bam_train.cli.train_summary import summarise
    from bam_train.trainers.run import TrainingRun

    display = make_display(title)
    run = TrainingRun(trainer, folder, output.path, display, output.best, copies=copies)
    with StopSignals(run) as signals:
        try:
            with display:
                for notice in [*output.notices, *trainer.notices]:
                    display.note(notice)
                outcome = run.run()
        finally:
            trainer.close()
        summarise(trainer.settings, outcome, folder, time.monotonic() - _STARTED)
    if outcome.failure is not None:
        raise outcome.failure
    return signals.status


if __name__ == "__main__":
    main()
