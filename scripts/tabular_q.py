"""Tabular Q-learning in the grid world, on the interaction loop: the learning curve and the policy, drawn to a PNG.

Example:
    python scripts/tabular_q.py --size 5
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
from bam_envs.core.errors import BamEnvsError
from bam_envs.local.grid_world import MOVES
from bam_train.loop import Agent, Agents, TemporalAgent, VecGymAgent, Workspace


class QAgent(Agent):
    """Q of every pair of cells and move; epsilon-greedy while it learns, greedy with ``learns=False``."""

    def __init__(self, size: int, *, rate: float, gamma: float, epsilon: float, seed: int) -> None:
        super().__init__()
        self.size, self.rate, self.gamma, self.epsilon = size, rate, gamma, epsilon
        self.table, self.rng = np.zeros((size**4, 4)), np.random.default_rng(seed)

    def state(self, t: int) -> NDArray[np.int64]:
        """Number of the pair of cells, agent and target. Shape: (n,)."""
        cells = np.concatenate([self.get((f"env/env_obs/{name}", t)) for name in ("agent", "target")], axis=1)
        numbers: NDArray[np.int64] = cells @ self.size ** np.arange(4)
        return numbers

    def forward(self, t: int, learns: bool = True, **kwargs: Any) -> None:
        """Learn from the last step, and act."""
        state = self.state(t)
        if t and learns:
            before, action = self.state(t - 1), self.get(("action", t - 1))
            ends, lasted = self.get(("env/terminated", t)), self.get(("env/timestep", t)) > 0
            target = self.get(("env/reward", t)) + self.gamma * ~ends * self.table[state].max(axis=1)
            error = np.where(lasted, target - self.table[before, action], 0.0)  # none across a reset
            np.add.at(self.table, (before, action), self.rate * error)
        best = (self.table[state] + 1e-6 * self.rng.random((len(state), 4))).argmax(axis=1)
        explores = self.rng.random(len(state)) < (self.epsilon if learns else 0.0)
        self.set(("action", t), np.where(explores, self.rng.integers(4, size=len(state)), best))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=5, help="cells along each side (default 5)")
    parser.add_argument("--num-envs", type=int, default=32, help="environments side by side (default 32)")
    parser.add_argument("--steps", type=int, default=6000, help="steps of each (default 6000)")
    parser.add_argument("--rate", type=float, default=0.3, help="learning rate (default 0.3)")
    parser.add_argument("--gamma", type=float, default=0.9, help="discount of a step (default 0.9)")
    parser.add_argument("--epsilon", type=float, default=0.3, help="share of random moves (default 0.3)")
    parser.add_argument("--seed", type=int, default=0, help="seed (default 0)")
    parser.add_argument("--out", default="tabular-q.png", help="the picture (default tabular-q.png)")
    arguments = parser.parse_args()
    make = partial(gym.make_vec, "bam/grid-world-v0", num_envs=arguments.num_envs, size=arguments.size)
    try:
        envs, tests = (VecGymAgent(make, arrays="numpy").seed(arguments.seed + k) for k in (0, 100_000))
    except BamEnvsError as error:
        parser.error(str(error))
    rates = {name: getattr(arguments, name) for name in ("rate", "gamma", "epsilon", "seed")}
    agent = QAgent(arguments.size, **rates)
    workspace = Workspace()
    TemporalAgent(Agents(envs, agent))(workspace, t=0, n_steps=arguments.steps)
    trial = Workspace()
    TemporalAgent(Agents(tests, agent))(trial, t=0, n_steps=500, learns=False)
    ended, lengths = trial["env/done"], trial["env/timestep"]
    first = np.abs(trial["env/env_obs/target"] - trial["env/env_obs/agent"]).sum(axis=2)[lengths == 0]
    print(f"{ended.sum()} episodes of {lengths[ended].mean():.2f} steps; the shortest ways have {first.mean():.2f}")
    figure = Figure(figsize=(10, 4))
    left, right = figure.subplots(1, 2)
    window = max(1, arguments.steps // 50)
    smooth = np.convolve(workspace["env/reward"].mean(axis=1), np.ones(window) / window, "valid")
    left.plot(smooth)
    left.set(xlabel="step", ylabel="reward a step", title="while it learns")
    x, y = np.meshgrid(np.arange(arguments.size), np.arange(arguments.size), indexing="ij")
    middle = arguments.size // 2
    states = x + y * arguments.size + middle * arguments.size**2 + middle * arguments.size**3
    moves = MOVES[agent.table[states].argmax(axis=2)] * ((x != middle) | (y != middle))[..., None]
    right.quiver(x, y, moves[..., 0], moves[..., 1], pivot="mid")
    right.set(title="moves to the target in the middle", aspect="equal")
    right.plot(middle, middle, "rs")
    figure.savefig(arguments.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
