"""RemoteVectorEnv: environments that run elsewhere, as one `gymnasium.vector.VectorEnv`."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cached_property
from itertools import accumulate, chain
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium import Space, spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, iterate
from numpy.typing import NDArray

from bam_envs.core.close_at_exit import close_at_exit
from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.core.spaces import space_to_json
from bam_envs.remote.wire.transport import EnvSpecMessage, Info, Seed, Transport
from bam_envs.remote.wire.values import stack

Item = TypeVar("Item")
Result = TypeVar("Result")
Seeds = list[int | None]


class Rack:
    """The environments of one transport, from number `first` on; always reset in the step that ends an episode."""

    def __init__(self, transport: Transport, spec: EnvSpecMessage, first: int) -> None:
        self.transport, self.spec = transport, spec
        self.part = slice(first, first + spec.num_envs)
        """The slice of its environments among those of all racks."""

    def reset(
        self, seeds: Seeds, mask: NDArray[np.bool_], options: Info | None, before: list[Any]
    ) -> list[tuple[Any, ...]]:
        """Begin episodes in the environments of `mask`; returns (observation, info) of every one of this rack.

        Args:
            seeds: One for each environment.
            mask: Which of them begin an episode. Shape: (n,).
            options: For the server.
            before: The last observation of each.
        """
        if not mask.any():
            return [(observation, {}) for observation in before]
        if self.spec.vector and self.spec.autoreset:
            if not mask.all():
                options = {**(options or {}), "reset_mask": mask}
            seeded = any(seed is not None for seed in seeds)
            return self.spec.split(self.transport.reset(seeds if seeded else None, options))
        first, rule = seeds[0], f"The {len(seeds)} environments of {self.spec.env_id} begin together"
        if not mask.all():
            raise InvalidValue(f"{rule}; reset_mask must hold all of them or none.")
        if seeds != [None if first is None else first + number for number in range(len(seeds))]:
            raise InvalidValue(f"{rule}, from one seed s that stands for s, s + 1, …; not from {seeds}.")
        return self.spec.split(self.transport.reset(first, options))

    def step(self, actions: list[Any]) -> list[tuple[Any, ...]]:
        """Step every environment, and reset those whose episode ended; returns the result of each.

        If an episode ended, observation and info are those of the next one, with ``final_obs`` and ``final_info``.
        """
        each = self.spec.split(self.transport.step(actions if self.spec.vector else actions[0]))
        if (self.spec.vector and self.spec.autoreset) or not any(one[2] or one[3] for one in each):
            return each
        # One reset is for all environments: it truncates the episodes that have not ended.
        begun = self.spec.split(self.transport.reset(None, None))
        return [
            (first, reward, terminated, truncated or not terminated, {**info, "final_obs": last, "final_info": final})
            for (first, info), (last, reward, terminated, truncated, final) in zip(begun, each, strict=True)
        ]


class Described:
    """Properties of the environment at the other end, from the description that the server sends on connecting."""

    @property
    def _description(self) -> EnvSpecMessage:
        raise NotImplementedError

    @property
    def env_id(self) -> str:
        """The Gymnasium id of the remote environment."""
        return self._description.env_id

    @property
    def period(self) -> float | None:
        """Time between two actions [s]; None if the server does not report it."""
        return self._description.period

    @property
    def max_episode_steps(self) -> int | None:
        """Steps after which the server truncates an episode."""
        return self._description.max_episode_steps

    def describe(self) -> dict[str, Any]:
        """The meaning of every number of observation, action, state and command; empty if not reported."""
        return dict(self._description.signals)


class RemoteVectorEnv(Described, gym.vector.VectorEnv[Any, Any, Any]):
    """The environments of one or several transports with the same spaces, stepped at the same time.

    An environment whose episode ends is reset in the same step (`AutoresetMode.SAME_STEP`). The arms of a rack without
    `bam-serve` have one reset: when the episode of one arm ends, those of the others are truncated. It connects on
    first use. Faults are raised once every transport has answered; then a `reset` is needed. It is closed when Python
    ends.

    Args:
        transports: Each takes one request per step.
        num_envs: Expected total number of environments; None for any.
    """

    def __init__(self, transports: Transport | Sequence[Transport], num_envs: int | None = None) -> None:
        self.transports = [transports] if isinstance(transports, Transport) else list(transports)
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self._wanted, self._racks = num_envs, list[Rack]()
        self._threads: ThreadPoolExecutor | None = None
        self._process = 0
        self._observations: list[Any] | None = None
        """The last observation of each environment; None while a reset is needed."""
        if not self.transports:
            raise InvalidValue("There must be at least one transport.")
        close_at_exit(self)

    def connect(self) -> list[EnvSpecMessage]:
        """Return the description of each transport's environments.

        Raises:
            NoServer: No server, or none with this environment.
            InvalidValue: The spaces differ, or there are not `num_envs` environments.
        """
        if not self._racks:
            specs = self._at_once(lambda transport: transport.connect(), self.transports)
            for number, spec in enumerate(specs[1:], start=2):
                for name in ("observation_space", "action_space"):
                    first, other = getattr(specs[0], name), getattr(spec, name)
                    if space_to_json(other) != space_to_json(first):
                        raise InvalidValue(
                            f"The {name} of transport {number} is {other}, and that of the first {first}; environments "
                            f"of one batch must be alike."
                        )
            firsts = [0, *accumulate(spec.num_envs for spec in specs)]
            if self._wanted not in (None, firsts[-1]):
                raise InvalidValue(f"num_envs must be {firsts[-1]}, as many as there are, not {self._wanted}.")
            self._racks = [Rack(*one) for one in zip(self.transports, specs, firsts, strict=False)]
        return [rack.spec for rack in self._racks]

    @property
    def _description(self) -> EnvSpecMessage:
        return self.connect()[0]

    @property
    def num_envs(self) -> int:  # type: ignore[override]
        """Total number of environments."""
        return sum(spec.num_envs for spec in self.connect())

    @property
    def single_observation_space(self) -> Space[Any]:  # type: ignore[override]
        """The observation space of one environment."""
        return self._description.observation_space

    @property
    def single_action_space(self) -> Space[Any]:  # type: ignore[override]
        """The action space of one environment."""
        return self._description.action_space

    @cached_property
    def observation_space(self) -> Space[Any]:  # type: ignore[override]
        """The observation space of all environments."""
        return batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def action_space(self) -> Space[Any]:  # type: ignore[override]
        """The action space of all environments."""
        return batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: Seed = None, options: Info | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every environment, or in those of ``options["reset_mask"]`` (n,) bool.

        Args:
            seed: Environment i is seeded with ``seed + i`` or ``seed[i]``; a rack with one reset takes its first seed.
            options: ``reset_mask``, and options for the servers.
        """
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds: Seeds = [None if seed is None else int(seed) + number for number in range(self.num_envs)]
        elif len(seed) != self.num_envs:
            raise InvalidValue(f"seed must be one number or {self.num_envs} of them, not {len(seed)}.")
        else:
            seeds = list(seed)
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
        self._observations, infos = map(list, zip(*chain(*parts), strict=True))
        return stack(self.single_observation_space, self._observations), join_infos(infos)

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step every environment; those whose episode ended are reset."""
        if self._observations is None:
            raise ResetNeeded("No episode is running. Call reset() first.")
        if not isinstance(self.action_space, spaces.Box):
            each = list(iterate(self.action_space, actions))
        elif np.shape(actions) == self.action_space.shape:
            each = list(np.asarray(actions))
        else:
            raise InvalidValue(f"The actions must have shape {self.action_space.shape}, not {np.shape(actions)}.")
        if len(each) != self.num_envs:
            raise InvalidValue(f"There must be one action for each of {self.num_envs} environments, not {len(each)}.")
        self._observations = None  # until the step succeeds
        parts = self._at_once(lambda rack: rack.step(each[rack.part]), self._racks)
        columns: Any = map(list, zip(*chain(*parts), strict=True))
        self._observations, rewards, terminated, truncated, infos = columns
        joined, space = join_infos(infos), self.single_observation_space
        if "final_obs" in joined and isinstance(space, spaces.Box):  # the observation if the episode continues
            pairs = zip(infos, self._observations, strict=True)
            joined["final_obs"] = stack(space, [info.get("final_obs", last) for info, last in pairs])
        elif "final_obs" in joined:
            joined["final_obs"] = np.full(len(infos), None, dtype=object)
            for i, info in enumerate(infos):
                joined["final_obs"][i] = info.get("final_obs")
        return (
            stack(space, self._observations),
            np.array(rewards, np.float64),
            np.array(terminated, np.bool_),
            np.array(truncated, np.bool_),
            joined,
        )

    def _at_once(self, call: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Apply `call` to every item at the same time; raises the first fault once all have ended."""
        if len(items) == 1:
            return [call(items[0])]
        if self._threads is None or self._process != os.getpid():  # a forked child has no threads of its parent's
            self._threads = ThreadPoolExecutor(len(items), thread_name_prefix="bam-racks")
            self._process = os.getpid()
        futures = [self._threads.submit(call, item) for item in items]
        wait(futures)
        return [future.result() for future in futures]

    def close_extras(self, **kwargs: Any) -> None:
        """Release the remote environments and drop the links."""
        self._observations = None
        for transport in self.transports:
            transport.close()
        threads, self._threads = self._threads, None
        if threads is not None and self._process == os.getpid():
            threads.shutdown()


def join_infos(each: Sequence[Info]) -> dict[str, Any]:
    """Gymnasium's vector infos with masks, from one info for each environment."""
    infos: dict[str, Any] = {}
    for key in dict.fromkeys(key for info in each for key in info):
        mask = np.array([key in info for info in each])
        values = [info[key] for info in each if key in info]
        if all(isinstance(one, Mapping) for one in values):
            infos[key] = join_infos([info.get(key, {}) for info in each])
        else:
            plain = all(isinstance(one, (bool, int, float, np.generic, np.ndarray)) for one in values)
            kinds = {(array.dtype, array.shape) for array in map(np.asarray, values)} if plain else set()
            infos[key] = np.full(len(each), None, dtype=object)
            if len(kinds) == 1:
                dtype, shape = kinds.pop()
                infos[key] = np.zeros((len(each), *shape), dtype)
            for i, value in zip(np.flatnonzero(mask), values, strict=True):
                infos[key][i] = value
        infos["_" + key] = mask
    return infos
