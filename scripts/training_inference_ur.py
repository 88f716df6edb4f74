"""Train a UR5 to bring its flange to a point with RLlib, save checkpoint.zip, and use it in a new environment.

Training ends at the first of --stop-iters, --stop-timesteps and --stop-reward. Ctrl-C ends it after the iteration that
is running; the checkpoint is saved then too. RLLIB_NUM_GPUS=1 learns on a GPU. An iteration of PPO, which is tuned
for this, has 4,096 steps; the others have RLlib's own settings: in one process 200 of SAC, 50 of APPO and IMPALA.

Examples:
  python scripts/training_inference_ur.py                                     PPO, in this process
  python scripts/training_inference_ur.py --num-cpus 3 --stop-reward 1.9      two other processes run the episodes
  python scripts/training_inference_ur.py --run SAC --stop-iters 50 --seed 1  another algorithm
  python scripts/training_inference_ur.py --robot ws://10.0.0.5:9090          train here, then move a real UR5
"""

import argparse
import contextlib
from pathlib import Path
from typing import Any

import gymnasium as gym

from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import number
from bam_train.cli.experiment import ScriptParser, ctrl_c_asks, open_env, require_address, require_cpus, whole
from bam_train.cli.program import guarded
from bam_train.evaluation import FIRST_SEED
from bam_train.policy import FrozenPolicy
from bam_train.trainers import load_trainer
from bam_train.trainers.output import choose_output
from bam_train.trainers.resolve import resolve
from bam_train.trainers.trainer import Progress

ENV = "bam/ur-reach-v0"  # robo-gym's own id works too: EndEffectorPositioningURSim-v0
ENV_KWARGS: dict[str, Any] = {"ur_model": "ur5"}
ENOUGH, MOST = 1.7, 600_000  # mean total reward at which almost every episode succeeds; steps
NAME = Path(__file__).stem


def train(args: argparse.Namespace) -> tuple[Checkpoint, Any]:
    """Train until something says stop; the checkpoint, and the policy to go on with."""
    given = {"env": ENV, "env_kwargs": ENV_KWARGS, "trainer": "rllib", "algo": args.run.lower(), "seed": args.seed}
    settings = resolve({**given, "steps": args.stop_timesteps, "num_env_runners": max(0, args.num_cpus - 1)})
    require_cpus(args.num_cpus)
    require_address(args.robot)
    output, iterations = choose_output(settings, None, False, None), 0

    def goes_on(progress: Progress) -> bool:
        nonlocal iterations
        iterations, mean = iterations + 1, progress.statistics().return_mean
        print(f"iteration {iterations}: {progress.steps:,} steps, mean total reward {number(mean)}", flush=True)
        reached = mean is not None and mean >= args.stop_reward
        return not (reached or iterations >= args.stop_iters or interrupted())

    trainer: Any = load_trainer("rllib").create(settings)
    with contextlib.closing(trainer):
        with ctrl_c_asks() as interrupted:
            trainer.train(settings.steps, goes_on)
            checkpoint = trainer.save(output.path, {}, {})
        print(f"saved {checkpoint.path}", flush=True)
        if interrupted():
            raise KeyboardInterrupt
        return checkpoint, trainer.exploring() if args.explore_during_inference else FrozenPolicy.load(checkpoint.path)


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
    with open_env(checkpoint, args.robot, who=NAME, episodes=episodes, yes=args.yes) as env:
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
    add("--stop-iters", type=whole(1), default=200, metavar="N", help="iterations to end after (default 200)")
    add("--stop-timesteps", type=whole(1), default=MOST, metavar="N", help=f"steps to end after (default {MOST})")
    add(
        "--stop-reward", type=float, default=ENOUGH, metavar="R", help=f"mean total reward to end at (default {ENOUGH})"
    )
    add("--explore-during-inference", action="store_true", help="draw actions as in training, not the best ones")
    add(
        "--num-episodes-during-inference", type=whole(1), default=10, metavar="N", help="episodes after it (default 10)"
    )
    add("--robot", metavar="URL", help="use the policy on a live robot behind rosbridge, such as ws://10.0.0.5:9090")
    add("--yes", action="store_true", help="do not ask before a real robot moves")
    add("--seed", type=whole(0), default=0, metavar="N", help="of weights, samples and episodes (default 0)")
    args: argparse.Namespace = parser.parse_args()
    if args.framework.lower() != "torch":
        parser.error(f"--framework {args.framework}: RLlib has nothing but torch any more; leave it out")
    if args.explore_during_inference and args.robot is not None:
        parser.error("--explore-during-inference draws actions at random, which is not for a live robot; leave it out")
    return args


if __name__ == "__main__":
    raise SystemExit(guarded(lambda: main(parse()), NAME))
