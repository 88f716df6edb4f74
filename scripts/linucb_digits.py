"""LinUCB reads digits, on the interaction loop: a linear bandit on 64 pixels; the learning curve is drawn to a PNG.

For each digit it keeps a ridge regression of the reward, and chooses the digit with the greatest upper bound:
w x + alpha sqrt(x' A^-1 x), with A = I + sum of x x'.

Example:
    python scripts/linucb_digits.py --steps 1500
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import bam_envs  # noqa: F401 - registers the environments
from bam_train.loop import Agent, Agents, TemporalAgent, VecGymAgent, Workspace


class LinUCB(Agent):
    """A ridge regression for each action; it learns from the whole batch at once."""

    def __init__(self, features: int, actions: int, alpha: float) -> None:
        super().__init__()
        self.alpha, self.inverse = alpha, np.repeat(np.eye(features + 1)[None], actions, axis=0)
        self.moments, self.sums = self.inverse.copy(), np.zeros((actions, features + 1))

    def seen(self, t: int) -> NDArray[np.float64]:
        """Pixels and a one. Shape: (n, features + 1)."""
        pixels = self.get(("env/env_obs", t))
        return np.concatenate([pixels.reshape(len(pixels), -1), np.ones((len(pixels), 1))], axis=1)

    def forward(self, t: int, learns: bool = True, **kwargs: Any) -> None:
        """Learn from the last step, and act."""
        if t and learns:
            before, done, reward = self.seen(t - 1), self.get(("action", t - 1)), self.get(("env/reward", t))
            for action in np.unique(done):
                x = before[done == action]
                self.moments[action] += x.T @ x
                self.sums[action] += reward[done == action] @ x
                self.inverse[action] = np.linalg.inv(self.moments[action])
        x = self.seen(t)
        weights = np.einsum("aij,aj->ai", self.inverse, self.sums)
        bonus = np.sqrt(np.einsum("ni,aij,nj->na", x, self.inverse, x, optimize=True))
        self.set(("action", t), (x @ weights.T + self.alpha * learns * bonus).argmax(axis=1))


def run(agent: LinUCB, split: str, num_envs: int, steps: int, seed: int, *, learns: bool) -> NDArray[np.float64]:
    """Mean reward of each step. Shape: (steps,)."""
    make = partial(gym.make_vec, "bam/digits-v0", num_envs=num_envs, split=split)
    envs = VecGymAgent(make, include_last_state=False, arrays="numpy").seed(seed)
    workspace = Workspace()
    TemporalAgent(Agents(envs, agent))(workspace, t=0, n_steps=steps + 1, learns=learns)
    envs.close()
    rewards: NDArray[np.float64] = workspace["env/reward"][1:].mean(axis=1)
    return rewards


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=16, help="pictures a step (default 16)")
    parser.add_argument("--steps", type=int, default=1000, help="steps (default 1000)")
    parser.add_argument("--alpha", type=float, default=0.5, help="weight of what is uncertain (default 0.5)")
    parser.add_argument("--seed", type=int, default=0, help="seed (default 0)")
    parser.add_argument("--out", default="linucb-digits.png", help="the picture (default linucb-digits.png)")
    arguments = parser.parse_args()
    agent = LinUCB(64, 10, arguments.alpha)
    rewards = run(agent, "train", arguments.num_envs, arguments.steps, arguments.seed, learns=True)
    tested = run(agent, "test", 100, 20, arguments.seed + 1, learns=False).mean()
    print(f"right while it learnt: {rewards.mean():.1%}; of the test split: {tested:.1%}")
    figure = Figure(figsize=(7, 4))
    axes = figure.add_subplot(xlabel="step", ylabel="share of right digits", title=f"test split: {tested:.1%}")
    axes.plot(np.cumsum(rewards) / np.arange(1, len(rewards) + 1))
    figure.savefig(arguments.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
