"""Steps/s of RLlib's PPO with 0, 1 and 2 env runners, against stable-baselines3's PPO in the same run.

All have the same network, rollout and updates, on the same environment; what is measured is whole iterations, sampling
and learning, after a warm-up. For RLlib, the shares of an iteration say what bounds it: sampling (all runners at once),
the update, and handing out the new weights; the rest is RLlib's own bookkeeping. Run it on an idle machine.
"""

import contextlib
import time
from dataclasses import dataclass
from statistics import median

from bam_envs.core.errors import InvalidValue
from bam_train.cli.flags import Count, Seed
from tests.benchmarks import harness
from tests.benchmarks.harness import Row, at_least

TIMERS = {"sampling": "env_runner_sampling_timer", "update": "learner_update_timer", "weights": "synch_weights"}
"""Part of an iteration to RLlib's timer of it."""


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    env: str = "bam/pick"
    """Environment."""
    runners: tuple[Seed, ...] = (0, 1, 2)
    """Numbers of env runners."""
    num_envs: Count = 64
    """Environments in all, shared out among the runners."""
    batch: Count = 4096
    """Steps of an iteration."""
    minibatch: Count = 512
    """Steps of one gradient."""
    epochs: Count = 8
    """Passes over an iteration's steps."""


def settings(flags, runners):
    """The same run in the words of stable-baselines3 (`runners` is None) or RLlib."""
    if runners is None:
        own = {"n_steps": flags.batch // flags.num_envs, "batch_size": flags.minibatch, "n_epochs": flags.epochs}
        own["policy_kwargs"] = {"net_arch": [64, 64], "activation_fn": "tanh"}
        return {"trainer": "sb3", "device": "cpu", "hyperparameters": own}
    own = {"train_batch_size_per_learner": flags.batch, "minibatch_size": flags.minibatch, "num_epochs": flags.epochs}
    own["model_config"] = {"fcnet_hiddens": [64, 64], "fcnet_activation": "tanh", "vf_share_layers": False}
    return {"trainer": "rllib", "num_env_runners": runners, "hyperparameters": own}


def train(flags, runners):
    """Steps/s of each measured iteration, and the share of each of its parts."""
    from bam_train.trainers import load_trainer
    from bam_train.trainers.resolve_settings import resolve

    warm_up = flags.times(3)
    total = flags.batch * (warm_up + flags.times(15))
    run = {"env": flags.env, "algo": "ppo", "steps": total, "eval_every": total, "num_envs": flags.num_envs}
    complete = resolve({**run, **settings(flags, runners)})
    with contextlib.closing(load_trainer(complete.trainer).create(complete)) as trainer:
        rows = [(time.perf_counter(), 0, {})]

        def note(progress):
            rows.append((time.perf_counter(), progress.steps, dict(getattr(trainer, "timers", {}))))
            return True

        trainer.train(total, note)
    pairs = zip(rows[warm_up:], rows[warm_up + 1 :], strict=False)
    parts = [(after[0] - before[0], after[1] - before[1], after[2]) for before, after in pairs if after[1] > before[1]]
    whole, timers = median(seconds for seconds, _, _ in parts), {k: v for k, v in TIMERS.items() if v in parts[-1][2]}
    shares = {name: median(found[timer] for _, _, found in parts) / whole for name, timer in timers.items()}
    return [steps / seconds for seconds, steps, _ in parts], shares


def measure_trainers(flags):
    """Each trainer; the last one is held against the goal."""
    if any(flags.batch % flags.num_envs or flags.num_envs % max(1, runners) for runners in flags.runners):
        raise InvalidValue("--batch must be a multiple of --num-envs, and --num-envs of every number of --runners")
    reference = 0.0
    for runners in (None, *flags.runners):
        rates, shares = train(flags, runners)
        name = "sb3" if runners is None else f"rllib, {runners} runners"
        reference = reference or median(rates)
        yield Row(name, f"{median(rates):,.0f} steps/s ({min(rates):,.0f} to {max(rates):,.0f})")
        if shares:
            yield "  " + ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
    because = f", bounded by {max(shares, key=shares.get)}" if shares else ""
    yield at_least(f"{name}, of sb3{because}", median(rates) / reference, 0.5, "x")
