"""`bam-export`: a checkpoint.zip out of a checkpoint directory that RLlib wrote."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from bam_train.cli.console import say, tell
from bam_train.cli.program import run_program

if TYPE_CHECKING:
    from bam_train.checkpoint import Checkpoint
    from bam_train.compat.rllib.export import Exported
    from bam_train.trainers.output import Output


@dataclass(frozen=True)
class ExportConfig:
    """Turn a checkpoint directory of RLlib into a checkpoint.zip that can be evaluated and deployed."""

    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """What algo.save_to_path or algo.save wrote, or the folder of a policy in it; of the current API or the old one."""
    env: Annotated[str | None, tyro.conf.arg(metavar="ID")] = None
    """Environment it was trained on; by default what the directory says."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Where the checkpoint goes (default checkpoints/<env>-rllib-<algo>.zip)."""
    algo: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Algorithm that trained it; by default what the directory says."""
    policy: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Which policy, where the directory has several."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """env_kwargs.NAME=VALUE: an argument of the environment, any number of times; it wins over the directory's."""
    trust_pickle: tyro.conf.FlagCreatePairsOff[bool] = False
    """Unpickle files that cannot be read otherwise, which runs whatever code is in them."""
    force: bool = False
    """Overwrite the checkpoint at --out instead of adding a number to its name."""


def export_directory(config: ExportConfig) -> int:
    """The program, with its arguments read."""
    from bam_train.compat.rllib.export import export
    from bam_train.settings import read_env_kwargs

    exported = export(
        config.directory,
        env=config.env,
        env_kwargs=read_env_kwargs(config.set),
        algo=config.algo,
        policy=config.policy,
        trust=config.trust_pickle,
        warn=lambda text: say(f"bam-export: warning: {text}"),
    )
    output = _output(config, exported)
    for notice in output.notices:
        say(f"bam-export: {notice}")
    checkpoint = exported.write(output.path)
    tell(*_summary(exported, checkpoint))
    return 0


def _output(config: ExportConfig, exported: Exported) -> Output:
    from bam_train.settings import TrainSettings
    from bam_train.trainers.output import choose_output

    settings = TrainSettings(env=exported.env, algo=exported.parts.algorithm, trainer="rllib")
    return choose_output(settings, config.out, config.force, None)


def _summary(exported: Exported, checkpoint: Checkpoint) -> list[str]:
    from bam_train.environments import must_be_named

    path, parts = checkpoint.path, exported.parts
    named = f" --env {exported.env}" if must_be_named(exported.env) else ""
    made_by = f" of Ray {exported.directory.ray_version}" if exported.directory.ray_version else ""
    steps = f", {exported.steps:,} steps" if exported.steps else ""
    return [
        f"{path}: {parts.algorithm} on {exported.env}{steps}, out of {exported.directory.given}{made_by}",
        f"  checked   against the actions of {exported.checked_by}: they differ by {exported.difference:.1e} at most",
        f"  next      bam-eval {path}{named}, bam-deploy {path}{named}",
        f"            bam-train --resume {path}{named} --steps N"
        if not isinstance(exported.training, str)
        else f"  bam-train --resume cannot go on from it: {exported.training}",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script."""
    run_program(
        export_directory, ExportConfig, prog="bam-export", description=ExportConfig.__doc__ or "", arguments=arguments
    )


if __name__ == "__main__":
    main()
