"""The rows of one transport as part of a vector environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.transports.transport import EnvSpecMessage, Info, Transport

Seeds = list[int | None]


@dataclass(frozen=True)
class Stepped:
    """One step of the rows of a rack."""

    observations: list[Any]
    """Of rows whose episode ended, the first of the next one."""
    rewards: list[float]
    """One a row."""
    terminated: list[bool]
    """One a row."""
    truncated: list[bool]
    """One a row."""
    infos: list[Info]
    """Those of the next episode, with ``final_obs`` and ``final_info``, where one ended."""


@dataclass(frozen=True)
class ResetOrder:
    """What a reset says of the rows of all racks."""

    seeds: Seeds
    """One a row."""
    mask: NDArray[np.bool_]
    """The rows that begin anew."""
    options: Info | None
    """For the other ends."""
    before: list[Any]
    """The last observation of each row."""


class Rack:
    """The rows of one transport, with automatic resets in the same step whatever is at the other end.

    Args:
        transport: What carries them.
        spec: What it connected to.
        first: The number of its first row.
    """

    def __init__(self, transport: Transport, spec: EnvSpecMessage, first: int) -> None:
        self.transport, self.spec = transport, spec
        self.rows = slice(first, first + spec.num_envs)
        """Its rows among those of all racks."""

    def reset(self, order: ResetOrder) -> tuple[list[Any], list[Info]]:
        """Begin episodes on the rows of the mask; (observations, infos) of all."""
        seeds, mask, options = order.seeds[self.rows], order.mask[self.rows], order.options
        if not mask.any():
            return order.before[self.rows], [{}] * len(mask)
        if not self.spec.vector:
            observation, info = self.transport.reset(seeds[0], options)
            return [observation], [info]
        if not mask.all():
            options = {**(options or {}), "reset_mask": mask}
        seeded = any(seed is not None for seed in seeds)
        observations, infos = self.transport.reset(seeds if seeded else None, options)
        return observations, infos

    def step(self, actions: list[Any]) -> Stepped:
        """Step every row; rows whose episode ended begin the next one."""
        if self.spec.vector:
            return Stepped(*self.transport.step(actions))
        observation, reward, terminated, truncated, info = self.transport.step(actions[0])
        if terminated or truncated:
            first, begun = self.transport.reset()
            info = {**begun, "final_obs": observation, "final_info": info}
            observation = first
        return Stepped([observation], [reward], [terminated], [truncated], [info])
