"""Train with RLlib, save, use the policy: what training_inference_mir.py and training_inference_ur.py share."""

import contextlib
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import number
from bam_train.cli.experiment import TrainingFlags, environment_of, open_env, play, require_place, signals_ask
from bam_train.cli.flags import Count, Seed
from bam_train.cli.program import guarded, parse
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


@dataclass(frozen=True, kw_only=True)
class Flags(TrainingFlags):
    """How it trains, when that is enough, and how the policy is used."""

    run: str = "PPO"
    """Algorithm of RLlib, in any case of letters."""
    num_cpus: Seed = 0
    """One learns, the others run episodes; 0 is one."""
    framework: str = "torch"
    """RLlib has no other any more."""
    stop_iters: Annotated[Count | None, arg(metavar="N")] = None
    """Iterations, by default those of the experiment."""
    stop_timesteps: Annotated[Count | None, arg(metavar="N")] = None
    """Steps, by default those of the experiment."""
    stop_reward: Annotated[float | None, arg(metavar="R")] = None
    """Mean total reward to end at, by default the one at which almost every episode of the experiment succeeds."""
    explore_during_inference: bool = False
    """Draw actions as in training, not the best ones."""
    num_episodes_during_inference: Count = 10
    """Episodes after training."""
    seed: Seed = 0
    """Of weights, samples and episodes."""


def train(args: Flags, experiment: Experiment) -> tuple[Checkpoint, Any]:
    """Train until something says stop, saving after every iteration; the checkpoint, and the policy to go on with."""
    given = {
        **environment_of(args, experiment.env, experiment.env_kwargs),
        "trainer": "rllib",
        "algo": args.run.lower(),
    }
    runners = max(0, args.num_cpus - 1)
    settings = resolve({**given, "seed": args.seed, "steps": experiment.stop_timesteps, "num_env_runners": runners})
    from bam_train.trainers.base import cores

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
        reached = mean is not None and mean >= experiment.stop_reward
        return not (reached or iterations >= experiment.stop_iters or asked())

    trainer: Any = load_trainer("rllib").create(settings)
    with contextlib.closing(trainer):
        print(f"saving to {output.path} after every iteration", flush=True)
        with signals_ask() as asked:
            trainer.train(settings.steps, goes_on)
        checkpoint = Checkpoint.open(output.path)
        return checkpoint, trainer.exploring() if args.explore_during_inference else FrozenPolicy.load(output.path)


def run(args: Flags, experiment: Experiment, name: str) -> None:
    """Train, then infer in an environment of its own: simulated, or a live robot's."""
    checkpoint, policy = train(args, experiment)
    episodes = args.num_episodes_during_inference
    watched = {"yes": args.yes, "render": args.render}
    with open_env(checkpoint, args.robot, who=name, episodes=episodes, **watched) as env:
        for number, record in enumerate(play(env, policy, episodes=episodes, seed=FIRST_SEED + args.seed), 1):
            print(f"episode {number}: total reward {record.total:.2f}{', success' * bool(record.success)}", flush=True)


def read(script: str, description: str, experiment: Experiment) -> tuple[Flags, Experiment]:
    """The command line, and the experiment with its numbers."""
    args = parse(Flags, Path(script).stem, description=description)
    if args.framework.lower() != "torch":
        raise SettingsError(f"--framework {args.framework}: RLlib has nothing but torch any more; leave it out")
    if args.explore_during_inference and args.robot is not None:
        raise SettingsError(
            "--explore-during-inference draws actions at random, which is not for a live robot; leave it out"
        )
    # Rewards of other environments are of another size.
    enough = math.inf if args.env or args.parity else experiment.stop_reward
    return args, replace(
        experiment,
        stop_iters=args.stop_iters or experiment.stop_iters,
        stop_timesteps=args.stop_timesteps or experiment.stop_timesteps,
        stop_reward=enough if args.stop_reward is None else args.stop_reward,
    )


def main(script: str, description: str, experiment: Experiment) -> int:
    """Run `script`, whose docstring is `description`; its exit status."""
    name = Path(script).stem
    return guarded(lambda: run(*read(script, description, experiment), name), name)
