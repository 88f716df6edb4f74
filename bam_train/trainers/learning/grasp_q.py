"""`GraspTrainer`: learns which grasps of a picture succeed, from its own attempts.

Every episode is one decision, so there is no future to estimate: the network learns the probability of success (Q of a
contextual bandit), by the cross entropy. Attempts begin at random places above the table; later the best of some random
candidates is tried. A step of the run is a grasp.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from bam_train.environments import make_vector_env
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.rollout import PlayedEpisode
from bam_train.settings import TrainSettings
from bam_train.trainers.learning.grasp_network import HEIGHT_UNIT, Bytes, GraspNetwork, GraspPolicy, Grid
from bam_train.trainers.learning.networks import Descent, cosine
from bam_train.trainers.learning.replay_memory import ReplayMemory
from bam_train.trainers.learning.torch_trainer import TorchTrainer

_ABOVE = 20  # least height of a place that is tried, in units of `HEIGHT_UNIT`
_ANYWHERE = 0.1  # share of candidates at any place
_GOLDEN = 4  # pictures in a checkpoint
_GRASPS = ("patches", "widths", "rewards")


class GraspTrainer(TorchTrainer[TrainSettings]):
    """Made by `create` or `load`; the policy that is played chooses what to try."""

    recent = 200

    def __init__(self, settings: TrainSettings) -> None:
        super().__init__(settings)
        self.envs = make_vector_env(settings.env, settings.env_kwargs, settings.num_envs, settings.place)
        self.spaces = self.envs.single_observation_space, self.envs.single_action_space
        self.grid = Grid.of(*self.spaces)
        self.network = GraspNetwork(self.options.channels, self.grid.widths)
        self._optimiser = Descent("network", self.network.parameters(), self.options.learning_rate)
        self.parts = {"network": self.network, "optimiser": self._optimiser, "rng": self._rng}
        self.memory = ReplayMemory(settings.steps + settings.num_envs)
        """All grasps: patches (n, 33, 33) uint8, widths (n,) int64, rewards (n,) float32."""
        self._observation: Any = None
        self._tried: dict[str, Any] = {}  # patches and widths of the last grasps
        self._table = 0.0  # depth of the table [m]
        self.play(seed=settings.seed)

    @classmethod
    def require_spaces(cls, observation: Any, action: Any) -> None:
        """Raise SettingsError unless they are those of one grasp from a picture."""
        Grid.of(observation, action)

    @classmethod
    def complete(cls, settings: TrainSettings) -> TrainSettings:
        """Check the environment's spaces, and add the defaults."""
        settings = super().complete(settings)
        if settings.normalize:
            raise SettingsError("normalize: the bandit trainer has no use for it; leave it out")
        return dataclasses.replace(settings, eval_every=settings.eval_every or max(1000, settings.steps // 20))

    def advance(self, total: int) -> None:
        """Grasp once in every environment, keep what came of it, and do the updates that are due."""
        step = next(self.playing)
        self._observation, rewards = step.observations, step.rewards
        if not ((rewards >= 0) & (rewards <= 1)).all():
            raise TrainingFailed(
                f"a grasp was rewarded with {rewards.min():g} to {rewards.max():g}: grasp-q learns the probability of "
                "success, from rewards between 0 and 1"
            )
        for one in step.ended:
            self.ended.append(one if one.success is not None else dataclasses.replace(one, success=one.total > 0))
        self.memory.add(**self._tried, rewards=rewards.astype(np.float32))
        self._steps += len(rewards)
        for _ in self.take_due(len(rewards) * self.options.reuse / self.options.batch_size):
            self.update(self.done(total))

    def update(self, done: float) -> None:
        """Update the network on a batch; `done` is the share of the run before it."""
        batch = self.memory.rows(self._rng.integers(len(self.memory), size=self.options.batch_size))
        patches = batch.patches.numpy()
        for axis in (1, 2):  # the gripper is the same in a mirror
            mirrored = self._rng.random(len(patches)) < 0.5
            patches[mirrored] = np.flip(patches[mirrored], axis)
        logits = self.network(_metres(patches)).flatten(1)
        taken = logits.gather(1, batch.widths[:, None])[:, 0]
        loss = functional.binary_cross_entropy_with_logits(taken, batch.rewards)
        self.metrics = {"loss": self._optimiser.descend(loss, cosine(done))}

    def act_batch(self, observations: Any) -> Any:
        """The grasps to try."""
        depth = observations["depth"].reshape(self.envs.num_envs, self.grid.rows, self.grid.columns)
        if not self._table:
            self._table = float(np.median(depth))
        heights = ((self._table - depth) / HEIGHT_UNIT).round().clip(0, 255).astype(np.uint8)
        tried = self._choose(heights)
        self._tried = {"patches": self.grid.patches(heights, *tried[:3]), "widths": tried[3]}
        return self.grid.actions(*tried).astype(self.spaces[1].dtype)

    def _choose(self, heights: Bytes) -> tuple[Any, Any, Any, Any]:
        """Column, row, rotation and width of the grasp to try in each picture (n, h, w). Shape: (n,) each."""
        n, rng, options = len(heights), self._rng, self.options
        k = options.candidates if self._steps >= options.random_grasps else 1
        place = rng.integers(heights[0].size, size=(n, k))
        for env, picture in enumerate(heights):
            high = np.flatnonzero(picture > _ABOVE)
            if len(high):
                on = rng.random(k) >= _ANYWHERE
                place[env, on] = rng.choice(high, on.sum())
        row, column = np.divmod(place, self.grid.columns)
        rotation = rng.integers(self.grid.rotations, size=(n, k))
        width = rng.integers(self.grid.widths, size=n)
        best = np.zeros(n, np.int64)
        if k > 1:
            envs = np.repeat(np.arange(n), k)
            patches = self.grid.patches(heights[envs], column.ravel(), row.ravel(), rotation.ravel())
            with torch.no_grad():
                logits = self.network(_metres(patches)).reshape(n, -1).numpy()  # candidates, widths
            chosen = np.divmod(logits.argmax(axis=1), self.grid.widths)
            greedy = rng.random(n) >= options.exploration
            best, width = np.where(greedy, chosen[0], 0), np.where(greedy, chosen[1], width)
        picked = np.arange(n), best
        return column[picked], row[picked], rotation[picked], width

    def policy(self) -> GraspPolicy:
        """A copy of the network, which looks at whole pictures."""
        return GraspPolicy(self.network, self.grid, self._table, self.spaces[0])

    def members(self) -> tuple[bytes, bytes]:
        """The policy's ONNX file, and its golden actions for pictures of the environments."""
        found: tuple[bytes, bytes] = self.frozen().members(_GOLDEN, self._observation)
        return found

    def state(self) -> dict[str, Any]:
        """The network, all grasps, and the environments, if they can be saved."""
        grasps = self.memory.columns()
        return {
            **super().state(),
            "grasps": tuple(grasps[name].numpy() for name in _GRASPS),
            "table": self._table,
            "due": self._due,
            "recent": [[one.total, one.success] for one in self.ended],
            "envs": getattr(self.envs.unwrapped, "state_dict", lambda: None)(),
        }

    def load_state(self, state: Any) -> None:
        """Restore the result of `state`."""
        super().load_state(state)
        self.memory.add(**dict(zip(_GRASPS, state["grasps"], strict=True)))
        self._table, self._due = state["table"], state["due"]
        self.ended += [PlayedEpisode(None, total, 1, bool(success)) for total, success in state["recent"]]
        if state["envs"] is not None:
            self._observation = self.envs.unwrapped.load_state_dict(state["envs"])
            self.play(observations=self._observation)


def _metres(patches: Bytes) -> torch.Tensor:
    """Heights as inputs of the network. Shape: (n, 33, 33) -> (n, 1, 33, 33)."""
    return torch.as_tensor(patches[:, None].astype(np.float32) * np.float32(HEIGHT_UNIT))
