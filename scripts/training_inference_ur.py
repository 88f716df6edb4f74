"""Train a UR5 to bring its flange to a point with RLlib, save checkpoint.zip, and use it in a new environment.

Training ends at the first of --stop-iters, --stop-timesteps and --stop-reward. The checkpoint is saved after every
iteration, so whatever ends the program leaves the last one, and bam-train --resume goes on from it; Ctrl-C and SIGTERM
wait for the end of an iteration. RLLIB_NUM_GPUS=1 learns on a GPU. An iteration of PPO, which is tuned for this, has
4,096 steps; the others have RLlib's own settings: in one process 200 of SAC, 50 of APPO and IMPALA.

Examples:
  python scripts/training_inference_ur.py                                     PPO, in this process
  python scripts/training_inference_ur.py --num-cpus 3 --stop-reward 1.9      two other processes run the episodes
  python scripts/training_inference_ur.py --run SAC --stop-iters 50 --seed 1  another algorithm
  python scripts/training_inference_ur.py --env EndEffectorPositioningURSim-v0 --parity --render
  python scripts/training_inference_ur.py --robot ws://10.0.0.5:9090          train here, then move a real UR5
"""

import argparse
import contextlib
import math
from pathlib import Path
from typing import Any

import gymnasium as gym

from bam_train.checkpoint import Checkpoint
from bam_train.cli import experiment
from bam_train.cli.console import number
from bam_train.cli.experiment import ScriptParser, open_env, whole
from bam_train.cli.program import guarded
from bam_train.evaluation import FIRST_SEED
from bam_train.policy import FrozenPolicy
from bam_train.trainers import load_trainer
from bam_train.trainers.best_checkpoint import choose_output
from bam_train.trainers.resolve import resolve
from bam_train.trainers.trainer import Progress

ENV = "bam/ur-reach-v0"
ENV_KWARGS: dict[str, Any] = {"ur_model": "ur5"}
ENOUGH, MOST, ITERATIONS = 1.88, 1_500_000, 400  # mean total reward at which 97 % of episodes succeed; steps
NAME = Path(__file__).stem


def train(args: argparse.Namespace) -> tuple[Checkpoint, Any]:
    """Train until something says stop, saving after every iteration; the checkpoint, and the policy to go on with."""
    given = {**experiment.environment_of(args, ENV, ENV_KWARGS), "trainer": "rllib", "algo": args.run.lower()}
    runners = max(0, args.num_cpus - 1)
    settings = resolve({**given, "seed": args.seed, "steps": args.stop_timesteps, "num_env_runners": runners})
    experiment.require_cpus(args.num_cpus)
    experiment.require_place(settings.env, args.robot, args.render)
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
        with experiment.signals_ask() as asked:
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


def main(args: argparse.Namespace) -> None:
    """Train, then infer in an environment of its own: simulated, or a live robot's."""
    checkpoint, policy = train(args)
    episodes = args.num_episodes_during_inference
    watched = {"yes": args.yes, "render": args.render}
    with open_env(checkpoint, args.robot, who=NAME, episodes=episodes, **watched) as env:
        infer(env, policy, episodes, FIRST_SEED + args.seed)


def parse() -> argparse.Namespace:
    """Read the command line."""
    parser = ScriptParser(__file__, __doc__)
    add = parser.add_argument
    add("--run", default="PPO", metavar="NAME", help="algorithm of RLlib, in any case of letters (default PPO)")
    add(
        "--num-cpus", type=whole(0), default=0, metavar="N", help="one learns, the others run episodes (default 0: one)"
    )
    add("--framework", default="torch", metavar="NAME", help="torch; RLlib has no other any more")
    add("--stop-iters", type=whole(1), default=ITERATIONS, metavar="N", help=f"iterations (default {ITERATIONS})")
    add("--stop-timesteps", type=whole(1), default=MOST, metavar="N", help=f"steps to end after (default {MOST})")
    add("--stop-reward", type=float, metavar="R", help=f"mean total reward to end at (default {ENOUGH} on {ENV})")
    add("--explore-during-inference", action="store_true", help="draw actions as in training, not the best ones")
    add(
        "--num-episodes-during-inference", type=whole(1), default=10, metavar="N", help="episodes after it (default 10)"
    )
    add("--seed", type=whole(0), default=0, metavar="N", help="of weights, samples and episodes (default 0)")
    parser.add_environment(ENV)
    parser.add_robot()
    args: argparse.Namespace = parser.parse_args()
    if args.stop_reward is None:  # rewards of other environments are of another size
        args.stop_reward = math.inf if args.env or args.parity else ENOUGH
    if args.framework.lower() != "torch":
        parser.error(f"--framework {args.framework}: RLlib has nothing but torch any more; leave it out")
    if args.explore_during_inference and args.robot is not None:
        parser.error("--explore-during-inference draws actions at random, which is not for a live robot; leave it out")
    return args


if __name__ == "__main__":
    raise SystemExit(guarded(lambda: main(parse()), NAME))
