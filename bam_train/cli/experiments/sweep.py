"""`bam-sweep`: search the settings with which an algorithm learns best, and confirm them on new seeds."""

from __future__ import annotations

import pkgutil
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro
from msgspec import Meta

from bam_train.cli.flags import (
    Assignments,
    Count,
    File,
    Folder,
    Groups,
    Positive,
    RobotModelFlag,
    SettingsFlags,
    Trackers,
)
from bam_train.cli.program import run_program

_Hidden = Annotated[None, tyro.conf.Suppress]


@dataclass(frozen=True)
class SweepConfig(SettingsFlags, RobotModelFlag):  # type: ignore[misc]
    """Search the settings with which an algorithm learns best; every trial of them trains several seeds.

    Of --set and of a file, values such as log:1e-4..1e-2, 0.9..0.99, 1..10 or 256,512 are searched, others are fixed.
    The same command again does what is missing; several at once share a search. Nothing is better than the preset
    before --confirm says so.

    Examples:
      bam-sweep --env bam/pick --algo ppo --set learning_rate=log:1e-4..1e-2 --set n_steps=64,128 --trials 40
      bam-sweep sweep.toml --minutes 30
      bam-sweep --resume runs/pick-ppo-sweep --status
      bam-sweep --resume runs/pick-ppo-sweep --confirm 10 --save-preset pick.toml
    """

    GROUPS: ClassVar[Groups] = {
        "What is searched": ("env", "robot_model", "algo", "set", "steps", "until_success", "stop_reward"),
        "How long": ("trials", "seeds", "minutes", "resume", "runs", "track"),
        "What comes out": ("status", "confirm", "save_preset"),
        "Evaluations": ("eval_every", "eval_episodes", "trial_threshold"),
        "From a data set or a teacher": ("data", "teacher", "start"),
        "Where it is computed": (
            *("trainer", "num_envs", "device", "threads", "num_env_runners", "num_learners", "num_gpus", "address"),
        ),
    }
    SET: ClassVar[str] = "env_kwargs.robot_model"

    file: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[FILE]")] = None
    """Settings as of bam-train --config, .toml or .json, with ranges and choices as text; trials, seeds, minutes."""
    set: Assignments = ()
    """A setting to search, or a fixed one, any number of times: gamma=0.9..0.99, policy_kwargs.net_arch=[64],[256]."""
    trials: Annotated[Count | None, tyro.conf.arg(metavar="N")] = None
    """Trials in all, also after --resume (default 20)."""
    seeds: Annotated[Count | None, tyro.conf.arg(metavar="N")] = None
    """Runs of each trial, with the seeds 0, 1, … (default 3)."""
    minutes: Annotated[Positive | None, tyro.conf.arg(metavar="MIN")] = None
    """Stop after this time [min]; the same command goes on."""
    resume: Folder = None
    """Folder of a search that was begun, to go on with its settings, or for --status, --confirm and --save-preset."""
    runs: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs")
    """Folder in which the folder of the search is made."""
    track: Trackers = None
    """Show each run in wandb, mlflow or trackio too, in the group of the search."""
    status: bool = False
    """Search nothing: print the best trial, how much each setting matters, and what was pruned and why."""
    confirm: Annotated[Annotated[int, Meta(ge=3, le=1000)] | None, tyro.conf.arg(metavar="N")] = None
    """Search nothing: compare the best trial with the preset on this many new seeds; status 3 unless it is better."""
    save_preset: File = None
    """Search nothing: write the settings of the best trial into this .toml or .json file, for bam-train --config."""
    seed: _Hidden = None
    transport: _Hidden = None
    ca_file: _Hidden = None
    token_file: _Hidden = None


main = partial(
    run_program,
    "bam-sweep",
    "bam_train.cli.experiments.sweep:SweepConfig",
    lambda config, _: _sweep(config),
)


def _sweep(config: Any) -> int:
    return int(pkgutil.resolve_name("bam_train.cli.experiments.sweep_run:sweep")(config))


if __name__ == "__main__":
    main()
