"""RemoteVectorEnv: environments that run somewhere else, as one `gymnasium.vector.VectorEnv`."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium import Space
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, iterate
from numpy.typing import NDArray

from bam_envs.core.close_at_exit import close_at_exit
from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.core.spaces import space_to_json
from bam_envs.remote.batches import join_final, join_infos, join_observations
from bam_envs.remote.transport import EnvSpecMessage, Info, Seed, Transport

Item = TypeVar("Item")
Result = TypeVar("Result")
Seeds = list[int | None]


@dataclass(frozen=True)
class Stepped:
    """One step of the environments of a rack; each list has one entry for each."""

    observations: list[Any]
    """Where an episode ended, the first one of the next."""
    rewards: list[float]
    terminated: list[bool]
    truncated: list[bool]
    infos: list[Info]
    """Where an episode ended, the info of the next one, with ``final_obs`` and ``final_info``."""


class Rack:
    """The environments of one transport, reset in the step that ends an episode whatever is at the other end.

    Args:
        transport: What carries them.
        spec: What it connected to.
        first: The number of its first environment.
    """

    def __init__(self, transport: Transport, spec: EnvSpecMessage, first: int) -> None:
        self.transport, self.spec = transport, spec
        self.part = slice(first, first + spec.num_envs)
        """Its environments among those of all racks."""

    def reset(
        self, seeds: Seeds, mask: NDArray[np.bool_], options: Info | None, before: list[Any]
    ) -> tuple[list[Any], list[Info]]:
        """Begin episodes in the environments of the mask; (observations, infos) of all of this rack.

        Args:
            seeds: One for each environment of this rack.
            mask: Which of them begin an episode. Shape: (n,).
            options: For the other end.
            before: The last observation of each.
        """
        if not mask.any():
            return before, [{}] * len(mask)
        if not self.spec.vector or not self.spec.autoreset:
            return self._begin(self._one_seed(seeds, mask), options)
        if not mask.all():
            options = {**(options or {}), "reset_mask": mask}
        seeded = any(seed is not None for seed in seeds)
        observations, infos = self.transport.reset(seeds if seeded else None, options)
        return observations, infos

    def step(self, actions: list[Any]) -> Stepped:
        """Step every environment; those whose episode ended are reset."""
        if not self.spec.vector:
            return self._restarted(Stepped(*([one] for one in self.transport.step(actions[0]))))
        stepped = Stepped(*self.transport.step(actions))
        return stepped if self.spec.autoreset else self._restarted(stepped)

    def _restarted(self, last: Stepped) -> Stepped:
        """All episodes of this rack end once one has ended, for there is one reset for all of them."""
        if not any(last.terminated) and not any(last.truncated):
            return last
        first, infos = self._begin(None, None)
        infos = [
            {**begun, "final_obs": observation, "final_info": info}
            for begun, observation, info in zip(infos, last.observations, last.infos, strict=True)
        ]
        # For an episode that was not at its end, the end of another one is a time limit.
        cut = [not ended or late for ended, late in zip(last.terminated, last.truncated, strict=True)]
        return Stepped(first, last.rewards, last.terminated, cut, infos)

    def _begin(self, seed: int | None, options: Info | None) -> tuple[list[Any], list[Info]]:
        observation, info = self.transport.reset(seed, options)
        return (observation, info) if self.spec.vector else ([observation], [info])

    def _one_seed(self, seeds: Seeds, mask: NDArray[np.bool_]) -> int | None:
        """The seed for all environments: that of the first, from which those of the others go on."""
        first, those = seeds[0], f"The {len(seeds)} environments of {self.spec.env_id} begin together"
        if not mask.all():
            raise InvalidValue(f"{those}; reset_mask must hold all of them or none.")
        if seeds != [None if first is None else first + number for number in range(len(seeds))]:
            raise InvalidValue(f"{those}, from one seed s that stands for s, s + 1, …; not from {seeds}.")
        return first


class Described:
    """What a remote environment tells of the other end, from the description that comes when it connects."""

    @property
    def _there(self) -> EnvSpecMessage:
        raise NotImplementedError

    @property
    def env_id(self) -> str:
        """The Gymnasium id there."""
        return self._there.env_id

    @property
    def period(self) -> float | None:
        """Time between two actions [s]; None if the other end does not say."""
        return self._there.period

    @property
    def max_episode_steps(self) -> int | None:
        """Steps after which the other end truncates an episode."""
        return self._there.max_episode_steps

    def describe(self) -> dict[str, Any]:
        """What every number of observation, action, state and command means; empty if the other end does not say."""
        return dict(self._there.signals)


class RemoteVectorEnv(Described, gym.vector.VectorEnv[Any, Any, Any]):
    """The environments of one or several transports, stepped at the same time.

    All environments of one transport are one request. One whose episode ends is reset in the same step
    (`AutoresetMode.SAME_STEP`), as in `RobotVectorEnv`. The arms of a rack that is not ours have one reset: when an
    episode of one ends, those of its others are truncated. It connects when something of the other end is first
    needed. Faults go through, once every transport has answered; a `reset` is needed then. It is closed when Python
    ends.

    Args:
        transports: One, or several with the same spaces.
        num_envs: Environments in all, if they must be so many.
    """

    def __init__(self, transports: Transport | Sequence[Transport], num_envs: int | None = None) -> None:
        self.transports = [transports] if isinstance(transports, Transport) else list(transports)
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self._wanted, self._racks = num_envs, list[Rack]()
        self._threads: ThreadPoolExecutor | None = None
        self._process = 0
        self._observations: list[Any] | None = None
        """The last observation of each environment; None while a reset is needed."""
        self._batched: tuple[Space[Any], Space[Any]] | None = None
        if not self.transports:
            raise InvalidValue("There must be at least one transport.")
        close_at_exit(self)

    def connect(self) -> list[EnvSpecMessage]:
        """Return the description of each transport's environments.

        Raises:
            NoServer: Nobody, or nobody who has this environment.
            InvalidValue: The spaces differ, or there are not `num_envs` environments.
        """
        if not self._racks:
            specs = self._at_once(lambda transport: transport.connect(), self.transports)
            _require_alike(specs)
            firsts = [0, *accumulate(spec.num_envs for spec in specs)]
            if self._wanted not in (None, firsts[-1]):
                raise InvalidValue(f"num_envs must be {firsts[-1]}, as many as there are, not {self._wanted}.")
            self._racks = [Rack(*one) for one in zip(self.transports, specs, firsts, strict=False)]
        return [rack.spec for rack in self._racks]

    @property
    def _there(self) -> EnvSpecMessage:
        return self.connect()[0]

    @property
    def num_envs(self) -> int:  # type: ignore[override]
        """Environments in all."""
        return sum(spec.num_envs for spec in self.connect())

    @property
    def single_observation_space(self) -> Space[Any]:  # type: ignore[override]
        """The observation space of one environment."""
        return self._there.observation_space

    @property
    def single_action_space(self) -> Space[Any]:  # type: ignore[override]
        """The action space of one environment."""
        return self._there.action_space

    @property
    def observation_space(self) -> Space[Any]:  # type: ignore[override]
        """The observation space of all environments."""
        return self._spaces()[0]

    @property
    def action_space(self) -> Space[Any]:  # type: ignore[override]
        """The action space of all environments."""
        return self._spaces()[1]

    def _spaces(self) -> tuple[Space[Any], Space[Any]]:
        if self._batched is None:
            there, size = self._there, self.num_envs
            self._batched = batch_space(there.observation_space, size), batch_space(there.action_space, size)
        return self._batched

    def reset(self, *, seed: Seed = None, options: Info | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every environment, or in those of ``options["reset_mask"]`` (n,) bool.

        Args:
            seed: Environment i is seeded with ``seed + i``, or with ``seed[i]``; a rack that is not ours is told that
                of its first arm.
            options: ``reset_mask``, and what the other ends take.
        """
        seeds = self._seeds(seed)
        rest = {key: value for key, value in (options or {}).items() if key != "reset_mask"} or None
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)), dtype=bool)
        if mask.shape != (self.num_envs,):
            raise InvalidValue(f"reset_mask must have shape ({self.num_envs},), not {mask.shape}.")
        if self._observations is None and not mask.all():
            raise ResetNeeded("No episode is running. Call reset() first, without a reset_mask.")
        before, self._observations = self._observations or [None] * self.num_envs, None
        parts = self._at_once(
            lambda rack: rack.reset(seeds[rack.part], mask[rack.part], rest, before[rack.part]), self._racks
        )
        self._observations = [one for observations, _ in parts for one in observations]
        return self._joined(self._observations), join_infos([info for _, infos in parts for info in infos])

    def _seeds(self, seed: Seed) -> Seeds:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            return [int(seed) + number for number in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise InvalidValue(f"seed must be one number or {self.num_envs} of them, not {len(seed)}.")
        return list(seed)

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step every environment; those whose episode ended are reset."""
        if self._observations is None:
            raise ResetNeeded("No episode is running. Call reset() first.")
        each = self._each_action(actions)
        self._observations = None  # until it went well
        steps = self._at_once(lambda rack: rack.step(each[rack.part]), self._racks)
        self._observations = [one for step in steps for one in step.observations]
        infos = [info for step in steps for info in step.infos]
        joined = join_infos(infos)
        if "final_obs" in joined:
            joined["final_obs"] = join_final(self.single_observation_space, self._observations, infos)
        rewards = np.array([reward for step in steps for reward in step.rewards], np.float64)
        terminated = np.array([flag for step in steps for flag in step.terminated], np.bool_)
        truncated = np.array([flag for step in steps for flag in step.truncated], np.bool_)
        return self._joined(self._observations), rewards, terminated, truncated, joined

    def _each_action(self, actions: Any) -> list[Any]:
        if isinstance(self.action_space, gym.spaces.Box):
            array = np.asarray(actions)
            if array.shape != self.action_space.shape:
                raise InvalidValue(f"The actions must have shape {self.action_space.shape}, not {array.shape}.")
            return list(array)
        each, size = list(iterate(self.action_space, actions)), self.num_envs
        if len(each) != size:
            raise InvalidValue(f"There must be one action for each of {size} environments, not {len(each)}.")
        return each

    def _joined(self, each: list[Any]) -> Any:
        return join_observations(self.single_observation_space, each)

    def _at_once(self, call: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """`call` of every item at the same time; the first fault, once all have ended."""
        if len(items) == 1:
            return [call(items[0])]
        if self._threads is None or self._process != os.getpid():  # a forked child has no threads of its parent's
            self._threads = ThreadPoolExecutor(len(items), thread_name_prefix="bam-racks")
            self._process = os.getpid()
        futures = [self._threads.submit(call, item) for item in items]
        wait(futures)
        return [future.result() for future in futures]

    def close_extras(self, **kwargs: Any) -> None:
        """Release the environments there and drop the links."""
        self._observations = None
        for transport in self.transports:
            transport.close()
        threads, self._threads = self._threads, None
        if threads is not None and self._process == os.getpid():
            threads.shutdown()


def _require_alike(specs: Sequence[EnvSpecMessage]) -> None:
    """Refuse racks that take or give different things."""
    for name in ("observation_space", "action_space"):
        first = getattr(specs[0], name)
        for number, spec in enumerate(specs[1:], start=2):
            if space_to_json(getattr(spec, name)) != space_to_json(first):
                raise InvalidValue(
                    f"The {name} of transport {number} is {getattr(spec, name)}, and that of the first {first}; "
                    f"environments of one batch must be alike."
                )
