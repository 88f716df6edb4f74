"""`RecordDataset`: whatever happens in a Gymnasium environment goes into a data set, episode by episode."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from bam_envs.core.robot_env import RobotEnv, RobotVectorEnv
from bam_envs.core.spaces import leaves_by_path, mapped
from bam_envs.remote.wire.values import plain_info, tree_to_json
from bam_train.checkpoint.manifest import WHERE
from bam_train.data.data_set_writer import DataSetWriter
from bam_train.data.recorded_episode import Array, DataSetInfo, Episode, Leaf, nested
from bam_train.env_faults import TransparentVectorWrapper
from bam_train.environments import AnyEnv, control_period
from bam_train.errors import BadDataSet, SettingsError
from bam_train.files.place import Place
from bam_train.rollout import last_observations

Keep = Callable[[int, "int | None"], bool]
"""Whether an episode is recorded, by its number in the order of beginning and its seed."""

_NOT_RECORDED = WHERE | {"env_id", "id", "render_mode", "num_envs", "vectorization_mode"}
"""Arguments that say where or how an environment runs, not which one it is."""


def info_of(
    env: AnyEnv, env_id: str | None = None, env_kwargs: Mapping[str, Any] | None = None, period: float | None = None
) -> DataSetInfo:
    """What all episodes of `env` have in common.

    Args:
        env: One environment, or several side by side.
        env_id: Its Gymnasium id, and
        env_kwargs: its arguments; by default those of ``env.spec``.
        period: Time of a step [s], by default its own; 1 s where it says none.
    """
    spec, single = env.spec, "single_" if isinstance(env, VectorEnv) else ""
    name = env_id or (None if spec is None else spec.id)
    if name is None:
        raise SettingsError('the environment has no id to record; give env_id=, such as env_id="Own-v0"')
    kwargs = dict((spec.kwargs if spec is not None else {}) if env_kwargs is None else env_kwargs)
    registered = gym.registry.get(name)
    usual = {} if registered is None else {**registered.kwargs, "max_episode_steps": registered.max_episode_steps}
    kwargs = {key: value for key, value in kwargs.items() if key not in _NOT_RECORDED and usual.get(key) != value}
    inner: Any = env.unwrapped
    own = control_period(inner)
    return DataSetInfo(
        name,
        json.loads(json.dumps(kwargs, default=str)),
        getattr(env, single + "observation_space"),
        getattr(env, single + "action_space"),
        period or own or 1.0,
        str(getattr(getattr(getattr(inner, "robot", None), "spec", None), "name", "")),
        json.loads(json.dumps(getattr(inner, "describe", dict)())),
    )


class Tap:
    """A robot that keeps its last command, as it was asked for and as it was sent; else it is the robot itself."""

    def __init__(self, robot: Any) -> None:
        self._robot = robot
        self.commands: dict[str, Array] = {}
        """``raw_command`` and ``command``, (n, ...) each, SI units."""

    def __getattr__(self, name: str) -> Any:
        if name == "_robot":  # it is being copied or unpickled
            raise AttributeError(name)
        return getattr(self._robot, name)

    def step(self, command: Array) -> Any:
        """Step the robot."""
        asked = np.array(command)
        state = self._robot.step(command)
        self.commands = {"raw_command": asked, "command": np.array(state.command)} if asked.size else {}
        return state


class Tracks:
    """The episodes that run in n environments; `step` returns those that end.

    Args:
        env: The environments, of which `info` is.
        info: What is equal for all episodes.
        num_envs: Their number n.
        facts: Facts of every episode.
        keep: Which episodes are recorded; by default all.
    """

    def __init__(
        self, env: AnyEnv, info: DataSetInfo, num_envs: int, facts: Mapping[str, Any], keep: Keep | None
    ) -> None:
        self.info, self._n, self.facts, self._keep = info, num_envs, dict(facts), keep
        self._observation, self._action = info.observation_leaves, info.action_leaves
        self._start = np.full(num_envs, -1)
        """Number of the step with which each episode began; -1 for one that is not recorded. Shape: (n,)."""
        self._begun: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        self._count = self._first = 0
        self._steps: list[dict[str, Array]] = []
        """Columns of the steps from number `_first` on, (n, ...) each."""
        self._seen: dict[str, Array] = {}
        self._time = 0.0
        self._shapes: dict[str, tuple[int, ...] | None] = {}
        inner: Any = env.unwrapped
        self._tap = Tap(inner.robot) if isinstance(inner, (RobotEnv, RobotVectorEnv)) else None
        if self._tap is not None:
            inner.robot = self._tap

    def begin(self, env_ids: Iterable[int], observations: Any, seeds: Sequence[int | None] | None = None) -> None:
        """Begin an episode in `env_ids`; `observations` (n, ...) are those of all environments."""
        for i in env_ids:
            seed = None if seeds is None else seeds[i]
            keep = self._keep is None or self._keep(self._count, seed)
            self._start[i] = self._first + len(self._steps) if keep else -1
            self._begun[i] = {"date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
            self._begun[i] |= {} if seed is None else {"seed": int(seed)}
            self._count += 1
        self._observe(observations)

    def _observe(self, observations: Any) -> None:
        self._seen, self._time = _copied(self._observation, observations), time.time()

    def step(
        self, actions: Any, final: Any, rewards: Any, terminated: Any, truncated: Any, infos: Mapping[str, Array]
    ) -> list[Episode]:
        """Keep a step, of arrays (n, ...); `final` are the observations that it led to, before any reset.

        Args:
            actions: What the environments got.
            final: The observations, of ended episodes the last ones.
            rewards: Shape (n,).
            terminated: Shape (n,).
            truncated: Shape (n,).
            infos: Further columns, of `info_columns` and others.
        """
        if not self._seen:  # the episodes were restored, and their beginnings are unknown
            self._observe(final)
            return []
        columns = self._seen | _copied(self._action, actions) | {"reward": np.array(rewards, np.float64)}
        columns |= {"time": np.full(self._n, self._time), **({} if self._tap is None else self._tap.commands)}
        columns |= {name: values for name, values in infos.items() if self._fits(name, values)}
        self._steps.append(columns)
        self._observe(final)
        ended = np.flatnonzero(np.asarray(terminated) | np.asarray(truncated)).tolist()
        episodes = [self._episode(i, bool(terminated[i]), bool(truncated[i])) for i in ended if self._start[i] >= 0]
        self._start[ended] = -1
        used = self._start[self._start >= 0]
        first = int(used.min()) if used.size else self._first + len(self._steps)
        if first - self._first > len(self._steps) // 2:
            del self._steps[: first - self._first]
            self._first = first
        return episodes

    def cut(self, env_ids: Iterable[int]) -> list[Episode]:
        """End the episodes that run in `env_ids`, as truncated ones with the fact ``"end": "cut off"``."""
        now = self._first + len(self._steps)
        episodes = [self._episode(i, False, True) for i in env_ids if 0 <= self._start[i] < now]
        for episode in episodes:
            episode.facts["end"] = "cut off"
        self._start[list(env_ids)] = -1
        return episodes

    def rewind(self, steps: int, observations: Any) -> None:
        """Forget the last `steps`, all of episodes that run; `observations` (n, ...) are those before them."""
        del self._steps[len(self._steps) - steps :]
        self._observe(observations)

    def discard(self, env_ids: Iterable[int]) -> None:
        """Forget the episodes that run in `env_ids`."""
        self._start[list(env_ids)] = -1

    def _fits(self, name: str, values: Array) -> bool:
        """Whether a column is of the kind it was before; None stands for texts."""
        kind = None if values.dtype.kind in "UO" else values.shape[1:]
        return self._shapes.setdefault(name, kind) == kind

    def _episode(self, i: int, terminated: bool, truncated: bool) -> Episode:
        steps = self._steps[self._start[i] - self._first :]
        names = dict.fromkeys(name for step in steps for name in step)
        found = {}
        for name in names:
            kind = self._shapes.get(name, ())
            missing = np.full(self._n, "", object) if kind is None else np.full((self._n, *kind), np.nan)
            found[name] = np.stack([step.get(name, missing)[i] for step in steps])
        observed = {name: np.concatenate([found.pop(name), last[i : i + 1]]) for name, last in self._seen.items()}
        acted = {one.column: found.pop(one.column) for one in self._action}
        success = found.get("info.is_success", np.array([np.nan]))[-1]
        return Episode(
            nested(self.info.observation_space, observed, self._observation),
            nested(self.info.action_space, acted, self._action),
            found.pop("reward"),
            terminated,
            truncated,
            None if np.isnan(success) else bool(success),
            columns=found,
            facts={**self.facts, **self._begun[i]},
        )


def _copied(leaves: list[Leaf], values: Any) -> dict[str, Array]:
    return {leaf.column: np.array(leaf.of(values), leaf.dtype) for leaf in leaves}


def info_columns(infos: Mapping[str, Any], num_envs: int, prefix: str = "info.") -> dict[str, Array]:
    """The infos of a vector environment's step as columns (n, ...): float64 with NaN for none, or text with "".

    Of an episode that ended, those of its last step count. Anything but numbers and text is text of JSON.
    """
    final = infos.get("final_info", {})
    columns: dict[str, Array] = {}
    for key in dict.fromkeys([*infos, *final]):
        if key.startswith("_") or key in ("final_info", "final_obs"):
            continue
        parts = [
            (one[key], np.asarray(one.get(f"_{key}", np.ones(num_envs, bool)))) for one in (infos, final) if key in one
        ]
        name = (prefix + key).replace("/", "_")
        if isinstance(parts[0][0], Mapping):
            joined_infos = {**parts[0][0], "final_info": parts[-1][0] if len(parts) > 1 else {}}
            columns |= info_columns(joined_infos, num_envs, f"{name}.")
            continue
        for value, mask in parts:
            array = _numbers_or_texts(np.asarray(value))
            if name not in columns or columns[name].shape != array.shape or columns[name].dtype != array.dtype:
                columns[name] = np.full_like(array, "" if array.dtype == object else np.nan)
            columns[name][mask] = array[mask]
    return columns


def _numbers_or_texts(array: Array) -> Array:
    if array.dtype.kind in "biuf":
        return array.astype(np.float64)
    texts = np.empty(array.shape[:1], object)
    texts[:] = [one if isinstance(one, str) else json.dumps(tree_to_json(plain_info(one))) for one in array.tolist()]
    return texts


class _Recorder:
    """What both wrappers have."""

    def __init__(
        self,
        env: AnyEnv,
        place: str | Path | Place,
        info: DataSetInfo | None = None,
        facts: Mapping[str, Any] | None = None,
        keep: Keep | None = None,
        *,
        env_id: str | None = None,
        env_kwargs: Mapping[str, Any] | None = None,
        period: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(env)  # type: ignore[call-arg] # of the wrapper
        if isinstance(env, VectorEnv) and env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise BadDataSet(
                f"{place}: environments side by side are recorded in autoreset mode SAME_STEP, which keeps the last "
                f"observation; found {env.metadata.get('autoreset_mode')}"
            )
        info = info or info_of(env, env_id, env_kwargs, period)
        self.writer = DataSetWriter(place, info, **options)
        self._tracks = Tracks(env, info, env.num_envs if isinstance(env, VectorEnv) else 1, facts or {}, keep)
        self.extra: dict[str, Array] = {}
        """Further columns (n, ...) of the next step, such as ``raw_action`` and ``intervention``."""

    def _add(self, episodes: Iterable[Episode]) -> None:
        for episode in episodes:
            self.writer.add(episode)


class RecordDataset(_Recorder, gym.Wrapper[Any, Any, Any, Any]):
    """Records every whole episode of `env`, one environment or several side by side (`gymnasium.vector.VectorEnv`).

    ::

        env = RecordDataset(gym.make("bam/pick"), "data/pick")

    An episode that a reset or the end cuts off is recorded as truncated, with the fact ``"end": "cut off"``.

    Args:
        env: The environment; several must restart in the same step (`AutoresetMode.SAME_STEP`).
        place: The data set, which may be there already.
        info: What is equal for all episodes; by default that of `env`.
        facts: Facts of every episode, such as ``{"policy": "...", "task": "lift the cube"}``.
        keep: Which episodes are recorded, by number in the order of beginning and seed; by default all.
        env_id: Without `info`: its Gymnasium id, and
        env_kwargs: its arguments, by default those of ``env.spec``, and
        period: its time of a step [s], by default its own, or 1 s.
        options: Of `DataSetWriter`.

    Raises:
        BadDataSet: The place holds something else, or somebody else writes it.
    """

    def __new__(cls, env: AnyEnv, *arguments: Any, **options: Any) -> Any:
        """Several environments need a vector wrapper."""
        return RecordVectorDataset(env, *arguments, **options) if isinstance(env, VectorEnv) else super().__new__(cls)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._add(self._tracks.cut([0]))
        observation, info = self.env.reset(seed=seed, options=options)
        self._tracks.begin([0], _batched(observation), [seed])
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take one step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        values = {}
        for path, value in leaves_by_path(info, lambda part: isinstance(part, tuple)):
            array = np.asarray(value)
            values[".".join(map(str, path))] = array[None] if array.dtype.kind in "biuf" else _objects([value])
        ends = (np.array([terminated]), np.array([truncated]))
        columns = info_columns(values, 1) | self.extra
        self._add(self._tracks.step(_batched(action), _batched(observation), [reward], *ends, columns))
        return observation, reward, terminated, truncated, info

    def rewind(self, steps: int, observation: Any) -> None:
        """Forget the last `steps` of the episode that runs, which goes on from `observation`."""
        self._tracks.rewind(steps, _batched(observation))

    def discard(self) -> None:
        """Forget the episode that runs: it is not recorded."""
        self._tracks.discard([0])

    def close(self) -> None:
        """Write what is left, and close the environment."""
        try:
            self._add(self._tracks.cut([0]))
            self.writer.close()
        finally:
            super().close()  # type: ignore[no-untyped-call]


class RecordVectorDataset(_Recorder, TransparentVectorWrapper):
    """`RecordDataset` of several environments."""

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every environment, or in those of ``options["reset_mask"]``."""
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        self._add(self._tracks.cut(np.flatnonzero(mask).tolist()))
        observations, infos = self.env.reset(seed=seed, options=options)
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, (int, np.integer)) else seed
        self._tracks.begin(np.flatnonzero(mask).tolist(), observations, seeds)
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step every environment."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        ended: NDArray[np.bool_] = np.asarray(terminated) | np.asarray(truncated)
        final = last_observations(observations, infos, ended)
        columns = info_columns(infos, self.num_envs) | self.extra
        self._add(self._tracks.step(actions, final, rewards, terminated, truncated, columns))
        if ended.any():
            self._tracks.begin(np.flatnonzero(ended).tolist(), observations)
        return observations, rewards, terminated, truncated, infos

    @contextlib.contextmanager
    def whole(self) -> Iterator[RecordVectorDataset]:
        """Close it after the ``with`` block; if that ends early, as by Ctrl-C, without the episodes that run."""
        with contextlib.closing(self):
            try:
                yield self
            except BaseException:
                self._tracks.discard(range(self.num_envs))
                raise

    def close(self, **kwargs: Any) -> None:
        """Write what is left, and close the environments."""
        try:
            self._add(self._tracks.cut(range(self.num_envs)))
            self.writer.close()
        finally:
            super().close(**kwargs)


def _batched(value: Any) -> Any:
    return mapped(lambda array: np.asarray(array)[None], value)


def _objects(values: list[Any]) -> Array:
    array = np.empty(len(values), object)
    array[:] = values
    return array
