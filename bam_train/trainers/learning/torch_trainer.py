"""What learners that are written here with torch share: options, checkpoints, policies; and the loop of a `Trainer`."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.safetensors_file import pack
from bam_train.environments import make_env, require_fit
from bam_train.errors import TrainingFailed
from bam_train.rollout import PlayedEpisode, play
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import ALGORITHMS
from bam_train.trainers.base import OnProgress, Progress, Settings, Statistics, Trainer
from bam_train.trainers.learner_hyperparameters import read_hyperparameters
from bam_train.trainers.resolve_settings import own_settings

if TYPE_CHECKING:
    from typing_extensions import Self

STATE, NOTES = "bam/resume/state", "bam/resume/notes.json"
_LOGGED = 200  # entries of TensorBoard in a run


def state_of(part: Any) -> Any:
    """What goes on with `restore`, of a random generator, a tensor, an object with `state_dict`, or a dict of these."""
    if isinstance(part, Mapping):
        return {name: state_of(one) for name, one in part.items()}
    if isinstance(part, np.random.Generator):
        return dict(part.bit_generator.state)
    return part.detach().clone() if isinstance(part, torch.Tensor) else part.state_dict()


def restore(part: Any, state: Any) -> None:
    """Give a part, or a dict of parts, the state that `state_of` returned."""
    if isinstance(part, Mapping):
        for name, one in part.items():
            restore(one, state[name])
    elif isinstance(part, np.random.Generator):
        part.bit_generator.state = state
    elif isinstance(part, torch.Tensor):
        part.data.copy_(state)
    else:
        part.load_state_dict(state)


class TorchLearner(Trainer[Settings]):
    """Base class of a learner; a subclass sets `parts`, and defines `policy`."""

    parts: dict[str, Any]
    """Networks, optimisers and random generators by name; see `state_of`."""

    def __init__(self, settings: Settings) -> None:
        torch.set_num_threads(settings.threads)
        torch.manual_seed(settings.seed)
        self.settings, self.options = settings, self.read_options(settings)
        self._rng = np.random.default_rng(settings.seed)

    def policy(self) -> Any:
        """A copy of the current policy, a `FrozenNetwork`."""
        raise NotImplementedError

    def frozen(self, **asked: Any) -> Any:
        """The current policy; `asked` goes to `policy`.

        Raises:
            TrainingFailed: A weight is not finite.
        """
        policy = self.policy(**asked)
        if not all(bool(torch.isfinite(one).all()) for one in policy.parameters()):
            text = f"the network's weights are NaN or infinite at step {self.steps}"
            raise TrainingFailed(f"{text}; expected finite numbers: try a smaller learning_rate")
        return policy

    def state(self) -> dict[str, Any]:
        """What a run goes on from, besides torch's random numbers."""
        return {**state_of(self.parts)}

    def load_state(self, state: Any) -> None:
        """Restore the result of `state`."""
        restore(self.parts, state)

    @classmethod
    def read_options(cls, settings: Settings) -> Any:
        """The hyperparameters with their defaults; raises SettingsError if one is unknown or does not fit."""
        return read_hyperparameters(settings.algo, settings.hyperparameters)

    @classmethod
    def create(cls, settings: Settings) -> Self:
        """Set up a new run of complete settings."""
        return cls(settings)

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: Settings | None = None) -> Self:
        """Set up a run that continues from a checkpoint."""
        own: Any = settings or TrainSettings.from_mapping(own_settings(checkpoint), str(checkpoint.path))
        trainer = cls(own)
        trainer.restore(checkpoint)
        return trainer

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint of the same kind of run."""
        self._steps = checkpoint.manifest.steps
        with checkpoint.fitting(STATE):
            state = checkpoint.state(STATE, torch.as_tensor)
            self.load_state(state)
            torch.set_rng_state(state["torch"])

    def resume_members(self, notes: Mapping[str, Any]) -> dict[str, bytes]:
        """The notes, and the `state` with torch's random numbers."""
        state = {**self.state(), "torch": torch.get_rng_state()}
        return {NOTES: json.dumps(dict(notes)).encode(), **pack(STATE, state)}


class TorchTrainer(TorchLearner[Settings]):
    """Base class of a trainer; a subclass sets `envs`, if it has any, and defines `advance`.

    Where its environments are played, it is the policy that is played; see `BatchPolicy`.
    """

    recent = 100
    """Most episodes in the statistics."""
    envs: Any = None
    """The environments of training, closed at the end; None for none."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self.notices: list[str] = []
        self.metrics: dict[str, float] = {}
        """Numbers of the last updates."""
        self.ended: deque[PlayedEpisode] = deque(maxlen=self.recent)
        """The last episodes of training."""
        self._logged, self._due = 0, 0.0  # step of the last log; updates that are due

    def advance(self, total: int) -> None:
        """Train a little, of a run of `total` steps, and count the steps."""
        raise NotImplementedError

    @classmethod
    def require_spaces(cls, observation: Any, action: Any) -> None:
        """Raise SettingsError if the learner does not fit these spaces; whether its kind of actions does is checked."""

    def done(self, total: int) -> float:
        """Share of a run of `total` steps that is over."""
        return min(1.0, self._steps / total)

    def take_due(self, more: float) -> range:
        """As many numbers as there are whole updates due after `more` of them; a share of one is due later."""
        count = int(self._due + more)
        self._due += more - count
        return range(count)

    def play(self, **begun: Any) -> None:
        """Begin new episodes in `envs`, see `rollout.play`; `next(self.playing)` steps them."""
        self.playing = play(self.envs, self, **(begun or {"seed": int(self._rng.integers(2**31))}))

    def act_batch(self, observations: Any) -> Any:
        """Actions to try. Shapes: (n, ...) -> (n, ...)."""
        raise NotImplementedError

    def reset(self, env_ids: Any = None) -> None:
        """Nothing: it has no memory of an episode."""

    @classmethod
    def complete(cls, settings: Settings) -> Settings:
        """Check the environment's spaces and the settings, and add the defaults of the algorithm."""
        with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
            algorithm = ALGORITHMS[settings.trainer][settings.algo]
            algorithm.require_actions(settings.env, type(env.action_space).__name__)
            cls.require_spaces(env.observation_space, env.action_space)
        return dataclasses.replace(settings, hyperparameters=dataclasses.asdict(cls.read_options(settings)))

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint, if it fits the environments."""
        if self.envs is not None:
            require_fit(checkpoint, self.envs, self.settings.place)
        super().restore(checkpoint)

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` steps, or `on_progress` returns False."""
        while self._steps < steps:
            self.advance(steps)
            if self._steps - self._logged >= steps // _LOGGED:
                self._logged = self._steps
                self.log(self.metrics)
            if not on_progress(Progress(self._steps, steps, self._statistics)):
                return

    def _statistics(self) -> Statistics:
        known = [one.success for one in self.ended if one.success is not None]
        totals, lengths = [one.total for one in self.ended], [one.length for one in self.ended]
        return Statistics.of(totals, lengths, known, self.metrics)

    def close(self) -> None:
        """Close environments and log files."""
        super().close()
        if self.envs is not None:
            self.envs.close()
