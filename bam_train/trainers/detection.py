"""Make the detector of a checkpoint: of fresh episodes of its frozen policy, or of a data set."""

import math
from collections.abc import Iterable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from bam_envs.core.robot_env import RobotVectorEnv
from bam_envs.robots.live_like import LiveLike
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.checkpoint import add_members
from bam_train.checkpoint.detector import DETECTOR, LEAST_TICKS, MOST_NUMBERS, Detector, Rollout, make_detector, vectors
from bam_train.data.recorded_episode import Episode
from bam_train.env_faults import FiniteVectorEnv
from bam_train.environments import make_vector_env
from bam_train.errors import SettingsError
from bam_train.rollout import BatchPolicy, Parts, PlayedEpisode, rollout

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
    played: Iterable[PlayedEpisode] = (),
) -> Detector:
    """As `add_detector`, of about `steps` steps of the checkpoint's own policy in new episodes of its environment.

    If that has simulated robots, these are as live ones in half of the steps, of fewer than `WANTED` in a third; see
    `LiveLike`. Episodes that the policy has `played` already, with the parts of `parts_of`, take the place of new ones.

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
    with made as rows:
        inner: Any = rows.unwrapped
        is_robot = envs is None and isinstance(inner, RobotVectorEnv) and bool(inner.robot.spec.command.labels)
        limit, wanted, plain = getattr(inner, "max_episode_steps", None), steps // (1 + is_robot), list[Rollout]()
        for episode in played:
            if wanted > 0:
                plain.append(_rollout(episode))
                wanted -= episode.length
        if wanted > 0:
            plain += fresh_episodes(rows, env, policy, wanted)
        if not is_robot:
            return add_detector(path, plain)
        inner.robot = LiveLike(inner.robot)
        live = steps // (4 if steps < WANTED else 2)  # the slow ones are long, and would take a tenth of a short run
        return add_detector(path, plain, fresh_episodes(rows, env, policy, live, SEED + steps), limit=limit)


def parts_of(envs: VectorEnv[Any, Any, Any]) -> Parts | None:
    """What a detector is made of in each step: observation, action, and the command before, if there are robots.

    None if a detector cannot have such observations.
    """
    space, inner = envs.single_observation_space, cast("Any", envs.unwrapped)
    if not isinstance(space, spaces.Box) or space.dtype == np.uint8 or np.prod(space.shape) > MOST_NUMBERS:
        return None
    is_robot = isinstance(inner, RobotVectorEnv)
    return lambda observations, actions: (observations, actions, *([inner.state.command] if is_robot else []))


def _rollout(episode: PlayedEpisode) -> Rollout:
    """An episode with the parts of `parts_of`, and maybe its pace in each step."""
    observed, acted, *more = episode.parts
    pace = float(more[1][-1]) if more[1:] else 1.0
    return Rollout(observed, acted, episode.success, more[0] if more else None, pace=pace)


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
    limit, count, own = getattr(inner, "max_episode_steps", None), 0, cast("Parts", parts_of(envs))

    def parts(observations: Any, actions: Any) -> tuple[Any, ...]:
        nonlocal count
        count += envs.num_envs
        if not isinstance(robot, LiveLike):
            return own(observations, actions)
        inner.max_episode_steps = None if limit is None else np.ceil(limit / robot.pace)
        return *own(observations, actions), robot.pace

    played = rollout(
        FiniteVectorEnv(envs, env),
        policy,
        seed=seed,
        keep=lambda _: count < steps,
        parts=parts,
        limit=steps,  # an episode of that many steps has no end
    )
    return [_rollout(episode) for episode in played]
