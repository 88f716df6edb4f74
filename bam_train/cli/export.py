"""`bam-export`: a checkpoint.zip out of a checkpoint directory that RLlib wrote."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from bam_train.cli.console import say, tell
from bam_train.cli.program import parse, run_program

if TYPE_CHECKING:
    from bam_train.checkpoint import Checkpoint
    from bam_train.cli.flags import ExportConfig
    from bam_train.compat.rllib_export import Exported
    from bam_train.trainers.best_checkpoint import Output


def export_directory(config: ExportConfig) -> int:
    """The program, with its arguments read."""
    from bam_train.compat.rllib_export import export
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
    from bam_train.trainers.best_checkpoint import choose_output

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
    run_program(lambda: _main(arguments), "bam-export")


def _main(arguments: Sequence[str] | None) -> int:
    from bam_train.cli.flags import ExportConfig

    return export_directory(parse(ExportConfig, "bam-export", arguments))


if __name__ == "__main__":
    main()
