"""How many steps/s RLlib's PPO trains with 0, 1 and 2 env runners, against stable-baselines3's PPO in the same run.

All have the same network, rollout and updates, on the same environment; what is measured is whole iterations, sampling
and learning, after a warm-up. For RLlib, the shares of an iteration say what bounds it: sampling (all runners at once),
the update, and handing out the new weights; the rest is RLlib's own bookkeeping. Run it on an idle machine.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import Any

TARGET = 0.5
"""Steps/s with most runners, as a share of stable-baselines3's."""

TIMERS = {"sampling": "env_runner_sampling_timer", "update": "learner_update_timer", "weights": "synch_weights"}
"""Part of an iteration to RLlib's timer of it."""


@dataclass(frozen=True)
class Result:
    """What one trainer came to."""

    name: str
    rates: list[float]
    """Steps/s of each iteration."""
    shares: dict[str, float] = field(default_factory=dict)
    """Part of an iteration to its share of the time."""

    @property
    def rate(self) -> float:
        """Median steps/s."""
        return median(self.rates)


def main() -> int:
    """Read the options, run, print; 1 when the target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="bam/pick", help="environment")
    parser.add_argument("--runners", type=int, nargs="+", default=[0, 1, 2], help="numbers of env runners")
    parser.add_argument("--num-envs", type=int, default=64, help="environments in all, shared out among the runners")
    parser.add_argument("--batch", type=int, default=4096, help="steps of an iteration")
    parser.add_argument("--minibatch", type=int, default=512, help="steps of one gradient")
    parser.add_argument("--epochs", type=int, default=8, help="passes over an iteration's steps")
    parser.add_argument("--iterations", type=int, default=15, help="iterations that are measured")
    parser.add_argument("--warm-up", type=int, default=3, help="iterations before them")
    options = parser.parse_args()
    counts = [options.num_envs, options.batch, options.minibatch, options.epochs, options.iterations]
    if min(counts) < 1 or min(options.warm_up, *options.runners) < 0:
        parser.error("every number must be at least 1, those of runners and of the warm-up at least 0")
    if any(options.batch % options.num_envs or options.num_envs % max(1, runners) for runners in options.runners):
        parser.error("--batch must be a multiple of --num-envs, and --num-envs of every number of runners")
    reference = measure("sb3", sb3_settings(options), options)
    print(line(reference, reference), flush=True)
    results = []
    for runners in options.runners:
        results.append(measure(f"rllib, {runners} runners", rllib_settings(options, runners), options))
        print(line(results[-1], reference), flush=True)
    return report(results[-1], reference)


def sb3_settings(options: argparse.Namespace) -> dict[str, Any]:
    """stable-baselines3's names for what is the same for all."""
    return {
        "trainer": "sb3",
        "num_envs": options.num_envs,
        "device": "cpu",
        "hyperparameters": {
            "n_steps": options.batch // options.num_envs,
            "batch_size": options.minibatch,
            "n_epochs": options.epochs,
            "policy_kwargs": {"net_arch": [64, 64], "activation_fn": "tanh"},
        },
    }


def rllib_settings(options: argparse.Namespace, runners: int) -> dict[str, Any]:
    """RLlib's names for what is the same for all."""
    return {
        "trainer": "rllib",
        "num_env_runners": runners,
        "num_envs": options.num_envs,
        "hyperparameters": {
            "train_batch_size_per_learner": options.batch,
            "minibatch_size": options.minibatch,
            "num_epochs": options.epochs,
            "model_config": {"fcnet_hiddens": [64, 64], "fcnet_activation": "tanh", "vf_share_layers": False},
        },
    }


def measure(name: str, settings: dict[str, Any], options: argparse.Namespace) -> Result:
    """Train for the iterations asked for, and time each from its first step to its last update."""
    from bam_train.trainers import load_trainer
    from bam_train.trainers.resolve_settings import resolve

    total = options.batch * (options.warm_up + options.iterations)
    complete = resolve({"env": options.env, "algo": "ppo", "steps": total, "eval_every": total, **settings})
    with contextlib.closing(load_trainer(complete.trainer).create(complete)) as trainer:
        clock = Clock(lambda: timings(trainer))
        trainer.train(total, clock)
        return Result(name, clock.rates(options.warm_up), clock.shares(options.warm_up))


class Clock:
    """Notes time, steps and timers between two iterations.

    Args:
        timers: Seconds of each part of the last iteration.
    """

    def __init__(self, timers: Callable[[], dict[str, float]]) -> None:
        self._timers = timers
        self._rows: list[tuple[float, int, dict[str, float]]] = [(time.perf_counter(), 0, {})]

    def __call__(self, progress: Any) -> bool:
        """Note one; training goes on."""
        self._rows.append((time.perf_counter(), progress.steps, self._timers()))
        return True

    def rates(self, skip: int) -> list[float]:
        """Steps/s of each iteration after the first `skip`."""
        return [steps / seconds for seconds, steps, _ in self._iterations(skip)]

    def shares(self, skip: int) -> dict[str, float]:
        """Share of each part in the iterations after the first `skip`, by medians."""
        rows = list(self._iterations(skip))
        whole = median(seconds for seconds, _, _ in rows)
        return {name: median(timers[name] for _, _, timers in rows) / whole for name in rows[0][2]}

    def _iterations(self, skip: int) -> Iterator[tuple[float, int, dict[str, float]]]:
        for (before, start, _), (after, end, timers) in zip(self._rows[skip:], self._rows[skip + 1 :], strict=False):
            if end > start:
                yield after - before, end - start, timers


def timings(trainer: Any) -> dict[str, float]:
    """The parts of RLlib's last iteration [s]; smoothed, so only their medians are of use."""
    timers = getattr(trainer, "timers", {})
    return {name: float(timers[timer]) for name, timer in TIMERS.items() if timer in timers}


def line(result: Result, reference: Result) -> str:
    """One trainer in one line."""
    slow, fast = min(result.rates), max(result.rates)
    shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in result.shares.items())
    ratio = result.rate / reference.rate
    return f"{result.name:<17} {result.rate:>8,.0f} steps/s ({slow:,.0f} to {fast:,.0f})  ratio {ratio:.2f}  {shares}"


def report(result: Result, reference: Result) -> int:
    """Print the last trainer's figure against its target."""
    ratio = result.rate / reference.rate
    met = ratio >= TARGET
    bound = max(result.shares, key=result.shares.__getitem__, default="")
    because = f", bounded by: {bound}" if bound else ""
    print(f"{result.name}: {ratio:.2f} of sb3, target {TARGET:.2f}  {'met' if met else 'MISSED'}{because}")
    return 0 if met else 1


if __name__ == "__main__":
    from bam_train.cli.program import guarded

    sys.exit(guarded(main, "bench_scale.py"))
