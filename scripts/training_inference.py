"""Train, save, use the policy: what training_inference_mir.py, training_inference_ur.py and td3_mir.py share."""

import contextlib
import math
from collections.abc import Callable
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

Reports = Callable[[Progress, bool], tuple[str | None, bool]]


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


def learn(args: TrainingFlags, settings: Any, when: str, report: Reports, explores: bool = False) -> tuple[Any, Any]:
    """Train until all steps are done, `report` says that it is enough, or a signal comes; the checkpoint and a policy.

    `report` takes the progress and whether a signal came; its text is None where nothing is to be saved and told.
    """
    require_place(settings.env, args.robot, args.render)
    output = choose_output(settings, args.out, False, None)

    def goes_on(progress: Progress) -> bool:
        text, enough = report(progress, asked())
        if text is not None:
            trainer.save(output.path, {}, {})
            print(f"{text}, mean total reward {number(progress.statistics().return_mean)}", flush=True)
        return not (enough or asked())

    trainer: Any = load_trainer(settings.trainer).create(settings)
    with contextlib.closing(trainer):
        print(f"saving to {output.path} {when}", flush=True)
        with signals_ask() as asked:
            trainer.train(settings.steps, goes_on)
        return Checkpoint.open(output.path), trainer.exploring() if explores else FrozenPolicy.load(output.path)


def infer(args: TrainingFlags, learnt: tuple[Any, Any], episodes: int, seed: int, name: str) -> None:
    """Use a policy in an environment of its own: simulated, or a live robot's."""
    checkpoint, policy = learnt
    with open_env(checkpoint, args.robot, who=name, episodes=episodes, yes=args.yes, render=args.render) as env:
        for number, record in enumerate(play(env, policy, episodes=episodes, seed=FIRST_SEED + seed), 1):
            print(f"episode {number}: total reward {record.total:.2f}{', success' * bool(record.success)}", flush=True)


def train(args: Flags, experiment: Experiment) -> tuple[Any, Any]:
    """Train until something says stop, saving after every iteration; the checkpoint, and the policy to go on with."""
    from bam_train.trainers.base import cores

    runners, iterations = max(0, args.num_cpus - 1), 0
    given = environment_of(args, experiment.env, experiment.env_kwargs)
    given |= {"trainer": "rllib", "algo": args.run.lower(), "num_env_runners": runners}
    settings = resolve({**given, "seed": args.seed, "steps": experiment.stop_timesteps})
    if runners > cores():
        raise SettingsError(
            f"--num-cpus: expected at most {cores() + 1}, one to learn and one for each CPU of this computer, "
            f"found {args.num_cpus}"
        )

    def report(progress: Progress, asked: bool) -> tuple[str, bool]:
        nonlocal iterations
        iterations, mean = iterations + 1, progress.statistics().return_mean
        reached = mean is not None and mean >= experiment.stop_reward
        return f"iteration {iterations}: {progress.steps:,} steps", reached or iterations >= experiment.stop_iters

    return learn(args, settings, "after every iteration", report, args.explore_during_inference)


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

    def run() -> None:
        args, complete = read(script, description, experiment)
        infer(args, train(args, complete), args.num_episodes_during_inference, args.seed, name)

    return guarded(run, name)
