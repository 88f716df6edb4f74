"""Train a MiR100 to drive to a place with TD3 of stable-baselines3; save, load, and run the policy.

The checkpoint.zip is a stable-baselines3 file too: TD3.load("checkpoints/mir100-navigation-td3.zip") opens it. It is
saved twenty times in a run; Ctrl-C and SIGTERM end training after the update that is running, saved.

Examples:
  python scripts/td3_mir.py                             train, then ten episodes in a new environment
  python scripts/td3_mir.py --steps 2000 --render       a quick look, in a window
  python scripts/td3_mir.py --robot ws://10.0.0.5:9090  train, then drive a real one
"""

from dataclasses import dataclass
from pathlib import Path

from training_inference import infer, learn

from bam_train.cli.experiment import TrainingFlags, environment_of
from bam_train.cli.flags import Count, Seed
from bam_train.cli.program import guarded, parse
from bam_train.trainers.base import Progress
from bam_train.trainers.resolve_settings import resolve

ENV, NAME = "bam/mir100-navigation-v0", Path(__file__).stem


@dataclass(frozen=True, kw_only=True)
class Flags(TrainingFlags):
    """How long it trains, and how often the policy is run."""

    steps: Count = 40_000
    """Steps of training."""
    episodes: Count = 10
    """Episodes afterwards."""
    seed: Seed = 0
    """Of weights, samples and episodes."""


def main(args: Flags) -> None:
    """Train until all steps are done or a signal comes, saving twenty times; load, run."""
    given = {**environment_of(args, ENV, {}), "trainer": "sb3", "algo": "td3"}
    settings, shown = resolve({**given, "steps": args.steps, "seed": args.seed}), 0

    def report(progress: Progress, asked: bool) -> tuple[str | None, bool]:
        nonlocal shown
        if not asked and progress.steps < min(shown + args.steps / 20, args.steps):
            return None, False
        shown = progress.steps
        return f"{shown:>9,} steps", False

    infer(args, learn(args, settings, "twenty times", report), args.episodes, args.seed, NAME)


if __name__ == "__main__":
    raise SystemExit(guarded(lambda: main(parse(Flags, NAME, description=__doc__)), NAME))
