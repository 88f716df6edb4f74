"""What a server says of its environment, and which names it answers to."""

from __future__ import annotations

import re
from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, VectorEnv

from bam_envs.core.errors import InvalidValue
from bam_envs.core.spaces import space_to_json
from bam_envs.remote.transports.transport import EnvSpecMessage
from bam_envs.robo_gym.table import ROBO_GYM

Env = gym.Env[Any, Any] | VectorEnv[Any, Any, Any]


def describe_env(env: Env, env_id: str | None = None) -> EnvSpecMessage:
    """What clients are told of `env`.

    Raises:
        InvalidValue: The rows of a vector environment begin anew in another way than in the same step.
        UnknownName: A space of a kind that cannot be sent.
    """
    vector = isinstance(env, VectorEnv)
    mode = env.metadata.get("autoreset_mode")
    if vector and mode != AutoresetMode.SAME_STEP:
        raise InvalidValue(
            f"The rows of a served vector environment must begin anew in the same step, not {mode}; make it with "
            f'vector_kwargs={{"autoreset_mode": AutoresetMode.SAME_STEP}}.'
        )
    single: Any = env.single_observation_space if isinstance(env, VectorEnv) else env.observation_space
    action: Any = env.single_action_space if isinstance(env, VectorEnv) else env.action_space
    for space in (single, action):
        space_to_json(space)
    describe = getattr(env.unwrapped, "describe", None)
    return EnvSpecMessage(
        env_id or (env.spec.id if env.spec is not None else type(env.unwrapped).__name__),
        single,
        action,
        num_envs=env.num_envs if isinstance(env, VectorEnv) else 1,
        vector=vector,
        period=_period(env),
        max_episode_steps=_limit(env),
        signals=describe() if describe is not None else {},
    )


def _limit(env: Env) -> int | None:
    """Steps after which episodes are cut: what rows say that cut them themselves, else what Gymnasium says."""
    said: int | None = env.spec.max_episode_steps if env.spec is not None else None
    return getattr(env.unwrapped, "max_episode_steps", said) if isinstance(env, VectorEnv) else said


def _period(env: Env) -> float | None:
    """Time between two actions [s]: the environment's `period`, else one frame of its ``render_fps``, else None."""
    period = getattr(env.unwrapped, "period", None)
    if period is not None:
        return float(period)
    rate = env.metadata.get("render_fps")
    return 1.0 / float(rate) if rate else None


def same_name(one: str, other: str) -> bool:
    """Whether two names are of one environment: namespace, version, case and punctuation do not count.

    ``PickPlace``, ``pick-place``, ``bam/pick-place`` and ``bam/pick-place-v0`` are one; so are robo-gym's names and
    ours of one environment.
    """
    return _bare(one) == _bare(other)


def _bare(name: str) -> str:
    spelt = _spelt(name)
    return _ROBO_GYM.get(spelt, spelt)


def _spelt(name: str) -> str:
    last = re.split("[/:]", name)[-1]
    return re.sub("[^a-z0-9]", "", re.sub(r"-v\d+$", "", last).lower())


_ROBO_GYM = {_spelt(theirs.id): _spelt(theirs.variant or theirs.env_id) for theirs in ROBO_GYM.values()}
"""robo-gym's names -> ours of the same environment, or one name of what is a variant of it."""
