"""Make the detector of a checkpoint: of fresh episodes of its frozen policy, or of a data set."""

import math
from collections.abc import Iterable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from bam_envs.core.robot_env import RobotVectorEnv
from bam_envs.robots.live_like import LiveLike
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.added_members import add_members
from bam_train.checkpoint.detector import DETECTOR, LEAST_TICKS, MOST_NUMBERS, Detector, Rollout, make_detector, vectors
from bam_train.data.recorded_episode import Episode
from bam_train.environments import make_vector_env
from bam_train.errors import SettingsError
from bam_train.finite_envs import FiniteVectorEnv
from bam_train.rollout import BatchPolicy, rollout

SEED = 4_000_000
"""First seed of the episodes, far from those of training and evaluations."""
WANTED = 48_000
"""Steps that a detector is made of at the end of training: 1,000 episodes of bam/pick."""
THOROUGH = 240_000
"""The same, of a detector that is asked for afterwards: rare kinds of usual episodes are among so many."""
SIDE_BY_SIDE = 64


def add_detector(path: str | Path, *kinds: Iterable[Rollout], limit: float | None = None) -> Detector:
    """Make a detector of episodes, see `make_detector`, and add it to the checkpoint at `path`; its digest changes.

    Raises:
        SettingsError: None can be made of these episodes; the checkpoint is unchanged.
        CheckpointError: It cannot be read or written.
    """
    detector = make_detector(*kinds, limit=limit)
    add_members(path, {DETECTOR: detector.to_bytes()})
    return detector


def add_own_detector(
    path: str | Path,
    policy: BatchPolicy,
    env: str,
    env_kwargs: dict[str, Any],
    *,
    steps: int = WANTED,
    envs: VectorEnv[Any, Any, Any] | None = None,
) -> Detector:
    """As `add_detector`, of about `steps` steps of the checkpoint's own policy in new episodes of its environment.

    If that has simulated robots, these are as live ones in half of the steps; see `LiveLike`.

    Raises:
        SettingsError: Too few steps, or the observations are not up to `MOST_NUMBERS` numbers.
    """
    box = Checkpoint.open(path, members=False).manifest.observation_space
    if box.get("type") != "Box" or box["dtype"] == "uint8" or np.prod(box["shape"]) > MOST_NUMBERS:
        raise SettingsError(
            f"a detector needs observations of at most {MOST_NUMBERS} numbers, not pictures or mappings"
        )
    if steps < LEAST_TICKS:
        raise SettingsError(f"a detector needs at least {LEAST_TICKS} steps, found {steps}")
    made = nullcontext(envs) if envs is not None else closing(make_vector_env(env, env_kwargs, SIDE_BY_SIDE))
    with made as played:
        inner: Any = played.unwrapped
        if envs is not None or not (isinstance(inner, RobotVectorEnv) and inner.robot.spec.command.labels):
            return add_detector(path, fresh_episodes(played, env, policy, steps))
        limit = inner.max_episode_steps
        plain = fresh_episodes(played, env, policy, steps // 2)
        inner.robot = LiveLike(inner.robot)
        return add_detector(path, plain, fresh_episodes(played, env, policy, steps // 2, SEED + steps), limit=limit)


def recorded(episode: Episode, period: float) -> Rollout:
    """An episode of a data set whose steps take `period` [s], for the detector of unusual observations."""
    sent, stamps, periods = episode.columns.get("command"), episode.columns.get("stamp"), None
    commands = None if sent is None else np.concatenate([np.full_like(sent[:1], np.nan, np.float64), sent[:-1]])
    if stamps is not None:
        periods = np.diff(stamps, prepend=math.nan) / period
    return Rollout(vectors(episode.observations), episode.actions, episode.success, commands, periods)


def unusual_episodes(detector: Detector, rollouts: Iterable[Rollout]) -> dict[str, float]:
    """Number of recorded `episodes`, of those with `alarms`, and the `highest` level; actions are the recorded ones."""
    levels = [float(detector.levels(one).max()) for one in rollouts if len(one.actions)]
    return {"episodes": len(levels), "alarms": sum(one > 1 for one in levels), "highest": max(levels, default=0.0)}


def fresh_episodes(
    envs: VectorEnv[Any, Any, Any], env: str, policy: BatchPolicy, steps: int, seed: int = SEED
) -> list[Rollout]:
    """Whole episodes of `policy`: every one that begins before `steps` steps are done, of whole and running ones.

    A robot that is slower, see `LiveLike`, has more time in proportion.
    """
    inner: Any = envs.unwrapped
    robot = inner.robot if isinstance(inner, RobotVectorEnv) else None
    limit = getattr(inner, "max_episode_steps", None)
    done, count = list[Rollout](), 0

    def seen(observations: Any, actions: Any) -> tuple[Any, ...]:
        nonlocal count
        count += envs.num_envs
        paces = robot.pace if isinstance(robot, LiveLike) else np.ones(envs.num_envs)
        if isinstance(robot, LiveLike):
            inner.max_episode_steps = None if limit is None else np.ceil(limit / paces)
        return observations, actions, np.zeros((len(paces), 0)) if robot is None else inner.state.command, paces

    played = rollout(
        FiniteVectorEnv(envs, env),
        policy,
        seed=seed,
        keep=lambda _: count < steps,
        parts=seen,
        limit=steps,  # an episode of that many steps has no end
    )
    for episode in played:
        observed, acted, sent, paces = episode.parts
        commands = None if robot is None else sent
        done.append(Rollout(observed, acted, episode.success, commands, pace=float(paces[-1])))
    return done
