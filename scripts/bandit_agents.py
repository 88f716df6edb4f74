"""Three classic bandit agents on the interaction loop: epsilon-greedy, UCB and Thompson sampling, drawn to a PNG.

Every column of the workspace is a run of its own, so the curves are means over many runs. A reward of 1 is the
optimum: in every context one arm always wins.

Example:
    python scripts/bandit_agents.py --env bam/context-bandit --steps 1000
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import bam_envs  # noqa: F401 - registers the environments
from bam_train.loop import Agent, Agents, TemporalAgent, VecGymAgent, Workspace

ENVS = ("bam/classic-bandit", "bam/context-bandit")
Array = NDArray[np.float64]
Rule = Callable[[Array, Array, int, np.random.Generator], Array]  # wins and losses (runs, arms), t, rng -> values


def epsilon_greedy(wins: Array, losses: Array, t: int, rng: np.random.Generator, epsilon: float = 0.1) -> Array:
    mean = (wins + 1) / (wins + losses + 1)  # an arm that was never pulled counts as the best
    noise = rng.random(wins.shape)
    return np.where(rng.random((len(wins), 1)) < epsilon, noise, mean + 1e-6 * noise)


def ucb(wins: Array, losses: Array, t: int, rng: np.random.Generator) -> Array:
    pulls = np.maximum(wins + losses, 1e-9)  # an arm that was never pulled has a very large bound
    return np.asarray(wins / pulls + np.sqrt(0.5 * np.log(t + 1) / pulls) + 1e9 * (pulls < 1))


def thompson(wins: Array, losses: Array, t: int, rng: np.random.Generator) -> Array:
    return rng.beta(1 + wins, 1 + losses)


RULES: dict[str, Rule] = {"epsilon-greedy": epsilon_greedy, "UCB": ucb, "Thompson": thompson}


class BanditAgent(Agent):
    """Counts wins and losses of each arm in each context, and pulls the arm that its rule values most."""

    def __init__(self, rule: Rule, counts: tuple[int, int, int], seed: int) -> None:
        super().__init__()
        self.rule, self.rng, self.runs = rule, np.random.default_rng(seed), np.arange(counts[0])
        self.wins, self.losses = np.zeros(counts), np.zeros(counts)

    def forward(self, t: int, **kwargs: Any) -> None:
        """Learn from the last step, and act."""
        if t:
            pulled = (self.runs, self.get(("env/env_obs", t - 1)), self.get(("action", t - 1)))
            won = self.get(("env/reward", t)) > 0
            self.wins[pulled] += won
            self.losses[pulled] += ~won
        seen = (self.runs, self.get(("env/env_obs", t)))
        self.set(("action", t), self.rule(self.wins[seen], self.losses[seen], t, self.rng).argmax(axis=1))


def play(rule: Rule, env_id: str, runs: int, steps: int, seed: int, **options: Any) -> Array:
    """Mean reward of each step over the runs. Shape: (steps,)."""
    make = partial(gym.make_vec, env_id, num_envs=runs, **options)
    envs = VecGymAgent(make, include_last_state=False, arrays="numpy").seed(seed)
    task: Any = envs.envs.unwrapped.task
    agent = BanditAgent(rule, (runs, task.n_state, task.n_arms), seed)
    workspace = Workspace()
    TemporalAgent(Agents(envs, agent))(workspace, t=0, n_steps=steps + 1)
    envs.close()
    return np.asarray(workspace["env/reward"][1:].mean(axis=1))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENVS, default=ENVS[0], help=f"{' or '.join(ENVS)} (default: the first)")
    parser.add_argument("--arms", type=int, default=10, help="arms (default 10)")
    parser.add_argument("--runs", type=int, default=200, help="runs side by side (default 200)")
    parser.add_argument("--steps", type=int, default=300, help="steps of each run (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="seed of runs and agents (default 0)")
    parser.add_argument("--out", default="bandit-agents.png", help="the picture (default bandit-agents.png)")
    arguments = parser.parse_args()
    sizes, figure = (arguments.runs, arguments.steps, arguments.seed), Figure(figsize=(7, 4))
    axes = figure.add_subplot(xlabel="step", ylabel="mean reward", title=f"{arguments.env}, {arguments.runs} runs")
    for name, rule in RULES.items():
        rewards = play(rule, f"{arguments.env}-v0", *sizes, n_arms=arguments.arms)
        axes.plot(rewards, label=name)
        print(f"{name}: mean reward {rewards.mean():.3f}, at the end {rewards[-20:].mean():.3f}")
    axes.legend()
    figure.savefig(arguments.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
