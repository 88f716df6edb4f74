"""Collect episodes of a policy in simulation: many environments side by side, everything recorded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.core.registry import resolve_id
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.wording import brief, closest, did_you_mean
from bam_envs.tasks.scripted import scripted_policy
from bam_train.checkpoint import Checkpoint
from bam_train.data.data_set import DataSet
from bam_train.data.record_dataset import RecordVectorDataset, info_of
from bam_train.data.recorded_episode import Array
from bam_train.environments import environment_of, make_vector_env, require_env_kwargs, require_fit
from bam_train.errors import SettingsError
from bam_train.evaluation import default_num_envs
from bam_train.files.place import Place
from bam_train.policy import FrozenPolicy
from bam_train.rollout import BatchPolicy, rollout

SCRIPTED, RANDOM = "scripted", "random"


@dataclass
class Collected:
    """What was collected."""

    episodes: int = 0
    steps: int = 0
    successes: int = 0
    repeated: int = 0
    """Episodes that the data set had already, as of the same seed."""


class RandomPolicy:
    """Actions drawn uniformly from the space."""

    def __init__(self, space: gym.Space[Any], seed: int) -> None:
        self._space = space
        space.seed(seed)

    def reset(self, env_ids: Any = None) -> None:
        """Nothing: it has no memory."""

    def act_batch(self, observations: Any) -> Any:
        """Actions for all environments of the space, whatever is observed."""
        return self._space.sample()


class StatePolicy:
    """A policy that sees the state of the environments, whatever is observed: images, say."""

    def __init__(self, policy: BatchPolicy, envs: Any) -> None:
        self._policy, self._envs = policy, envs

    def reset(self, env_ids: Any = None) -> None:
        """Forget what it remembers of these environments."""
        self._policy.reset(env_ids)

    def act_batch(self, observations: Any) -> Any:
        """Actions for the states in which the environments are."""
        return self._policy.act_batch(self._envs.task.state_observation(self._envs.state))


def collect(
    place: str | Path | Place,
    policy: str,
    env: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    *,
    episodes: int = 100,
    seed: int = 0,
    noise: float = 0.0,
    random: float = 0.0,
    num_envs: int | None = None,
    facts: Mapping[str, Any] | None = None,
    on_progress: Callable[[int, int], None] = lambda done, episodes: None,
) -> Collected:
    """Record the first `episodes` that begin, whole, into the data set at `place`.

    After an error, or Ctrl-C, the episodes that are whole are there.

    Args:
        place: The data set; episodes are added to those that are there.
        policy: A checkpoint, ``"scripted"`` or ``"random"``.
        env: Gymnasium id; of a checkpoint, its own by default.
        env_kwargs: Arguments of the environment; they win over the checkpoint's.
        episodes: At least 1.
        seed: Environment i is seeded with ``seed + i`` at first, and not again; also of noise and random actions.
        noise: Standard deviation that is added to continuous actions, which are then clipped to their bounds.
        random: Share of the steps with an action drawn uniformly instead.
        num_envs: Environments side by side; by default as many as is quick.
        facts: Further facts of every episode.
        on_progress: Called with the number of whole episodes and of all.

    Raises:
        SettingsError: Something does not fit the environment.
        BadDataSet: The place holds something else.
    """
    path, named = Path(policy).expanduser(), (SCRIPTED, RANDOM)
    if not path.exists() and closest(policy, named) not in (None, policy):
        raise SettingsError(f"--policy: {policy} is no file and no policy. {did_you_mean(policy, named)}")
    checkpoint = None if policy in named else Checkpoint.open(path)
    if checkpoint is not None:
        env_id, kwargs = environment_of(checkpoint, env)
    elif env is None:
        raise SettingsError(f"--policy {policy} is of no environment; give --env too")
    else:
        env_id, kwargs = resolve_id(env), {}
    require_env_kwargs(env_id, env_kwargs or {})
    kwargs |= env_kwargs or {}
    envs = make_vector_env(env_id, kwargs, num_envs or default_num_envs(env_id, episodes))
    with closing(envs):
        if checkpoint is not None:
            require_fit(checkpoint, envs)
        name = policy if checkpoint is None else checkpoint.digest
        told = {"policy": name, "noise": noise, "random": random, "num_envs": envs.num_envs, **(facts or {})}
        actor = _policy(policy, checkpoint, env_id, envs, seed, kwargs.get("robot_model", DEFAULT_ARM))
        acting, done = Disturbance(actor, envs, noise, 1.0 if policy == RANDOM else random, seed), Collected()
        recorded = RecordVectorDataset(
            envs, place, info_of(envs, env_id, kwargs), told, keep=lambda number, _: number < episodes
        )
        recorded.extra = acting.columns
        with recorded.whole():
            for episode in rollout(recorded, acting, seed=seed, keep=lambda number: number < episodes):
                done.episodes += 1
                done.steps += episode.length
                done.successes += bool(episode.success)
                on_progress(done.episodes, episodes)
        digests = DataSet.open(place).digests
        there = set(digests[: -done.episodes])
        done.repeated = sum(digest in there for digest in digests[-done.episodes :])
        return done


def _policy(policy: str, checkpoint: Checkpoint | None, env_id: str, envs: Any, seed: int, arm: Any) -> BatchPolicy:
    if checkpoint is not None:
        return FrozenPolicy.from_checkpoint(checkpoint)
    if policy == RANDOM:
        return RandomPolicy(envs.action_space, seed)
    scripted: Any = scripted_policy(env_id, arm)
    has_images = hasattr(getattr(envs.unwrapped, "task", None), "state_observation")
    return StatePolicy(scripted, envs.unwrapped) if has_images else scripted


class Disturbance:
    """A policy with noise on its actions in n environments, and random ones instead."""

    def __init__(self, policy: BatchPolicy, envs: Any, noise: float, random: float, seed: int) -> None:
        space = envs.single_action_space
        if noise and not isinstance(space, gym.spaces.Box):
            raise SettingsError(f"--noise is for continuous actions, found {brief(space)}; use --random")
        self._policy, self._space, self._noise, self._random = policy, space, noise, random
        self.columns: dict[str, Array] = {}
        """What a data set has of the next step beside its actions: ``raw_action`` and, where known, ``propensity``."""
        self._rng = np.random.default_rng([seed, 1])
        self._draws = gym.vector.utils.batch_space(space, envs.num_envs)
        self._draws.seed(seed + 1)

    def reset(self, env_ids: Any = None) -> None:
        """Forget what the policy remembers of these environments."""
        self._policy.reset(env_ids)

    def act_batch(self, observations: Any) -> Array:
        """The actions that the environments get. Shape: (n, ...)."""
        wanted = np.array(self._policy.act_batch(observations))
        actions = self._disturbed(wanted)
        self.columns.clear()
        self.columns.update(self._columns(wanted, actions))
        return actions

    def _disturbed(self, actions: Array) -> Array:
        if not self._noise and not self._random:
            return actions
        disturbed = actions.copy()
        if self._noise:
            disturbed = disturbed + self._noise * self._rng.standard_normal(actions.shape)
        if self._random:
            drawn = self._rng.random(len(actions)) < self._random
            disturbed[drawn] = np.asarray(self._draws.sample())[drawn]
        if isinstance(self._space, gym.spaces.Box):
            np.clip(disturbed, self._space.low, self._space.high, out=disturbed)
        changed: Array = disturbed.astype(actions.dtype)
        return changed

    def _columns(self, wanted: Array, actions: Array) -> dict[str, Array]:
        """Of these actions instead of the wanted ones.

        Whole numbers have a probability, and so has a drawn action of a Box its density; noise that is cut at the
        bounds has neither.
        """
        columns = {} if actions is wanted or self._random == 1 else {"raw_action": wanted}
        axes = tuple(range(1, actions.ndim))
        if isinstance(self._space, gym.spaces.Box):
            volume = float(np.prod(self._space.high.astype(np.float64) - self._space.low))
            if self._random == 1 and not self._noise and np.isfinite(volume):
                columns["propensity"] = np.full(len(actions), 1 / volume)
        elif isinstance(self._space, gym.spaces.Discrete | gym.spaces.MultiDiscrete):
            choices = float(
                np.prod(self._space.n if isinstance(self._space, gym.spaces.Discrete) else self._space.nvec)
            )
            columns["propensity"] = self._random / choices + (1 - self._random) * (actions == wanted).all(axis=axes)
        return columns
