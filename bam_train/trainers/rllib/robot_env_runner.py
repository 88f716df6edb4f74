"""RLlib's runner over one batched simulation: arrays of all environments from step to step, episodes at the end.

RLlib's own `SingleAgentEnvRunner` appends to n Python episodes at every step, and runs its connectors over each. Here a
step of n environments is one pass of the module, one batched action and one `RobotVectorEnv.step`. What comes out is
the same: a list of `SingleAgentEpisode`, the ones that ended with what they observed last, the running ones in pieces.

The file is long because each method of its one large class stands in for one of RLlib's.
"""

from __future__ import annotations

import contextlib
import math
import os
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from ray.rllib.callbacks.utils import make_callback
from ray.rllib.core.columns import Columns
from ray.rllib.env.env_context import EnvContext
from ray.rllib.env.env_runner import ENV_STEP_FAILURE
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer
from ray.rllib.utils.metrics import RLMODULE_INFERENCE_TIMER, WEIGHTS_SEQ_NO
from ray.rllib.utils.spaces.space_utils import clip_action, unsquash_action

from bam_train.environments import is_batched, make_vector_env
from bam_train.errors import SettingsError
from bam_train.finite_envs import FiniteVectorEnv
from bam_train.trainers.rllib.mean_std_filter import MeanStdFilter
from bam_train.trainers.rllib.runner_deaths import FaultReporting

Array = NDArray[Any]

ENDS = "ends"
"""Metric beside RLlib's own: return, length and success of every episode that ended, one after the other."""


class RobotEnvRunner(FaultReporting, SingleAgentEnvRunner):  # type: ignore[misc]
    """Collects episodes on ``num_envs_per_env_runner`` batched copies of one of our environments.

    Its connectors are RLlib's defaults and, before them, `MeanStdFilter` or nothing; its module has no state.
    Callbacks on single steps and episodes are not called.
    """

    env: Any
    num_envs: int

    def __init__(self, *, config: Any, **kwargs: Any) -> None:
        super().__init__(config=config, **kwargs)
        self._filter = self._find_filter()
        self._seen: Array = np.empty(0)
        self._running = Running(self.num_envs)
        self._ended: list[End] = []
        if self.module is not None and self.module.is_stateful():
            raise SettingsError(
                "RobotEnvRunner: expected a module without a state, found a recurrent one; leave it out"
            )

    def _find_filter(self) -> MeanStdFilter | None:
        """The filter among the connectors, which are otherwise RLlib's own."""
        pieces = list(self._env_to_module.connectors)
        own = [piece for piece in pieces if type(piece).__module__ == MeanStdFilter.__module__]
        strange = [
            type(piece).__name__ for piece in pieces if piece not in own and type(piece).__name__ not in _DEFAULT_PIECES
        ]
        if strange or self.config._module_to_env_connector is not None:
            found = ", ".join(strange) or "a module-to-env connector"
            raise SettingsError(
                "RobotEnvRunner: expected the MeanStdFilter of bam_train.trainers.rllib.mean_std_filter or no "
                f"connector, found {found}; leave env_runner_cls out to use RLlib's own runner"
            )
        return own[0] if own else None

    def make_env(self) -> None:
        """One vector environment, with automatic resets in the same step."""
        if self.env is not None:
            self.env.close()
        name = self.config.env
        env_id = name if name in gym.registry else _with_version(name)
        if not is_batched(env_id):
            raise SettingsError(
                f"RobotEnvRunner: expected one of our environments, found {name!r}; leave env_runner_cls out"
            )
        kwargs = dict(self.config.env_config)
        with _cores(self.config.num_cpus_per_env_runner if self.worker_index else None):
            self.env = FiniteVectorEnv(make_vector_env(env_id, kwargs, self.config.num_envs_per_env_runner), env_id)
        if self.env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise SettingsError(f"{env_id}: expected environments that restart in the same step")
        self.num_envs = self.env.num_envs
        self._needs_initial_reset = True
        context = EnvContext(kwargs, worker_index=self.worker_index or 0, num_workers=self.num_workers)
        make_callback(
            "on_environment_created",
            callbacks_objects=self._callbacks,
            callbacks_functions=self.config.callbacks_on_environment_created,
            kwargs={
                "env_runner": self,
                "metrics_logger": self.metrics,
                "env": self.env.unwrapped,
                "env_context": context,
            },
        )

    def _sample(
        self,
        *,
        num_timesteps: int | None = None,
        num_episodes: int | None = None,
        explore: bool,
        random_actions: bool = False,
        force_reset: bool = False,
    ) -> list[SingleAgentEpisode]:
        """As many steps as asked for, up to the next multiple of the number of environments; or whole episodes."""
        if force_reset or num_episodes is not None or self._needs_initial_reset:
            self._begin()
        self._needs_initial_reset = num_episodes is not None
        while True:
            if num_timesteps is not None:
                episodes = self._collect(math.ceil(num_timesteps / self.num_envs), explore, random_actions)
            else:
                episodes = self._collect_episodes(num_episodes or 1, explore, random_actions)
            if episodes is not None:
                break
            self._begin()  # the environment failed and was made anew: what was collected is lost
        steps = sum(map(len, episodes))
        self._log_env_steps(metric=self._metrics_num_env_steps_sampled, num_steps=steps)
        self._increase_sampled_metrics(steps, sum(episode.is_done for episode in episodes))
        return episodes

    def _begin(self) -> None:
        """Begin an episode everywhere; environment i of the k-th runner is seeded by how many come before it."""
        seed = self._first_seed() if self._needs_initial_reset else None
        observations, _ = self._try_env_reset(seed=seed, options=None)
        self._seen = self._as_seen(observations)
        self._running = Running(self.num_envs)

    def _first_seed(self) -> int | None:
        if self._seed is None:
            return None
        index = self.worker_index or 0
        return int(self._seed - index + max(0, index - 1) * self.num_envs)

    def _as_seen(self, observations: Array) -> Array:
        """Observations as the module sees them: a copy, for the environment may write into its own."""
        return np.array(observations) if self._filter is None else self._filter.normalize(observations)

    def _collect(self, steps: int, explore: bool, random_actions: bool) -> list[SingleAgentEpisode] | None:
        """Step every environment `steps` times; None if the environment failed."""
        rollout = Rollout(self.num_envs, steps, self._seen)
        for _ in range(steps):
            if not self._step(rollout, explore, random_actions):
                return None
        return self._cut(rollout)

    def _collect_episodes(self, count: int, explore: bool, random_actions: bool) -> list[SingleAgentEpisode] | None:
        """Step every environment until `count` episodes have ended, and return these."""
        done: list[SingleAgentEpisode] = []
        pieces: dict[str, list[SingleAgentEpisode]] = {}
        while len(done) < count:
            collected = self._collect(32, explore, random_actions)
            if collected is None:
                return None
            for episode in sorted(collected, key=lambda one: one.t_started):
                pieces.setdefault(episode.id_, []).append(episode)
                if episode.is_done:
                    done.append(_joined(pieces.pop(episode.id_)))
        return done[:count]

    def _step(self, rollout: Rollout, explore: bool, random_actions: bool) -> bool:
        """One step of every environment; False if the environment failed and was made anew."""
        columns, actions = self._random() if random_actions else self._act(rollout.steps, explore)
        results = self._try_env_step(actions)
        if results == ENV_STEP_FAILURE:
            return False
        observations, rewards, terminated, truncated, infos = results
        ended = np.flatnonzero(terminated | truncated)
        if len(ended):
            finals = self._as_seen(np.asarray(infos["final_obs"])[ended])
            rollout.end(ended, finals, infos.get("final_info", {}).get("is_success"))
        self._seen = self._as_seen(observations)
        rollout.add(columns, rewards, terminated, truncated, self._seen)
        return True

    def _random(self) -> tuple[dict[str, Array], Array]:
        actions = self.env.action_space.sample()
        return {Columns.ACTIONS: actions}, actions

    def _act(self, step: int, explore: bool) -> tuple[dict[str, Array], Array]:
        """What the module says, and the actions as the environment takes them."""
        batch = {Columns.OBS: torch.from_numpy(self._seen).to(self._device)}
        with torch.inference_mode(), self.metrics.log_time(RLMODULE_INFERENCE_TIMER):
            if explore:
                runners = self.config.num_env_runners or 1
                own = self.num_env_steps_sampled_lifetime // runners + step * self.num_envs
                said = self.module.forward_exploration(batch, t=own * runners)
            else:
                said = self.module.forward_inference(batch)
            said = self._sampled(dict(said), explore)
        columns = {name: value.cpu().numpy() for name, value in said.items() if isinstance(value, torch.Tensor)}
        return columns, self._for_env(columns[Columns.ACTIONS])

    def _sampled(self, said: dict[str, Any], explore: bool) -> dict[str, Any]:
        """With actions, drawn from their distribution if the module did not choose them itself."""
        if Columns.ACTIONS in said:
            return said
        kind = self.module.get_exploration_action_dist_cls() if explore else self.module.get_inference_action_dist_cls()
        distribution = kind.from_logits(said[Columns.ACTION_DIST_INPUTS])
        if not explore:
            return {**said, Columns.ACTIONS: distribution.to_deterministic().sample()}
        actions = distribution.sample()
        return {**said, Columns.ACTIONS: actions, Columns.ACTION_LOGP: distribution.logp(actions)}

    def _for_env(self, actions: Array) -> Array:
        """RLlib's `NormalizeAndClipActions`, for the whole batch."""
        space = self.env.single_action_space
        if self.config.normalize_actions:
            actions = unsquash_action(actions, space)
        elif self.config.clip_actions:
            actions = clip_action(actions, space)
        return np.asarray(actions, space.dtype)

    def _cut(self, rollout: Rollout) -> list[SingleAgentEpisode]:
        space = self._env_to_module.observation_space
        extra = {WEIGHTS_SEQ_NO: self._weights_seq_no}
        episodes, ends = rollout.episodes(self._running, space, self.env.single_action_space, extra)
        self._ended += ends
        return episodes

    def get_metrics(self) -> Any:
        """RLlib's metrics of the episodes that ended since the last call, and how each of them went."""
        for end in self._ended:
            self._log_episode_metrics(end.length, end.total, end.length * self.env.period)
            log_end(self.metrics, end)
        self._ended.clear()
        return super().get_metrics()


def log_end(metrics: Any, end: End) -> None:
    """Note how an episode went."""
    metrics.log_value((ENDS, "return"), end.total, reduce="item_series")
    metrics.log_value((ENDS, "length"), end.length, reduce="item_series")
    if end.success is not None:
        metrics.log_value((ENDS, "success"), float(end.success), reduce="item_series")


@contextlib.contextmanager
def _cores(count: float | None) -> Iterator[None]:
    """Within, this thread sees no more cores than a runner was given: a simulation takes a thread for each it sees."""
    if count is None or not hasattr(os, "sched_setaffinity"):
        yield
        return
    all_of_them = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(all_of_them)[: max(1, int(count))])
    try:
        yield
    finally:
        os.sched_setaffinity(0, all_of_them)


_DEFAULT_PIECES = frozenset(
    {
        "AddObservationsFromEpisodesToBatch",
        "AddTimeDimToBatchAndZeroPad",
        "AddStatesFromEpisodesToBatch",
        "AgentToModuleMapping",
        "BatchIndividualItems",
        "NumpyToTensor",
    }
)


def _with_version(name: str) -> str:
    """The id that a name without a version means."""
    from bam_envs.core.registry import resolve_id

    return resolve_id(name)


def _joined(pieces: list[SingleAgentEpisode]) -> SingleAgentEpisode:
    """One whole episode out of its pieces."""
    whole, *others = pieces
    for piece in others:
        whole.concat_episode(piece)
    return whole


@dataclass(frozen=True)
class End:
    """How an episode went that ended."""

    length: int
    """Its steps."""
    total: float
    """Undiscounted sum of its rewards."""
    success: bool | None
    """None if the environment does not say."""


class Running:
    """The running episode of every environment: its name, how far it is, and what it has earned.

    Attributes:
        ids: Names, n.
        lengths: Steps so far. Shape: (n,).
        returns: Undiscounted sums of rewards. Shape: (n,).
    """

    def __init__(self, num_envs: int) -> None:
        self.ids = [uuid.uuid4().hex for _ in range(num_envs)]
        self.lengths = np.zeros(num_envs, np.int64)
        self.returns = np.zeros(num_envs)

    def restart(self, env_id: int) -> None:
        """The environment's next episode begins."""
        self.ids[env_id] = uuid.uuid4().hex
        self.lengths[env_id], self.returns[env_id] = 0, 0.0


class Rollout:
    """T steps of n environments.

    Args:
        num_envs: n.
        steps: T at most.
        first: What the environments observe at its start, as the module sees it. Shape: (n, ...).
    """

    def __init__(self, num_envs: int, steps: int, first: Array) -> None:
        self.steps = 0
        self.observations = np.empty((num_envs, steps + 1, *first.shape[1:]), first.dtype)
        self.observations[:, 0] = first
        self.rewards = np.empty((num_envs, steps), np.float32)
        self.terminated = np.zeros((num_envs, steps), bool)
        self.truncated = np.zeros((num_envs, steps), bool)
        self._finals: dict[tuple[int, int], tuple[Array, bool | None]] = {}
        self._capacity = steps
        self._columns: dict[str, Array] = {}

    def add(
        self,
        columns: Mapping[str, Array],
        rewards: Array,
        terminated: Array,
        truncated: Array,
        following: Array,
    ) -> None:
        """One step of every environment.

        Args:
            columns: Actions and whatever else the module said, each (n, ...).
            rewards: (n,).
            terminated: (n,) bool.
            truncated: (n,) bool.
            following: What the environments observe now, as the module sees it, (n, ...).
        """
        t = self.steps
        for name, values in columns.items():
            if name not in self._columns:
                self._columns[name] = np.empty((len(values), self._capacity, *values.shape[1:]), values.dtype)
            self._columns[name][:, t] = values
        self.rewards[:, t], self.terminated[:, t], self.truncated[:, t] = rewards, terminated, truncated
        self.observations[:, t + 1] = following
        self.steps = t + 1

    def end(self, env_ids: Array, observations: Array, success: Array | None) -> None:
        """The step that is added next ends the episodes of some environments.

        Args:
            env_ids: Which, (k,).
            observations: What they observe last, as the module sees it, (k, ...); `add` is given what follows.
            success: Of all environments, (n,) bool; None if the environment does not say.
        """
        for env_id, last in zip(env_ids.tolist(), observations, strict=True):
            self._finals[env_id, self.steps] = last, None if success is None else bool(success[env_id])

    def episodes(
        self,
        running: Running,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        extra: Mapping[str, Any],
    ) -> tuple[list[SingleAgentEpisode], list[End]]:
        """The steps as episodes and pieces of episodes, those that ended first; and how these went.

        Args:
            running: The episodes as they were when the rollout began; afterwards as they are at its end.
            observation_space: As the module sees it.
            action_space: The environment's.
            extra: Values that every step has, whoever took it.
        """
        ended, open_, ends = [], [], []
        for env_id in range(len(self.rewards)):
            start = 0
            done = self.terminated[env_id, : self.steps] | self.truncated[env_id, : self.steps]
            for stop in (np.flatnonzero(done) + 1).tolist():
                ended.append(self._piece(env_id, start, stop, running, observation_space, action_space, extra))
                self._go_on(running, env_id, start, stop)
                success = self._finals[env_id, stop - 1][1]
                ends.append(End(int(running.lengths[env_id]), float(running.returns[env_id]), success))
                running.restart(env_id)
                start = stop
            if start < self.steps:
                open_.append(self._piece(env_id, start, self.steps, running, observation_space, action_space, extra))
                self._go_on(running, env_id, start, self.steps)
        return ended + open_, ends

    def _go_on(self, running: Running, env_id: int, start: int, stop: int) -> None:
        running.lengths[env_id] += stop - start
        running.returns[env_id] += self.rewards[env_id, start:stop].sum(dtype=np.float64)

    def _piece(
        self,
        env_id: int,
        start: int,
        stop: int,
        running: Running,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        extra: Mapping[str, Any],
    ) -> SingleAgentEpisode:
        observations = self.observations[env_id, start : stop + 1].copy()
        terminated, truncated = bool(self.terminated[env_id, stop - 1]), bool(self.truncated[env_id, stop - 1])
        if terminated or truncated:
            observations[-1] = self._finals[env_id, stop - 1][0]
        columns = {name: _buffer(values[env_id, start:stop].copy()) for name, values in self._columns.items()}
        fixed = {name: _buffer(np.full(stop - start, value)) for name, value in extra.items()}
        before = int(running.lengths[env_id])
        return SingleAgentEpisode(
            id_=running.ids[env_id],
            observations=_buffer(observations, observation_space),
            observation_space=observation_space,
            actions=_buffer(columns.pop("actions").data, action_space),
            action_space=action_space,
            rewards=_buffer(self.rewards[env_id, start:stop].copy()),
            infos=[{}] * (stop - start + 1),
            terminated=terminated,
            truncated=truncated and not terminated,
            extra_model_outputs={**columns, **fixed},
            t_started=before,
            len_lookback_buffer=0,
        )


def _buffer(values: Array, space: gym.Space[Any] | None = None) -> InfiniteLookbackBuffer:
    return InfiniteLookbackBuffer(values, 0, space)
