"""Train a MiR100 to drive to a place with TD3 of stable-baselines3; save, load, and run the policy.

The checkpoint.zip is a stable-baselines3 file too: TD3.load("checkpoints/mir100-navigation-td3.zip") opens it.

Examples:
  python scripts/td3_mir.py                             train, then ten episodes in a new environment
  python scripts/td3_mir.py --steps 2000 --episodes 3   a quick look
  python scripts/td3_mir.py --robot ws://10.0.0.5:9090  train, then drive a real one
"""

import argparse
import contextlib
from pathlib import Path

from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import number
from bam_train.cli.experiment import ScriptParser, ctrl_c_asks, open_env, require_address, whole
from bam_train.cli.program import guarded
from bam_train.evaluation import FIRST_SEED
from bam_train.policy import FrozenPolicy
from bam_train.trainers import load_trainer
from bam_train.trainers.output import choose_output
from bam_train.trainers.resolve import resolve
from bam_train.trainers.trainer import Progress

ENV, NAME = "bam/mir100-navigation-v0", Path(__file__).stem


def train(steps: int, seed: int) -> Checkpoint:
    """Train until all steps are done or Ctrl-C; save."""
    settings = resolve({"env": ENV, "trainer": "sb3", "algo": "td3", "steps": steps, "seed": seed})
    output, shown = choose_output(settings, None, False, None), 0

    def goes_on(progress: Progress) -> bool:
        nonlocal shown
        if progress.steps >= min(shown + steps / 20, steps):
            shown, mean = progress.steps, progress.statistics().return_mean
            print(f"{progress.steps:>9,} steps, mean total reward {number(mean)}", flush=True)
        return not interrupted()

    with contextlib.closing(load_trainer("sb3").create(settings)) as trainer, ctrl_c_asks() as interrupted:
        trainer.train(steps, goes_on)
        checkpoint = trainer.save(output.path, {}, {})
    print(f"saved {checkpoint.path}", flush=True)
    if interrupted():
        raise KeyboardInterrupt
    return checkpoint


def main(args: argparse.Namespace) -> None:
    """Train, save, load, run."""
    require_address(args.robot)
    checkpoint = train(args.steps, args.seed)
    policy = FrozenPolicy.load(checkpoint.path)
    with open_env(checkpoint, args.robot, who=NAME, episodes=args.episodes, yes=args.yes) as env:
        for k in range(args.episodes):
            observation, _ = env.reset(seed=FIRST_SEED + args.seed + k)
            policy.reset()
            total, ended = 0.0, False
            while not ended:
                observation, reward, terminated, truncated, info = env.step(policy.act(observation))
                total, ended = total + float(reward), terminated or truncated
            print(
                f"episode {k + 1}: total reward {total:.2f}{', success' if info.get('is_success') else ''}", flush=True
            )


def parse() -> argparse.Namespace:
    """Read the command line."""
    parser = ScriptParser(__file__, __doc__)
    add = parser.add_argument
    add("--steps", type=whole(1), default=15_000, metavar="N", help="steps of training (default 15000)")
    add("--episodes", type=whole(1), default=10, metavar="N", help="episodes afterwards (default 10)")
    add("--robot", metavar="URL", help="use the policy on a live robot behind rosbridge, such as ws://10.0.0.5:9090")
    add("--yes", action="store_true", help="do not ask before a real robot moves")
    add("--seed", type=whole(0), default=0, metavar="N", help="of weights, samples and episodes (default 0)")
    args: argparse.Namespace = parser.parse_args()
    return args


if __name__ == "__main__":
    raise SystemExit(guarded(lambda: main(parse()), NAME))
