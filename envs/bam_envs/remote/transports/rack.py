"""The rows of one transport as part of a vector environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.remote.transports.transport import EnvSpecMessage, Info, Transport

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
        if not self.spec.vector or not self.spec.autoreset:
            return self._begin(self._one_seed(seeds, mask), options)
        if not mask.all():
            options = {**(options or {}), "reset_mask": mask}
        seeded = any(seed is not None for seed in seeds)
        observations, infos = self.transport.reset(seeds if seeded else None, options)
        return observations, infos

    def step(self, actions: list[Any]) -> Stepped:
        """Step every row; rows whose episode ended begin the next one."""
        if not self.spec.vector:
            return self._restarted(Stepped(*([one] for one in self.transport.step(actions[0]))))
        stepped = Stepped(*self.transport.step(actions))
        return stepped if self.spec.autoreset else self._restarted(stepped)

    def _restarted(self, last: Stepped) -> Stepped:
        """All rows begin anew once one has ended, for there is one reset for all of them."""
        if not any(last.terminated) and not any(last.truncated):
            return last
        first, infos = self._begin(None, None)
        infos = [
            {**begun, "final_obs": observation, "final_info": info}
            for begun, observation, info in zip(infos, last.observations, last.infos, strict=True)
        ]
        # To a row that was not at its end, the end of another one is a time limit.
        cut = [not ended or late for ended, late in zip(last.terminated, last.truncated, strict=True)]
        return Stepped(first, last.rewards, last.terminated, cut, infos)

    def _begin(self, seed: int | None, options: Info | None) -> tuple[list[Any], list[Info]]:
        """Begin the episodes of all rows together."""
        observation, info = self.transport.reset(seed, options)
        return (observation, info) if self.spec.vector else ([observation], [info])

    def _one_seed(self, seeds: Seeds, mask: NDArray[np.bool_]) -> int | None:
        """The seed for all rows: that of the first, from which those of the others go on."""
        first, rows = seeds[0], f"The {len(seeds)} rows of {self.spec.env_id} begin together"
        if not mask.all():
            raise InvalidValue(f"{rows}; reset_mask must hold all of them or none.")
        if seeds != [None if first is None else first + row for row in range(len(seeds))]:
            raise InvalidValue(f"{rows}, from one seed s that stands for s, s + 1, …; not from {seeds}.")
        return first
