"""The Transport protocol: access to an environment, or a batch of them, that runs elsewhere."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium import Space

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.core.spaces import space_from_json, space_to_json
from bam_envs.core.wording import brief
from bam_envs.remote.wire.values import exact, plain_info, tree_from_json, tree_to_json

Info = dict[str, Any]
Seed = int | list[int | None] | None
"""The seed of a reset: one, or one for each environment of a batch."""
_MAX_SEED = 2**64 - 1


@dataclass(frozen=True)
class EnvSpecMessage:
    """The description of the environment at the other end."""

    env_id: str
    """Its Gymnasium id, such as bam/pick-v0."""
    observation_space: Space[Any]
    """Of a single environment."""
    action_space: Space[Any]
    """Of a single environment."""
    num_envs: int = 1
    """Environments stepped together."""
    vector: bool = False
    """Whether values are lists with one entry for each environment."""
    autoreset: bool = True
    """With `vector`, whether an environment whose episode ends is reset in the same step; True on our servers."""
    period: float | None = None
    """Time between two actions [s]; None if the server does not report it."""
    max_episode_steps: int | None = None
    """The server's time limit, after which it sends `truncated`."""
    signals: Mapping[str, Any] = field(default_factory=dict)
    """The result of the environment's `describe()`; empty if the server does not report it."""

    def each(self, action: Any) -> list[Any]:
        """The action of each environment. Raises InvalidValue if there are too many or too few."""
        if not self.vector:
            return [action]
        each = list(action) if np.iterable(action) else []
        if len(each) != self.num_envs:
            raise InvalidValue(
                f"There must be one action for each of {self.num_envs} environments, not {brief(action)}."
            )
        return each

    def split(self, result: Iterable[Any]) -> list[tuple[Any, ...]]:
        """The result of each environment, from a result of `Transport.reset` or `Transport.step`."""
        return list(zip(*result, strict=True)) if self.vector else [tuple(result)]

    def joined(self, each: Sequence[tuple[Any, ...]]) -> Any:
        """A result of `Transport.reset` or `Transport.step`, from the result of each environment."""
        return tuple(map(list, zip(*each, strict=True))) if self.vector else each[0]

    def exact(self, result: Iterable[Any]) -> Any:
        """A result of trees, as of `EnvServer`, with the types of the spaces; InvalidValue if it does not fit."""
        each, space = [], self.observation_space
        for i, (observation, *ends, info) in enumerate(self.split(result)):
            where = f" of environment {i}" if self.vector else ""
            checked = exact(space, observation, f"observation{where}")
            if self.vector and isinstance(info, dict) and "final_obs" in info:
                info = {**info, "final_obs": exact(space, info["final_obs"], f"final_obs{where}")}
            each.append((checked, *ends, info))
        return self.joined(each)


def plain_seed(seed: Any) -> Seed:
    """A seed, or one for each environment, as Python integers. Raises InvalidValue if it is not of 64 bits."""
    if seed is None:
        return None
    if isinstance(seed, (list, tuple, np.ndarray)):
        return [plain_seed(one) for one in seed]  # type: ignore[misc]
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed <= _MAX_SEED:
        raise InvalidValue(f"A seed must be a whole number from 0 to {_MAX_SEED}, not {seed!r}.")
    return int(seed)


def spec_to_json(spec: EnvSpecMessage) -> dict[str, Any]:
    """A server's description of its environment as strict JSON values."""
    return {
        "env_id": spec.env_id,
        "observation_space": space_to_json(spec.observation_space),
        "action_space": space_to_json(spec.action_space),
        "num_envs": spec.num_envs,
        "vector": spec.vector,
        "period": spec.period,
        "max_episode_steps": spec.max_episode_steps,
        "signals": tree_to_json(plain_info(spec.signals)),
    }


def spec_from_json(value: Mapping[str, Any]) -> EnvSpecMessage:
    """The environment that `spec_to_json` described. Raises ProtocolError if `value` is something else."""
    try:
        return EnvSpecMessage(
            env_id=str(value["env_id"]),
            observation_space=space_from_json(value["observation_space"]),
            action_space=space_from_json(value["action_space"]),
            num_envs=int(value["num_envs"]),
            vector=bool(value["vector"]),
            period=None if value["period"] is None else float(value["period"]),
            max_episode_steps=None if value["max_episode_steps"] is None else int(value["max_episode_steps"]),
            signals=tree_from_json(value["signals"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"Expected the description of an environment, found {brief(value)}: {error}.") from error


@runtime_checkable
class Transport(Protocol):
    """Carries `reset` and `step`. The constructor does no I/O.

    With ``spec.vector`` every value has one entry for each environment: observations and actions are lists, reward,
    terminated and truncated lists of numbers, and info is a list of dicts, in which an environment that was reset in
    the same step has ``final_obs`` and ``final_info``. Without ``spec.autoreset`` none is: then `reset` resets all.
    """

    def connect(self) -> EnvSpecMessage:
        """Open the link and read the description; NoServer without this environment. Moves nothing; idempotent."""

    def reset(self, seed: Seed = None, options: Info | None = None) -> tuple[Any, Any]:
        """Begin an episode; (observation, info).

        Raises:
            LinkLost: The link dropped, or there was no answer in time.
            RemoteError: The other end refused or failed.
        """

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info). Raises the errors of `reset`; never sent twice."""

    def close(self) -> None:
        """Release the environment, which halts its robot, and drop the link. Idempotent."""
