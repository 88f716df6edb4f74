"""Agents that do not learn, on the interaction loop: constant, random and, in the grid world, scripted; drawn to a PNG.

Example:
    python scripts/simple_agents.py --env bam/grid-world
    python scripts/simple_agents.py --env bam/digits --agents constant random
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
from bam_envs.core.registry import ENVIRONMENTS, resolve_id
from bam_train.loop import Agent, Agents, TemporalAgent, VecGymAgent, Workspace


class ConstantAgent(Agent):
    """Does at every time what it drew at the first."""

    def __init__(self, space: gym.Space[Any]) -> None:
        super().__init__()
        self.space, self.action = space, space.sample()

    def forward(self, t: int, **kwargs: Any) -> None:
        """Act."""
        self.set(("action", t), self.action)


class RandomAgent(ConstantAgent):
    """Draws anew at every time, whatever it sees."""

    def forward(self, t: int, **kwargs: Any) -> None:
        """Act."""
        self.set(("action", t), self.space.sample())


class ScriptedAgent(ConstantAgent):
    """Walks to the target of the grid world: along x first, then along y."""

    def forward(self, t: int, **kwargs: Any) -> None:
        """Act."""
        way = self.get(("env/env_obs/target", t)) - self.get(("env/env_obs/agent", t))
        along_x = np.where(way[:, 0] > 0, 0, 2)
        self.set(("action", t), np.where(way[:, 0] != 0, along_x, np.where(way[:, 1] > 0, 1, 3)))


AGENTS = {"constant": ConstantAgent, "random": RandomAgent, "scripted": ScriptedAgent}


def play(name: str, env_id: str, num_envs: int, steps: int, seed: int) -> NDArray[np.float64]:
    """Sum of rewards up to each step, a mean over the environments. Shape: (steps,)."""
    envs = VecGymAgent(partial(gym.make_vec, env_id, num_envs), include_last_state=False, arrays="numpy").seed(seed)
    space = envs.envs.action_space
    space.seed(seed)
    workspace = Workspace()
    TemporalAgent(Agents(envs, AGENTS[name](space)))(workspace, t=0, n_steps=steps + 1)
    envs.close()
    total: NDArray[np.float64] = workspace["env/reward"][1:].mean(axis=1).cumsum()
    return total


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="bam/grid-world", help="a local environment (default bam/grid-world)")
    parser.add_argument("--agents", nargs="+", choices=AGENTS, help="default: all that the environment has")
    parser.add_argument("--num-envs", type=int, default=100, help="environments side by side (default 100)")
    parser.add_argument("--steps", type=int, default=100, help="steps (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="seed (default 0)")
    parser.add_argument("--out", default="simple-agents.png", help="the picture (default simple-agents.png)")
    arguments = parser.parse_args()
    try:
        env_id = resolve_id(arguments.env)
    except BamEnvsError as error:
        parser.error(str(error))
    if env_id not in ENVIRONMENTS or ENVIRONMENTS[env_id].has_robot:
        parser.error(f"--env: {env_id} is no local environment; bam-envs lists them")
    names = arguments.agents or [name for name in AGENTS if name != "scripted" or env_id == "bam/grid-world-v0"]
    if "scripted" in names and env_id != "bam/grid-world-v0":
        parser.error(f"--agents: scripted is for bam/grid-world, not for {env_id}")
    figure = Figure(figsize=(7, 4))
    axes = figure.add_subplot(xlabel="step", ylabel="sum of rewards", title=env_id)
    for name in names:
        total = play(name, env_id, arguments.num_envs, arguments.steps, arguments.seed)
        axes.plot(total, label=name)
        print(f"{name}: {total[-1] / arguments.steps:.3f} a step")
    axes.legend()
    figure.savefig(arguments.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
