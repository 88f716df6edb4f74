"""What policy_from_cp_mir.py and policy_from_cp_ur.py have in common: run the policy of a checkpoint."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.core.registry import resolve_id
from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import say, tell
from bam_train.cli.experiment import RobotFlags, open_env, play
from bam_train.cli.flags import Assignments, CheckpointFile, Count, EnvId, Seed
from bam_train.cli.program import guarded, parse
from bam_train.evaluation import FIRST_SEED
from bam_train.files.log_lines import counted
from bam_train.policy import FrozenPolicy
from bam_train.settings import read_env_kwargs


@dataclass(frozen=True, kw_only=True)
class Flags(RobotFlags):
    """Which policy is run, and how often."""

    checkpoint: CheckpointFile
    """A checkpoint.zip, or a directory that RLlib wrote."""
    env: EnvId = None
    """Of a directory that does not say where it was trained."""
    set: Assignments = ()
    """An argument of the environment, any number of times: parity=true. It wins over the checkpoint's."""
    num_episodes: Count = 5
    """How many."""
    seed: Seed = FIRST_SEED
    """Of the first episode."""
    trust_pickle: bool = False
    """Let RLlib read its directory, which runs what is in it."""


def open_checkpoint(args: Flags, given: dict[str, Any], name: str, default: str, folder: str) -> Checkpoint:
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


class Clipped:
    """A policy whose actions are clipped to their space, and counted."""

    def __init__(self, policy: FrozenPolicy, space: gym.Space[Any]) -> None:
        self._policy, self._space = policy, space
        self.clipped = 0

    def reset(self) -> None:
        """Begin an episode."""
        self._policy.reset()
        self.clipped, self._last = 0, False

    def act(self, observation: Any) -> Any:
        """The action; that on the last observation of an episode is not counted."""
        action, space = self._policy.act(observation), self._space
        self.clipped += self._last
        if isinstance(space, gym.spaces.Box):
            action = np.clip(action, space.low, space.high)
            # A frozen policy clips by itself, as RLlib does: a number is then exactly at its bound.
            self._last = bool(((action <= space.low) | (action >= space.high)).any())
        return action


def run(args: Flags, name: str, default: str, kind: str) -> None:
    """Run the episodes, in a simulation or on a live robot."""
    given = read_env_kwargs(args.set)
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = open_checkpoint(args, given, name, default, folder)
        policy = FrozenPolicy.from_checkpoint(checkpoint)
        more: Any = {"yes": args.yes, "render": args.render, "env_kwargs": given}
        with open_env(checkpoint, args.robot, who=name, episodes=args.num_episodes, **more) as env:
            moved = getattr(env.unwrapped, "robot", None)
            robot = f"a {moved.spec.name}" if moved is not None else "no robot of ours"
            if not robot.startswith(f"a {kind}"):
                say(f"{name}: note: {checkpoint.manifest.env} moves {robot}")
            clipped, successes = Clipped(policy, env.action_space), 0
            for number, record in enumerate(play(env, clipped, episodes=args.num_episodes, seed=args.seed), 1):
                successes += bool(record.success)
                how = "success" if record.success else "no success"
                cut = f"clipped {clipped.clipped} of {counted(record.length, 'action')}"
                print(f"episode {number}: return {record.total:.2f}, {how}, {cut}", flush=True)
            tell(f"success in {successes} of {counted(args.num_episodes, 'episode')} on {checkpoint.manifest.env}")


def main(script: str, description: str, default: str, kind: str) -> int:
    """Run `script`, whose docstring is `description`; its exit status.

    A directory that does not say where it was trained is tried on the environment `default`; the names of the robots
    that the script is for begin with `kind`.
    """
    name = Path(script).stem
    return guarded(lambda: run(parse(Flags, name, description=description), name, default, kind), name)
