"""Env runners of RLlib: one over a batched simulation; and the causes of their deaths.

RLlib's own `SingleAgentEnvRunner` appends to n Python episodes at every step, and runs its connectors over each. In
`RobotEnvRunner` a step of n environments is one pass of the module, one batched action and one `RobotVectorEnv.step`:
10,300 instead of 2,200 steps per CPU second with 64 environments of bam/reach. The result is the same: a list of
`SingleAgentEpisode`, ended ones with their last observation, running ones in pieces.
"""

import contextlib
import itertools
import logging
import math
import os
import re
import sys
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.env.env_runner import ENV_STEP_FAILURE
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer
from ray.rllib.utils.metrics import RLMODULE_INFERENCE_TIMER, WEIGHTS_SEQ_NO
from ray.rllib.utils.spaces.space_utils import clip_action, unsquash_action

from bam_envs.core.registry import resolve_id
from bam_train.env_faults import FiniteVectorEnv
from bam_train.environments import is_batched, make_vector_env
from bam_train.errors import SettingsError
from bam_train.rollout import success_of
from bam_train.trainers.rllib.mean_std_filter import MeanStdFilter
from bam_train.trainers.rllib.rllib_freezing import LAYOUT_CONNECTORS

Array = NDArray[Any]

LONGEST_CAUSE = 500  # characters
SAMPLE_TIMEOUT = 60.0  # longest wait of an update for the samples of its slowest runner [s]

PROBE_TIMEOUT = 0.25
"""Longest wait of an update for an answer of dead runners [s]; RLlib's default is half a minute.

Restarted runners answer within milliseconds, and are asked again before the next update.
"""

RESTART_DELAY = 1.0  # s between the failure of a runner's environment and its restart; RLlib's default is a minute

ENDS = "ends"
"""Additional metric: return, length and success of every episode that ended, in order."""


def log_end(metrics: Any, length: int, total: float, success: bool | None) -> None:
    """Log the length of an episode, its undiscounted return, and its success if that is known."""
    metrics.log_value((ENDS, "return"), total, reduce="item_series")
    metrics.log_value((ENDS, "length"), length, reduce="item_series")
    if success is not None:
        metrics.log_value((ENDS, "success"), float(success), reduce="item_series")


# What a dead runner tells


class FaultReporting:
    """Mixin for a runner class: the process of a runner ends with the cause, which RLlib then logs with the death."""

    def __init__(self, **kwargs: Any) -> None:
        try:
            super().__init__(**kwargs)
        except Exception as error:
            if index := kwargs.get("worker_index"):
                raise RuntimeError(_last_words(index, error)) from error
            raise

    def apply(self, *args: Any, **kwargs: Any) -> Any:
        """Call a function with the runner; RLlib ends the process after any exception, without its text."""
        try:
            return super().apply(*args, **kwargs)  # type: ignore[misc]
        except SystemExit as end:
            if isinstance(end.__context__, Exception):
                sys.exit(_last_words(self.worker_index, end.__context__))  # type: ignore[attr-defined]
            raise

    def sample(self, *args: Any, **kwargs: Any) -> Any:
        """Collect samples as the runner does, with the environment's exception instead of RLlib's bare RuntimeError."""
        try:
            return super().sample(*args, **kwargs)  # type: ignore[misc]
        except RuntimeError as error:
            if type(error) is not RuntimeError or error.args or not isinstance(error.__cause__, Exception):
                raise
            raise error.__cause__ from None


class ReportingEnvRunner(FaultReporting, SingleAgentEnvRunner):  # type: ignore[misc]
    """RLlib's own runner of single agents, which reports the cause of its death."""

    def make_env(self) -> None:
        """As RLlib's, without Gymnasium's warning that its name is registered already."""
        gym.registry.pop("rllib-single-agent-env-v0", None)
        super().make_env()


def _last_words(index: int, error: BaseException) -> str:
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"[:LONGEST_CAUSE].rstrip(": ")
    return f"[[env runner {index} died ({text})]]"


class CausesOfDeath(logging.Handler):
    """The last words of runners by index, from the log of RLlib, which gives them nowhere else."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.known: dict[int, str] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Read a record."""
        for index, text in re.findall(r"\[\[env runner (\d+) died \((.*?)\)\]\]", record.getMessage()):
            self.known[int(index)] = text

    def pop(self, index: int) -> str | None:
        """The last cause of death of the runner with this index, if it was reported; a second call returns None."""
        return self.known.pop(index, None)


CAUSES = CausesOfDeath()
logging.getLogger("ray.rllib.utils.actor_manager").addHandler(CAUSES)


# The batched runner


@dataclass
class _Running:
    """The running episode of an environment: its id, and its length and return so far."""

    id: str = field(default_factory=lambda: uuid.uuid4().hex)
    length: int = 0
    total: float = 0.0


class RobotEnvRunner(FaultReporting, SingleAgentEnvRunner):  # type: ignore[misc]
    """Collects episodes on ``num_envs_per_env_runner`` batched copies of an environment of `bam_envs`.

    The only connector besides RLlib's defaults may be `MeanStdFilter`, and the module must not be recurrent. Callbacks
    on environments, single steps and episodes are not called.
    """

    env: Any
    num_envs: int

    def __init__(self, *, config: Any, **kwargs: Any) -> None:
        super().__init__(config=config, **kwargs)
        self._observation: Array = np.empty(0)
        self._noise: torch.Tensor | None = None  # of the actions, in standard deviations
        """The module's next observations, (n, ...)."""
        self._running = [_Running() for _ in range(self.num_envs)]
        pieces = list(self._env_to_module.connectors)
        filters = [piece for piece in pieces if isinstance(piece, MeanStdFilter)]
        self._filter: MeanStdFilter | None = filters[0] if filters else None
        others = [type(piece).__name__ for piece in (*pieces, *self._module_to_env.connectors) if piece not in filters]
        if found := ", ".join(name for name in others if name not in {*LAYOUT_CONNECTORS, "NormalizeAndClipActions"}):
            raise SettingsError(
                "RobotEnvRunner: expected the MeanStdFilter of bam_train.trainers.rllib.mean_std_filter or no "
                f"connector, found {found}; leave env_runner_cls out to use RLlib's own "
                "runner"
            )
        if self.module is not None and self.module.is_stateful():
            raise SettingsError(
                "RobotEnvRunner: expected a module without a state, found a recurrent one; leave it out"
            )

    def make_env(self) -> None:
        """Make one vector environment, with automatic resets in the same step."""
        if self.env is not None:
            self.env.close()
        name = self.config.env
        env_id = name if name in gym.registry else resolve_id(name)
        if not is_batched(env_id):
            raise SettingsError(
                f"RobotEnvRunner: expected one of our environments, found {name!r}; leave env_runner_cls out"
            )
        kwargs = dict(self.config.env_config)
        with _cores(self.config.num_cpus_per_env_runner if self.worker_index else None):
            self.env = FiniteVectorEnv(make_vector_env(env_id, kwargs, self.config.num_envs_per_env_runner), env_id)
        self.num_envs = self.env.num_envs
        self._needs_initial_reset = True

    def _sample(
        self,
        *,
        num_timesteps: int | None = None,
        num_episodes: int | None = None,
        explore: bool,
        random_actions: bool = False,
        force_reset: bool = False,
    ) -> list[SingleAgentEpisode]:
        """Collect `num_timesteps` steps, rounded up to a multiple of the number of environments, or whole episodes."""
        if force_reset or num_episodes is not None or self._needs_initial_reset:
            self._begin()
        self._needs_initial_reset = num_episodes is not None
        episodes = None
        while episodes is None:
            if num_timesteps is not None:
                episodes = self._collect(math.ceil(num_timesteps / self.num_envs), explore, random_actions)
            else:
                episodes = self._collect_episodes(num_episodes or 1, explore, random_actions)
            if episodes is None:
                self._begin()  # the environment failed and was made anew: its samples are lost
        steps = sum(map(len, episodes))
        self._log_env_steps(metric=self._metrics_num_env_steps_sampled, num_steps=steps)
        self._increase_sampled_metrics(steps, sum(episode.is_done for episode in episodes))
        return episodes

    def _begin(self) -> None:
        """Reset all environments, each with the run's seed plus the number of environments before it in all runners."""
        seed, index = None, self.worker_index or 0
        if self._needs_initial_reset and self._seed is not None:
            seed = int(self._seed - index + max(0, index - 1) * self.num_envs)
        observations, _ = self._try_env_reset(seed=seed, options=None)
        self._observation = self._filtered(observations)
        self._running = [_Running() for _ in range(self.num_envs)]

    def _filtered(self, observations: Array) -> Array:
        """The module's observations (n, ...), as a copy, because the environment may reuse its array."""
        return np.array(observations) if self._filter is None else self._filter.normalize(observations)

    def _collect_episodes(self, count: int, explore: bool, random_actions: bool) -> list[SingleAgentEpisode] | None:
        """Step every environment until `count` episodes have ended, and return these; None if one failed."""
        done: list[SingleAgentEpisode] = []
        begun: dict[str, SingleAgentEpisode] = {}
        while len(done) < count:
            collected = self._collect(32, explore, random_actions)
            if collected is None:
                return None
            for piece in sorted(collected, key=lambda piece: piece.t_started):
                episode = begun.setdefault(piece.id_, piece)
                if episode is not piece:
                    episode.concat_episode(piece)
                if piece.is_done:
                    done.append(begun.pop(piece.id_))
        return done[:count]

    def _collect(self, steps: int, explore: bool, random_actions: bool) -> list[SingleAgentEpisode] | None:
        """Step every environment `steps` times; None if the environment failed and was made anew.

        Returns:
            Episodes and pieces of episodes; those that ended come first.
        """
        seen: list[Array] = [self._observation]
        taken: list[dict[str, Array]] = []
        finals: dict[tuple[int, int], tuple[Array, bool | None]] = {}
        """Last observation and success by (environment, step)."""
        for t in range(steps):
            if random_actions:
                actions = self.env.action_space.sample()
                columns = {Columns.ACTIONS: actions}
            else:
                columns, actions = self._act(t, explore)
            results = self._try_env_step(actions)
            if results == ENV_STEP_FAILURE:
                return None
            observations, rewards, terminated, truncated, infos = results
            ended = np.flatnonzero(terminated | truncated)
            if len(ended):
                last = self._filtered(np.asarray(infos["final_obs"])[ended])
                for env_id, observation in zip(ended.tolist(), last, strict=True):
                    finals[env_id, t] = observation, success_of(infos, env_id)
            self._observation = self._filtered(observations)
            seen.append(self._observation)
            ends = {Columns.TERMINATEDS: np.array(terminated), Columns.TRUNCATEDS: np.array(truncated)}
            taken.append({**columns, Columns.REWARDS: np.array(rewards, np.float32), **ends})
        table = {name: np.stack([columns[name] for columns in taken], axis=1) for name in taken[0]}
        return self._cut(np.stack(seen, axis=1), table, finals)

    def _cut(
        self, seen: Array, table: dict[str, Array], finals: Mapping[tuple[int, int], tuple[Array, bool | None]]
    ) -> list[SingleAgentEpisode]:
        """Cut observations (n, T + 1, ...) and columns (n, T, ...) into episodes, and continue the running ones."""
        ended, open_ = [], []
        space, action_space = self._env_to_module.observation_space, self.env.single_action_space
        dones = {name: table.pop(name) for name in (Columns.TERMINATEDS, Columns.TRUNCATEDS)}
        table[WEIGHTS_SEQ_NO] = np.full(table[Columns.REWARDS].shape, self._weights_seq_no)
        for env_id, running in enumerate(self._running):
            ends = np.flatnonzero(dones[Columns.TERMINATEDS][env_id] | dones[Columns.TRUNCATEDS][env_id]) + 1
            for start, stop in itertools.pairwise(np.unique([0, *ends, seen.shape[1] - 1]).tolist()):
                observations = seen[env_id, start : stop + 1].copy()
                terminated, truncated = (bool(flags[env_id, stop - 1]) for flags in dones.values())
                if terminated or truncated:
                    observations[-1], success = finals[env_id, stop - 1]
                columns = {name: values[env_id, start:stop].copy() for name, values in table.items()}
                actions, rewards = columns.pop(Columns.ACTIONS), columns.pop(Columns.REWARDS)
                episode = SingleAgentEpisode(
                    id_=running.id,
                    observations=InfiniteLookbackBuffer(observations, 0, space),
                    observation_space=space,
                    actions=InfiniteLookbackBuffer(actions, 0, action_space),
                    action_space=action_space,
                    rewards=InfiniteLookbackBuffer(rewards, 0),
                    infos=[{}] * (stop - start + 1),
                    terminated=terminated,
                    truncated=truncated and not terminated,
                    extra_model_outputs={name: InfiniteLookbackBuffer(part, 0) for name, part in columns.items()},
                    t_started=running.length,
                    len_lookback_buffer=0,
                )
                running.length += stop - start
                running.total += float(rewards.sum(dtype=np.float64))
                if not (terminated or truncated):
                    open_.append(episode)
                    continue
                ended.append(episode)
                self._log_episode_metrics(running.length, running.total, running.length * self.env.period)
                log_end(self.metrics, running.length, running.total, success)
                running = self._running[env_id] = _Running()
        return ended + open_

    def _act(self, step: int, explore: bool) -> tuple[dict[str, Array], Array]:
        """The module's outputs with its actions, each (n, ...), and the actions in the environment's action space."""
        batch = {Columns.OBS: torch.from_numpy(self._observation).to(self._device)}
        with torch.inference_mode(), self.metrics.log_time(RLMODULE_INFERENCE_TIMER):
            if explore:
                runners = self.config.num_env_runners or 1
                steps = self.num_env_steps_sampled_lifetime // runners + step * self.num_envs
                outputs = self.module.forward_exploration(batch, t=steps * runners)
            else:
                outputs = self.module.forward_inference(batch)
            outputs = dict(outputs)
            if Columns.ACTIONS not in outputs:  # the module returns a distribution
                module = self.module
                kind = module.get_exploration_action_dist_cls if explore else module.get_inference_action_dist_cls
                distribution = kind().from_logits(outputs[Columns.ACTION_DIST_INPUTS])
                drawn = self._explored(distribution, step) if explore else distribution.to_deterministic().sample()
                outputs[Columns.ACTIONS] = drawn
                if explore:
                    outputs[Columns.ACTION_LOGP] = distribution.logp(drawn)
        columns = {name: value.cpu().numpy() for name, value in outputs.items() if isinstance(value, torch.Tensor)}
        actions, space = columns[Columns.ACTIONS], self.env.single_action_space
        if self.config.normalize_actions:  # RLlib's `NormalizeAndClipActions`, for the whole batch
            actions = unsquash_action(actions, space)
        elif self.config.clip_actions:
            actions = clip_action(actions, space)
        return columns, np.asarray(actions, space.dtype)

    def _explored(self, distribution: Any, step: int) -> torch.Tensor:
        """Actions drawn from the distribution, with the same noise for ``noise_steps`` steps; see `OURS`."""
        drawn: torch.Tensor = distribution.sample()
        kept = getattr(self.config, "noise_steps", 1)
        if kept == 1:
            return drawn
        mean, std = distribution._dist.mean, distribution._dist.stddev
        if self._noise is None or step % kept == 0:
            self._noise = (drawn - mean) / std
        return mean + std * self._noise


@contextlib.contextmanager
def _cores(count: float | None) -> Iterator[None]:
    """Limit this thread to `count` cores: a simulation made in the ``with`` block starts a thread for each core."""
    if count is None or not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[: max(1, int(count))])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
