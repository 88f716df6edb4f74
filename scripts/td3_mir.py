"""Train a MiR100 to drive to a place with TD3 of stable-baselines3; save, load, and run the policy.

The checkpoint.zip is a stable-baselines3 file too: TD3.load("checkpoints/mir100-navigation-td3.zip") opens it. It is
saved twenty times in a run; Ctrl-C and SIGTERM end training after the update that is running, saved.

Examples:
  python scripts/td3_mir.py                             train, then ten episodes in a new environment
  python scripts/td3_mir.py --steps 2000 --render       a quick look, in a window
  python scripts/td3_mir.py --robot ws://10.0.0.5:9090  train, then drive a real one
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path

from bam_train.checkpoint import Checkpoint
from bam_train.cli import experiment
from bam_train.cli.console import number
from bam_train.cli.experiment import open_env, play
from bam_train.cli.flags import Count, Seed
from bam_train.cli.program import guarded, parse
from bam_train.evaluation import FIRST_SEED
from bam_train.policy import FrozenPolicy
from bam_train.trainers import load_trainer
from bam_train.trainers.base import Progress
from bam_train.trainers.best_checkpoint import choose_output
from bam_train.trainers.resolve_settings import resolve

ENV, NAME = "bam/mir100-navigation-v0", Path(__file__).stem


@dataclass(frozen=True, kw_only=True)
class Flags(experiment.TrainingFlags):
    """How long it trains, and how often the policy is run."""

    steps: Count = 15_000
    """Steps of training."""
    episodes: Count = 10
    """Episodes afterwards."""
    seed: Seed = 0
    """Of weights, samples and episodes."""


def train(args: Flags) -> Checkpoint:
    """Train until all steps are done or a signal comes; save twenty times on the way."""
    given = {**experiment.environment_of(args, ENV, {}), "trainer": "sb3", "algo": "td3"}
    settings = resolve({**given, "steps": args.steps, "seed": args.seed})
    experiment.require_place(settings.env, args.robot, args.render)
    output, shown = choose_output(settings, args.out, False, None), 0

    def goes_on(progress: Progress) -> bool:
        nonlocal shown
        if asked() or progress.steps >= min(shown + args.steps / 20, args.steps):
            shown, mean = progress.steps, progress.statistics().return_mean
            trainer.save(output.path, {}, {})
            print(f"{progress.steps:>9,} steps, mean total reward {number(mean)}", flush=True)
        return not asked()

    with contextlib.closing(load_trainer("sb3").create(settings)) as trainer:
        print(f"saving to {output.path} twenty times", flush=True)
        with experiment.signals_ask() as asked:
            trainer.train(args.steps, goes_on)
    return Checkpoint.open(output.path)


def main(args: Flags) -> None:
    """Train, save, load, run."""
    checkpoint = train(args)
    policy = FrozenPolicy.load(checkpoint.path)
    watched = {"yes": args.yes, "render": args.render}
    with open_env(checkpoint, args.robot, who=NAME, episodes=args.episodes, **watched) as env:
        played = play(env, policy, episodes=args.episodes, seed=FIRST_SEED + args.seed)
        for number, record in enumerate(played, 1):
            print(f"episode {number}: total reward {record.total:.2f}{', success' * bool(record.success)}", flush=True)


if __name__ == "__main__":
    raise SystemExit(guarded(lambda: main(parse(Flags, NAME, description=__doc__)), NAME))
