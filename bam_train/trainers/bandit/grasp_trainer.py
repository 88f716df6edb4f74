"""`GraspTrainer`: learns which grasps of a picture succeed, from its own attempts.

Every episode is one decision, so there is no future to estimate: the network learns the probability of success (Q of a
contextual bandit), by the cross entropy. Attempts begin at random places above the table; later the best of some random
candidates is tried. A step of the run is a grasp.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections import deque
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta
from torch.nn import functional

from bam_envs.core.validation import read_table
from bam_train.checkpoint import Checkpoint
from bam_train.environments import make_env, make_vector_env, require_fit
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.rollout import PlayedEpisode, play
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import BANDIT_ALGORITHMS
from bam_train.trainers.bandit.grasp_network import EDGE, HEIGHT_UNIT, Bytes, GraspNetwork, GraspPolicy, Grid
from bam_train.trainers.base import OnProgress, Progress, Statistics
from bam_train.trainers.resolve_settings import own_settings
from bam_train.trainers.torch_trainer import STATE, TorchTrainer

_Count = Annotated[int, Meta(ge=1, le=100_000)]
_RECENT = 200  # grasps of the statistics
_ABOVE = 20  # least height of a place that is tried, in units of `HEIGHT_UNIT`
_ANYWHERE = 0.1  # share of candidates at any place
_GOLDEN = 4  # pictures in a checkpoint


@dataclasses.dataclass(frozen=True)
class GraspQ:
    """Hyperparameters."""

    learning_rate: Annotated[float, Meta(gt=0, le=1)] = 2e-3
    """At the beginning; it falls to 0 along a cosine."""
    batch_size: _Count = 64
    """Grasps that one update learns from."""
    channels: _Count = 16
    """Channels of the first convolutions; the last have twice as many."""
    reuse: Annotated[float, Meta(gt=0, le=1000)] = 24.0
    """How often each grasp is learnt from, on average, before as many others have followed."""
    candidates: _Count = 128
    """Random grasps of a picture, of which the best is tried."""
    random_grasps: Annotated[int, Meta(ge=0)] = 1000
    """Grasps at random before the network chooses."""
    exploration: Annotated[float, Meta(ge=0, le=1)] = 0.1
    """Share of random grasps after that."""


class GraspTrainer(TorchTrainer):
    """Made by `create` or `load`; the policy that is played chooses what to try."""

    def __init__(self, settings: TrainSettings) -> None:
        super().__init__(settings)
        self.options = read_table(GraspQ, settings.hyperparameters, "hyperparameters", SettingsError)
        self.envs: Any = make_vector_env(settings.env, settings.env_kwargs, settings.num_envs, settings.place)
        self.spaces = self.envs.single_observation_space, self.envs.single_action_space
        self._grid = Grid.of(*self.spaces)
        self.network = GraspNetwork(self.options.channels, self._grid.widths)
        self._optimiser = torch.optim.Adam(self.network.parameters(), lr=self.options.learning_rate)
        self._rng = np.random.default_rng(settings.seed)
        self._patches: Bytes = np.zeros((0, EDGE, EDGE), np.uint8)
        self._widths, self._rewards = np.zeros(0, np.int64), np.zeros(0, np.float32)
        self._due = 0.0
        self._recent: deque[PlayedEpisode] = deque(maxlen=_RECENT)
        self._metrics: dict[str, float] = {}
        self._observation: Any = None
        self._playing = play(self.envs, self, seed=settings.seed)
        self._tried: tuple[Any, ...] = ()  # patches and widths of the last grasps
        self._table = 0.0  # depth of the table [m]

    @classmethod
    def complete(cls, settings: TrainSettings) -> TrainSettings:
        """Check the environment's spaces, and add the defaults."""
        with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
            BANDIT_ALGORITHMS[settings.algo].require_actions(settings.env, type(env.action_space).__name__)
            Grid.of(env.observation_space, env.action_space)
        if settings.data is not None or settings.normalize:
            name = "normalize" if settings.data is None else "data"
            raise SettingsError(f"{name}: the bandit trainer has no use for it; leave it out")
        values = read_table(GraspQ, settings.hyperparameters, "hyperparameters", SettingsError)
        every = settings.eval_every or max(1000, settings.steps // 20)
        return dataclasses.replace(settings, hyperparameters=dataclasses.asdict(values), eval_every=every)

    @classmethod
    def create(cls, settings: TrainSettings) -> GraspTrainer:
        """Set up a new run of complete settings."""
        return cls(settings)

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: TrainSettings | None = None) -> GraspTrainer:
        """Set up a run that continues from a checkpoint, with all grasps that it had learnt from."""
        trainer = cls(settings or TrainSettings.from_mapping(own_settings(checkpoint), str(checkpoint.path)))
        require_fit(checkpoint, trainer.envs, trainer.settings.place)
        with checkpoint.fitting(STATE):
            state = checkpoint.state(STATE, torch.as_tensor)
            trainer.network.load_state_dict(state["network"])
            trainer._optimiser.load_state_dict(state["optimiser"])
            trainer._patches, trainer._widths, trainer._rewards = (np.array(one) for one in state["grasps"])
            trainer._rng.bit_generator.state = state["rng"]
            torch.set_rng_state(state["torch"])
            trainer._table, trainer._due, trainer._steps = state["table"], state["due"], len(trainer._rewards)
            trainer._recent += [PlayedEpisode(None, reward, 1, bool(success)) for reward, success in state["recent"]]
            if state["envs"] is not None:
                trainer._observation = trainer.envs.unwrapped.load_state_dict(state["envs"])
                trainer._playing = play(trainer.envs, trainer, observations=trainer._observation)
        return trainer

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` grasps, or `on_progress` returns False."""
        while self._steps < steps:
            self._try_grasps()
            self._due += len(self._observation["depth"]) * self.options.reuse / self.options.batch_size
            while self._due >= 1:
                self._due -= 1
                self._update(min(1.0, self._steps / steps))
            if self.logs(steps):
                self.log(self._metrics)
            if not on_progress(Progress(self._steps, steps, self._statistics)):
                return

    def _try_grasps(self) -> None:
        """Grasp once in every environment, and keep what came of it."""
        step = next(self._playing)
        self._observation, rewards = step.observations, step.rewards
        if not ((rewards >= 0) & (rewards <= 1)).all():
            raise TrainingFailed(
                f"a grasp was rewarded with {rewards.min():g} to {rewards.max():g}: grasp-q learns the probability of "
                "success, from rewards between 0 and 1"
            )
        for one in step.ended:
            self._recent.append(one if one.success is not None else dataclasses.replace(one, success=one.total > 0))
        patches, widths = self._tried
        self._patches = np.concatenate([self._patches, patches])
        self._widths = np.concatenate([self._widths, widths])
        self._rewards = np.concatenate([self._rewards, rewards.astype(np.float32)])
        self._steps += len(rewards)

    def reset(self, env_ids: Any = None) -> None:
        """Nothing: it has no memory."""

    def act_batch(self, observations: Any) -> Any:
        """The grasps to try."""
        depth = observations["depth"].reshape(self.envs.num_envs, self._grid.rows, self._grid.columns)
        if not self._table:
            self._table = float(np.median(depth))
        heights = ((self._table - depth) / HEIGHT_UNIT).round().clip(0, 255).astype(np.uint8)
        tried = self._choose(heights)
        self._tried = self._grid.patches(heights, *tried[:3]), tried[3]
        return self._grid.actions(*tried).astype(self.spaces[1].dtype)

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
        row, column = np.divmod(place, self._grid.columns)
        rotation = rng.integers(self._grid.rotations, size=(n, k))
        width = rng.integers(self._grid.widths, size=n)
        best = np.zeros(n, np.int64)
        if k > 1:
            envs = np.repeat(np.arange(n), k)
            patches = self._grid.patches(heights[envs], column.ravel(), row.ravel(), rotation.ravel())
            with torch.no_grad():
                logits = self.network(_metres(patches)).reshape(n, -1).numpy()  # candidates, widths
            chosen = np.divmod(logits.argmax(axis=1), self._grid.widths)
            greedy = rng.random(n) >= options.exploration
            best, width = np.where(greedy, chosen[0], 0), np.where(greedy, chosen[1], width)
        picked = np.arange(n), best
        return column[picked], row[picked], rotation[picked], width

    def _update(self, done: float) -> None:
        """Update the network on a batch; `done` is the share of the run before it."""
        rows = self._rng.integers(len(self._rewards), size=self.options.batch_size)
        patches = self._patches[rows]
        for axis in (1, 2):  # the gripper is the same in a mirror
            mirrored = self._rng.random(len(rows)) < 0.5
            patches[mirrored] = np.flip(patches[mirrored], axis)
        logits = self.network(_metres(patches)).flatten(1)
        taken = logits.gather(1, torch.as_tensor(self._widths[rows])[:, None])[:, 0]
        loss = functional.binary_cross_entropy_with_logits(taken, torch.as_tensor(self._rewards[rows]))
        if not torch.isfinite(loss):
            raise TrainingFailed(f"the loss is {loss.item()}: try a smaller learning_rate")
        self._optimiser.param_groups[0]["lr"] = self.options.learning_rate * 0.5 * (1 + math.cos(math.pi * done))
        self._optimiser.zero_grad()
        loss.backward()
        self._optimiser.step()
        self._metrics = {"loss": loss.item()}

    def _statistics(self) -> Statistics:
        return Statistics.of(self._recent, self._metrics)

    def policy(self) -> GraspPolicy:
        """A copy of the network, which looks at whole pictures."""
        return GraspPolicy(self.network, self._grid, self._table, self.spaces[0])

    def members(self) -> tuple[bytes, bytes]:
        """The policy's ONNX file, and its golden actions for pictures of the environments."""
        return self.policy().members(self._observation, _GOLDEN)

    def state(self) -> dict[str, Any]:
        """The network, all grasps, and the environments, if they can be saved."""
        return {
            "network": self.network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "grasps": (self._patches, self._widths, self._rewards),
            "rng": dict(self._rng.bit_generator.state),
            "table": self._table,
            "due": self._due,
            "recent": [[one.total, one.success] for one in self._recent],
            "envs": getattr(self.envs.unwrapped, "state_dict", lambda: None)(),
        }


def _metres(patches: Bytes) -> torch.Tensor:
    """Heights as inputs of the network. Shape: (n, 33, 33) -> (n, 1, 33, 33)."""
    return torch.as_tensor(patches[:, None].astype(np.float32) * np.float32(HEIGHT_UNIT))
