"""What the user says of a rack that does not describe its environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium import Space

from bam_envs.core.registry import resolve_id
from bam_envs.core.validation import PositiveInt, check
from bam_envs.remote.gymapi.gymapi_codec import DEFAULT, EnvCodec
from bam_envs.remote.gymapi.versions import Version, version_named
from bam_envs.remote.transport import EnvSpecMessage, Info


@dataclass(frozen=True)
class ForeignRack:
    """A rack whose server is not of bam-train."""

    observation_space: Space[Any] | None = None
    """Of a single environment."""
    action_space: Space[Any] | None = None
    """Of a single environment."""
    num_envs: int = 1
    """Environments (arms); they begin their episodes together."""
    period: float | None = None
    """Time between two actions [s]; None if nobody knows."""
    action_type: int = DEFAULT
    """What it does with an action: 1 default, 2 pick and lift, 3 pick and place, 4 open, 5 fold."""
    gymapi_version: str | None = None
    """Version of its messages; None to find out by its first answer."""
    autoreset: bool | None = None
    """Whether it begins the next episode in the step that ends one; None: as racks of its version do, from June on."""

    def __post_init__(self) -> None:
        check(self.num_envs, PositiveInt, "num_envs")
        self.version  # noqa: B018 - refuses a name that is none

    @property
    def version(self) -> Version | None:
        """The version that was given."""
        return None if self.gymapi_version is None else version_named(self.gymapi_version)

    @property
    def is_described(self) -> bool:
        """Whether both spaces were given."""
        return self.observation_space is not None and self.action_space is not None

    def begins_next(self, version: Version | None) -> bool:
        """Whether its observation at the end of an episode is the first one of the next, if it speaks `version`."""
        return (version is not None and version.june) if self.autoreset is None else self.autoreset

    def codec(self, env_id: str) -> EnvCodec:
        """How values travel; spaces that were not given are those of the environment registered here as `env_id`.

        Raises:
            UnknownName: Nothing is registered as `env_id`.
        """
        observation_space, action_space = self.observation_space, self.action_space
        if observation_space is None or action_space is None:
            env: gym.Env[Any, Any] = gym.make(resolve_id(env_id))
            observation_space, action_space = env.observation_space, env.action_space
            env.close()  # type: ignore[no-untyped-call]
        spec = EnvSpecMessage(
            env_id or "rack",
            observation_space,
            action_space,
            self.num_envs,
            vector=self.num_envs > 1,
            autoreset=False,
            period=self.period,
        )
        return EnvCodec(spec, foreign=True, action_type=self.action_type)


class LastKnown:
    """The last observation of each episode of a rack that begins the next one in the step that ends one.

    What such a rack observes then is the first observation of the next episode, and the last one of the old never
    comes: that of the step before stands in its place.
    """

    def __init__(self) -> None:
        self._observation: Any = None

    def begin(self, observation: Any) -> None:
        """Episodes begin with `observation`, or a list of them."""
        self._observation = observation

    def instead(self, result: tuple[Any, Any, Any, Any, Any], vector: bool) -> tuple[Any, Any, Any, Any, Any]:
        """A step's result with the last known observation where an episode ended; `info` says so."""
        before, (observation, reward, terminated, truncated, info) = self._observation, result
        self._observation = observation
        if not vector:
            if terminated or truncated:
                observation, info = before, _stale(info)
        else:
            ended = [done or cut for done, cut in zip(terminated, truncated, strict=True)]
            observation = [before[i] if end else observation[i] for i, end in enumerate(ended)]
            info = [_stale(info[i]) if end else info[i] for i, end in enumerate(ended)]
        return observation, reward, terminated, truncated, info


def _stale(info: Info) -> Info:
    return {**info, "stale_observation": True}
