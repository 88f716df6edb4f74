"""Train with RLlib, save, use the policy: what training_inference_mir.py and training_inference_ur.py share."""

import argparse
import contextlib
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym

from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import number
from bam_train.cli.experiment import (
    ScriptParser,
    environment_of,
    open_env,
    require_place,
    signals_ask,
    whole,
)
from bam_train.cli.program import guarded
from bam_train.errors import SettingsError
from bam_train.evaluation import FIRST_SEED
from bam_train.policy import FrozenPolicy
from bam_train.trainers import load_trainer
from bam_train.trainers.base import Progress
from bam_train.trainers.best_checkpoint import choose_output
from bam_train.trainers.resolve_settings import resolve


@dataclass(frozen=True)
class Experiment:
    """What a script trains, and when that is enough."""

    env: str
    stop_reward: float
    """Mean total reward at which almost every episode succeeds."""
    stop_timesteps: int
    stop_iters: int
    env_kwargs: dict[str, Any] = field(default_factory=dict)


def train(args: argparse.Namespace, experiment: Experiment) -> tuple[Checkpoint, Any]:
    """Train until something says stop, saving after every iteration; the checkpoint, and the policy to go on with."""
    given = {
        **environment_of(args, experiment.env, experiment.env_kwargs),
        "trainer": "rllib",
        "algo": args.run.lower(),
    }
    runners = max(0, args.num_cpus - 1)
    settings = resolve({**given, "seed": args.seed, "steps": args.stop_timesteps, "num_env_runners": runners})
    from bam_train.trainers.rllib.ray_resources import cores

    if runners > cores():
        raise SettingsError(
            f"--num-cpus: expected at most {cores() + 1}, one to learn and one for each CPU of this computer, "
            f"found {args.num_cpus}"
        )
    require_place(settings.env, args.robot, args.render)
    output, iterations = choose_output(settings, args.out, False, None), 0

    def goes_on(progress: Progress) -> bool:
        nonlocal iterations
        iterations, mean = iterations + 1, progress.statistics().return_mean
        trainer.save(output.path, {}, {})
        print(f"iteration {iterations}: {progress.steps:,} steps, mean total reward {number(mean)}", flush=True)
        reached = mean is not None and mean >= args.stop_reward
        return not (reached or iterations >= args.stop_iters or asked())

    trainer: Any = load_trainer("rllib").create(settings)
    with contextlib.closing(trainer):
        print(f"saving to {output.path} after every iteration", flush=True)
        with signals_ask() as asked:
            trainer.train(settings.steps, goes_on)
        checkpoint = Checkpoint.open(output.path)
        return checkpoint, trainer.exploring() if args.explore_during_inference else FrozenPolicy.load(output.path)


def infer(env: gym.Env[Any, Any], policy: Any, episodes: int, seed: int) -> None:
    """Run episodes of the policy and print each one's total reward."""
    for k in range(episodes):
        observation, _ = env.reset(seed=seed + k)
        policy.reset()
        total, ended = 0.0, False
        while not ended:  # on a live robot, each step waits for the end of its period
            observation, reward, terminated, truncated, info = env.step(policy.act(observation))
            total, ended = total + float(reward), terminated or truncated
        print(f"episode {k + 1}: total reward {total:.2f}{', success' if info.get('is_success') else ''}", flush=True)


def run(args: argparse.Namespace, name: str, experiment: Experiment) -> None:
    """Train, then infer in an environment of its own: simulated, or a live robot's."""
    checkpoint, policy = train(args, experiment)
    episodes = args.num_episodes_during_inference
    watched = {"yes": args.yes, "render": args.render}
    with open_env(checkpoint, args.robot, who=name, episodes=episodes, **watched) as env:
        infer(env, policy, episodes, FIRST_SEED + args.seed)


def parse(script: str, description: str, experiment: Experiment) -> argparse.Namespace:
    """Read the command line."""
    parser = ScriptParser(script, description)
    add = parser.add_argument
    add("--run", default="PPO", metavar="NAME", help="algorithm of RLlib, in any case of letters (default PPO)")
    add(
        "--num-cpus", type=whole(0), default=0, metavar="N", help="one learns, the others run episodes (default 0: one)"
    )
    add("--framework", default="torch", metavar="NAME", help="torch; RLlib has no other any more")
    add(
        "--stop-iters",
        type=whole(1),
        default=experiment.stop_iters,
        metavar="N",
        help="iterations (default %(default)s)",
    )
    add(
        "--stop-timesteps",
        type=whole(1),
        default=experiment.stop_timesteps,
        metavar="N",
        help="steps (default %(default)s)",
    )
    add(
        "--stop-reward",
        type=float,
        metavar="R",
        help=f"mean total reward to end at (default {experiment.stop_reward} on {experiment.env})",
    )
    add("--explore-during-inference", action="store_true", help="draw actions as in training, not the best ones")
    add(
        "--num-episodes-during-inference", type=whole(1), default=10, metavar="N", help="episodes after it (default 10)"
    )
    add("--seed", type=whole(0), default=0, metavar="N", help="of weights, samples and episodes (default 0)")
    parser.add_environment(experiment.env)
    parser.add_robot()
    args: argparse.Namespace = parser.parse_args()
    if args.stop_reward is None:  # rewards of other environments are of another size
        args.stop_reward = math.inf if args.env or args.parity else experiment.stop_reward
    if args.framework.lower() != "torch":
        parser.error(f"--framework {args.framework}: RLlib has nothing but torch any more; leave it out")
    if args.explore_during_inference and args.robot is not None:
        parser.error("--explore-during-inference draws actions at random, which is not for a live robot; leave it out")
    return args


def main(script: str, description: str, experiment: Experiment) -> int:
    """Run `script`, whose docstring is `description`; its exit status."""
    name = Path(script).stem
    return guarded(lambda: run(parse(script, description, experiment), name, experiment), name)
