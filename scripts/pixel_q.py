"""Learn where to touch: a Q for each pixel, from a small network of convolutions, on the interaction loop.

The same network looks at every place of the picture, so what one touch teaches holds everywhere; PPO, which knows
nothing of that, would have to learn 65,536 pixels one by one. The learning curve is drawn to a PNG, and the policy
written as a checkpoint that bam-eval and bam-deploy take.

Example:
    python scripts/pixel_q.py --checkpoint grasp-xy.zip
    bam-eval grasp-xy.zip
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import nn

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import GOLDEN, POLICY, write_checkpoint
from bam_train.loop import Agent, Agents, TemporalAgent, VecGymAgent, Workspace
from bam_train.trainers.base import origin
from bam_train.trainers.frozen_network import FrozenNetwork, Layer, pack

ENV, CELL = "bam/grasp-xy-v0", 4
"""The environment, and the pixels along each side of a cell: there is one Q for each cell."""


class BestCell(Layer):
    """The pixel in the middle of the best cell: x and y. Shape: (n, cells) -> (n, 2)."""

    def __init__(self, columns: int) -> None:
        super().__init__()
        cells = torch.arange(columns**2)
        self.pixels = CELL * torch.stack([cells % columns, cells // columns], 1) + CELL // 2

    def forward(self, scores: torch.Tensor) -> torch.Tensor:
        """Touch the best cell."""
        return self.pixels.index_select(0, scores.argmax(1))

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        """How much better the best cell is than the next one. Shape: (n,)."""
        best = scores.topk(2)[0]
        return best[:, 0] - best[:, 1]


class PixelQ(FrozenNetwork):
    """Pictures (n, 256, 256, 3) uint8 to the Q of 64 x 64 cells."""

    def __init__(self, space: gym.Space[Any]) -> None:
        super().__init__(space)
        self.columns = (space.shape or ())[1] // CELL
        self.head: BestCell = BestCell(self.columns)
        convolutions = nn.Conv2d(3, 8, 3, padding=1), nn.ReLU(), nn.Conv2d(8, 1, 1)
        self.net = nn.Sequential(nn.AvgPool2d(CELL), *convolutions, nn.Flatten())

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """Q of each cell."""
        return self.net(observation[0].permute(0, 3, 1, 2).float() / 255)


class ExploringAgent(Agent):
    """Touches the best cell, or with probability `epsilon`, which falls to 0, any; it learns from the last touches."""

    def __init__(self, q: PixelQ, steps: int) -> None:
        super().__init__()
        self.q, self.steps, self.adam = q, steps, torch.optim.Adam(q.parameters(), 1e-2)

    def forward(self, t: int, step: int, **kwargs: Any) -> None:
        """Learn from the last step, and act."""
        if t:
            seen, cells = self.get(("env/env_obs", t - 1)), self.get(("cell", t - 1))
            rewards = self.get(("env/reward", t))
            for _ in range(4):
                values = self.q.scores(seen).gather(1, cells[:, None])[:, 0]
                self.adam.zero_grad()
                nn.functional.mse_loss(values, rewards).backward()
                self.adam.step()
        with torch.no_grad():
            cells = self.q.scores(self.get(("env/env_obs", t))).argmax(1)
        explores = torch.rand(len(cells)) < 1 - step / self.steps
        cells = torch.where(explores, torch.randint(len(self.q.head.pixels), cells.shape), cells)
        self.set(("cell", t), cells)
        self.set(("action", t), self.q.head.pixels[cells])


def learn(steps: int, num_envs: int, seed: int) -> tuple[PixelQ, list[float]]:
    """The network, and the mean reward of each step."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    envs = VecGymAgent(partial(gym.make_vec, ENV, num_envs=num_envs), include_last_state=False).seed(seed)
    q = PixelQ(envs.observation_space)
    loop, workspace = TemporalAgent(Agents(envs, ExploringAgent(q, steps))), Workspace()
    loop(workspace, t=0, n_steps=1, step=0)
    rewards = []
    for step in range(1, steps):
        workspace.copy_n_last_steps(1)  # pictures are large: keep two times of them
        loop(workspace, t=1, n_steps=1, step=step)
        rewards.append(workspace["env/reward"][1].mean().item())
    envs.close()
    return q, rewards


def save(q: PixelQ, path: Path, steps: int, seed: int) -> None:
    """Write the checkpoint."""
    env = gym.make(ENV)
    inner: Any = env.unwrapped
    coarse = np.random.default_rng(0).integers(256, size=(4, q.columns, q.columns, 3), dtype=np.uint8)
    golden = {"": coarse.repeat(CELL, axis=1).repeat(CELL, axis=2)}  # which can be compressed
    with torch.no_grad():
        members = {POLICY: q.onnx_file(), GOLDEN: pack(golden, q(torch.as_tensor(golden[""])).numpy())}
    spaces = {name: space_to_json(getattr(env, name)) for name in ("observation_space", "action_space")}
    facts = {"env": ENV, "env_kwargs": {}, "signals": inner.describe(), "period": inner.period, "seed": seed}
    made = {"algorithm": "pixel-q", "trainer": "script", "settings": {}, "steps": steps, "scores": {}}
    write_checkpoint(path, {**facts, **spaces, **made, **origin()}, members)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=32, help="pictures a step (default 32)")
    parser.add_argument("--steps", type=int, default=100, help="steps (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="seed (default 0)")
    parser.add_argument("--out", default="pixel-q.png", help="the picture (default pixel-q.png)")
    parser.add_argument("--checkpoint", type=Path, help="write the policy there; by default nowhere")
    arguments = parser.parse_args()
    q, rewards = learn(arguments.steps, arguments.num_envs, arguments.seed)
    hits = np.array(rewards) / 2 + 0.5
    print(f"hits: {hits.mean():.1%} of all touches, {hits[-10:].mean():.1%} of those of the last ten steps")
    figure = Figure(figsize=(7, 4))
    figure.add_subplot(xlabel="step", ylabel="mean reward", title=ENV).plot(rewards)
    figure.savefig(arguments.out)
    if arguments.checkpoint is not None:
        save(q, arguments.checkpoint, arguments.steps * arguments.num_envs, arguments.seed)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
