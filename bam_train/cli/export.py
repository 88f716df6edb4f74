"""`bam-export`: a checkpoint.zip out of a checkpoint directory that RLlib wrote."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from bam_train.cli.console import say, tell
from bam_train.cli.program import run_program

if TYPE_CHECKING:
    from bam_train.cli.flags import ExportConfig


def export_directory(config: ExportConfig) -> None:
    """Run the program with its parsed flags."""
    from bam_train.compat.rllib_export import export
    from bam_train.environments import must_be_named
    from bam_train.settings import TrainSettings, read_env_kwargs
    from bam_train.trainers.best_checkpoint import choose_output

    exported = export(
        config.directory,
        env=config.env,
        env_kwargs=read_env_kwargs(config.set),
        algo=config.algo,
        policy=config.policy,
        trust=config.trust_pickle,
        warn=lambda text: say(f"bam-export: warning: {text}"),
    )
    parts, directory = exported.parts, exported.directory
    settings = TrainSettings(env=exported.env, algo=parts.algorithm, trainer="rllib")
    output = choose_output(settings, config.out, config.force, None)
    for notice in output.notices:
        say(f"bam-export: {notice}")
    path = exported.write(output.path).path
    named = f" --env {exported.env}" if must_be_named(exported.env) else ""
    made_by = f" of Ray {directory.ray_version}" if directory.ray_version else ""
    steps = f", {exported.steps:,} steps" if exported.steps else ""
    tell(
        f"{path}: {parts.algorithm} on {exported.env}{steps}, out of {directory.given}{made_by}",
        f"  checked   against the actions of {exported.checked_by}: they differ by {exported.difference:.1e} at most",
        f"  next      bam-eval {path}{named}, bam-deploy {path}{named}",
        f"            bam-train --resume {path}{named} --steps N"
        if not isinstance(exported.training, str)
        else f"  bam-train --resume cannot go on from it: {exported.training}",
    )


main = partial(
    run_program, "bam-export", "bam_train.cli.flags:ExportConfig", lambda config, _: export_directory(config)
)

if __name__ == "__main__":
    main()
