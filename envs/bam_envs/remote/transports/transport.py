"""The Transport protocol: what carries a whole environment, one or n rows of it, to wherever it runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from gymnasium import Space

Info = dict[str, Any]


@dataclass(frozen=True)
class EnvSpecMessage:
    """What the other end says of its environment."""

    env_id: str
    """Its Gymnasium id, such as bam/pick-v0."""
    observation_space: Space[Any]
    """Of one row."""
    action_space: Space[Any]
    """Of one row."""
    num_envs: int = 1
    """Rows stepped together."""
    vector: bool = False
    """Whether values have one row for each environment."""
    autoreset: bool = True
    """With `vector`, whether rows that end begin anew in the same step (SAME_STEP); always so on our own servers."""
    period: float | None = None
    """Time between two actions [s]; None if it does not say."""
    max_episode_steps: int | None = None
    """Its time limit there; `truncated` comes from there."""
    signals: Mapping[str, Any] = field(default_factory=dict)
    """What `describe()` of the environment there says; empty if it says nothing."""


@runtime_checkable
class Transport(Protocol):
    """Carries `reset` and `step`. The constructor does no I/O.

    With ``spec.vector`` every value has one row for each environment: observations and actions are lists of rows,
    reward, terminated and truncated lists of numbers, and info is a list of dicts, in which a row that began anew has
    ``final_obs`` and ``final_info``. Without ``spec.autoreset`` none does: then `reset` begins all rows together.
    """

    def connect(self) -> EnvSpecMessage:
        """Open the link and learn what is there. Moves nothing; doing it twice is once.

        Raises:
            NoServer: Nobody there, or nobody who knows this environment.
        """

    def reset(self, seed: int | list[int | None] | None = None, options: Info | None = None) -> tuple[Any, Any]:
        """Begin an episode; (observation, info).

        Raises:
            LinkLost: The link dropped, or there was no answer in time.
            RemoteError: The other end refused or failed.
        """

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info). Raises as `reset` does; never sent twice."""

    def close(self) -> None:
        """Let go of the environment there, which halts its robot, and drop the link. As often as one likes."""
