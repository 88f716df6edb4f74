"""What policy_from_cp_mir.py and policy_from_cp_ur.py have in common: run the policy of a checkpoint."""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.core.registry import resolve_id
from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import say, tell
from bam_train.cli.experiment import ScriptParser, open_env, whole
from bam_train.cli.program import guarded
from bam_train.evaluation import FIRST_SEED
from bam_train.policy import FrozenPolicy
from bam_train.settings import read_env_kwargs


def open_checkpoint(
    args: argparse.Namespace, given: dict[str, Any], name: str, default: str, folder: str
) -> Checkpoint:
    """The checkpoint of `args`; one out of a directory of RLlib is written into `folder`."""
    path = args.checkpoint.expanduser()
    if not path.is_dir():
        checkpoint = Checkpoint.open(path)
        if args.env is not None:
            checkpoint.requires_env(resolve_id(args.env))
        return checkpoint
    from bam_train.compat.rllib_export import export

    def warn(text: str) -> None:
        say(f"{name}: warning: {text}")

    exported = export(path, env=args.env, env_kwargs=given, otherwise=default, trust=args.trust_pickle, warn=warn)
    return exported.write(Path(folder) / "policy.zip")


def play(env: gym.Env[Any, Any], policy: FrozenPolicy, seed: int) -> tuple[float, bool, int, int]:
    """One episode: its return, whether it succeeded, its clipped actions, and how many there were."""
    space = env.action_space
    observation, _ = env.reset(seed=seed)
    policy.reset()
    total, clipped, steps, ended = 0.0, 0, 0, False
    while not ended:  # on a live robot, each step waits for the end of its period
        action = policy.act(observation)
        if isinstance(space, gym.spaces.Box):
            action = np.clip(action, space.low, space.high)
            # A frozen policy clips by itself, as RLlib does: a number is then exactly at its bound.
            clipped += bool(((action <= space.low) | (action >= space.high)).any())
        observation, reward, terminated, truncated, info = env.step(action)
        total, steps, ended = total + float(reward), steps + 1, terminated or truncated
    return total, bool(info.get("is_success")), clipped, steps


def run(args: argparse.Namespace, name: str, default: str, kind: str) -> None:
    """Run the episodes, in a simulation or on a live robot."""
    given = read_env_kwargs(args.set)
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = open_checkpoint(args, given, name, default, folder)
        policy = FrozenPolicy.from_checkpoint(checkpoint)
        more = {"yes": args.yes, "render": args.render, "env_kwargs": given}
        with open_env(checkpoint, args.robot, who=name, episodes=args.num_episodes, **more) as env:
            moved = getattr(env.unwrapped, "robot", None)
            robot = f"a {moved.spec.name}" if moved is not None else "no robot of ours"
            if not robot.startswith(f"a {kind}"):
                say(f"{name}: note: {checkpoint.manifest.env} moves {robot}")
            successes = 0
            for k in range(args.num_episodes):
                total, success, clipped, steps = play(env, policy, args.seed + k)
                successes += success
                how = "success" if success else "no success"
                print(f"episode {k + 1}: return {total:.2f}, {how}, clipped {clipped} of {steps} actions", flush=True)
            tell(f"success in {successes} of {args.num_episodes} episodes on {checkpoint.manifest.env}")


def parse(script: str, description: str, default: str) -> argparse.Namespace:
    """Read the command line."""
    parser = ScriptParser(script, description)
    add = parser.add_argument
    add("checkpoint", type=Path, metavar="CHECKPOINT", help="checkpoint.zip, or a directory that RLlib wrote")
    add("--env", metavar="ID", help=f"of a directory that does not say where it was trained (default {default})")
    text = "an argument of the environment, any number of times; it wins over the checkpoint's"
    add("--set", action="append", default=[], metavar="env_kwargs.NAME=VALUE", help=text)
    add("--num-episodes", type=whole(1), default=5, metavar="N", help="how many (default 5)")
    add("--seed", type=whole(0), default=FIRST_SEED, metavar="N", help=f"of the first episode (default {FIRST_SEED})")
    add("--trust-pickle", action="store_true", help="let RLlib read its directory, which runs what is in it")
    parser.add_robot()
    args: argparse.Namespace = parser.parse_args()
    return args


def main(script: str, description: str, default: str, kind: str) -> int:
    """Run `script`, whose docstring is `description`; its exit status.

    A directory that does not say where it was trained is tried on the environment `default`; the names of the robots
    that the script is for begin with `kind`.
    """
    name = Path(script).stem
    return guarded(lambda: run(parse(script, description, default), name, default, kind), name)
