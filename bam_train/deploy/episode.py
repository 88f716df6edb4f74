"""One episode of a robot: the loop that every deployment runs, on one screen.

::

    reset -> observe -> wait for the deadline -> decide -> record -> send -> observe -> ...

Send is ``env.step``: the task makes a command of the action, the guards pass, change or refuse it, and the robot gets
what they let through. Nothing else in this loop reaches the robot.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter, thread_time
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot_env import robot_of
from bam_envs.core.timing import Pacer, TickTimes
from bam_train.deploy.journal import EpisodeRecord, Journal
from bam_train.env_faults import require_finite_action
from bam_train.errors import LoopError
from bam_train.policy.background import Background

OBSERVATION = "env_obs"
"""Name of an observation that is one array; the arrays of a Dict are ``env_obs/<key>``."""


@dataclass
class EpisodeStep:
    """What was observed at a time of the episode, what the policy decided on it, and when (`perf_counter`) [s]."""

    number: int
    """0 after the reset, k after the k-th action."""
    seed: int
    """Seed of the episode."""
    arrays: dict[str, NDArray[Any]]
    """The observation. Shape: (1, ...) each."""
    begun: float
    """When the action before was sent."""
    stepped: float
    """When the observation had come."""
    latency: float = 0.0
    """Time from the deadline of the action before until it was sent [s]."""
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    success: bool | None = None
    """``is_success`` of the info; None if the environment does not say it."""
    waited: float = 0.0
    """When the wait for the deadline ended."""
    late: float = 0.0
    """Delay of the tick after its deadline [s]."""
    action: Any = None
    """The policy's decision, an array or a number; that of the last step is not sent."""
    acted: float = 0.0
    """Duration of the decision [s]; before it, of the one before."""
    computed: float = 0.0
    """CPU time of the decision [s]; before it, of the one before."""

    @property
    def observation(self) -> Any:
        """A copy as the policy gets it: an array, or a mapping for a Dict."""
        arrays = {name.removeprefix(f"{OBSERVATION}/"): array[0].copy() for name, array in self.arrays.items()}
        return arrays[OBSERVATION] if OBSERVATION in self.arrays else arrays

    def followed_by(
        self, begun: float, result: tuple[Any, Any, Any, Any, Mapping[str, Any]], space: gym.Space[Any]
    ) -> "EpisodeStep":
        """The next step: the `result` of ``env.step``, which began at `begun`; `space` is that of the observations."""
        stepped, (observation, reward, terminated, truncated, info) = perf_counter(), result
        success = info.get("is_success")
        return replace(
            self,
            number=self.number + 1,
            arrays=named_arrays(observation, space),
            begun=begun,
            latency=begun - self.waited,
            stepped=stepped,
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
            success=None if success is None else bool(success),
        )

    @property
    def is_last(self) -> bool:
        """Whether the environment has ended the episode."""
        return self.terminated or self.truncated

    @property
    def end(self) -> str:
        """How the episode ended here, ``"terminated"`` or ``"truncated"``; else ``"stopped"``, as it may be cut off."""
        return "terminated" if self.terminated else "truncated" if self.truncated else "stopped"


class Watcher(Protocol):
    """Displays the loop; called between ticks, so it must be fast."""

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> None:
        """Called after every step."""

    def ended(self, record: EpisodeRecord) -> None:
        """Called after every episode."""


class EpisodeLoop:
    """Runs episodes of `policy`, which may be exchanged between two ticks; see `Deployment` for the arguments."""

    def __init__(
        self,
        env: gym.Env[Any, Any],
        policy: Any,
        pacer: Pacer,
        journal: Journal,
        *,
        raise_again: Callable[[], None],
        between_ticks: Callable[[], bool],
    ) -> None:
        self._env, self.policy, self._pacer, self._journal = env, policy, pacer, journal
        self._raise_again, self._between_ticks = raise_again, between_ticks
        self.observers: list[Callable[[EpisodeStep], None]] = []
        """Called with each step once the policy has decided, in this order; they must be fast."""
        self.times = TickTimes(pacer.period)
        """Of the last ticks."""

    def run(self, watcher: Watcher, *, seed: int, begins: Callable[[int], None] = lambda seed: None) -> EpisodeRecord:
        """Run one episode; `begins` is called with the seed before the first action."""
        step = self._reset(seed)
        begins(seed)
        self._pacer.start()
        while True:
            self._wait(step)
            ends = step.is_last or self._between_ticks()
            self._decide(step)
            self._record(step)
            if ends:
                return self._journal.records[-1]
            step = self._send(step)
            self._write_down(step, watcher)

    def _reset(self, seed: int) -> EpisodeStep:
        self._raise_again()
        begun = perf_counter()
        observation, _ = self._env.reset(seed=seed)
        step = EpisodeStep(0, seed, named_arrays(observation, self._env.observation_space), begun, perf_counter())
        self._journal.begin(seed)
        self.policy.reset()
        if isinstance(self.policy, Background):
            self.policy.prepare(step.observation)  # the first of its chunks, while nothing moves
        return step

    def _wait(self, step: EpisodeStep) -> None:
        """Wait for the deadline of the next action; after the last step there is none."""
        if not step.is_last:
            missed = self._pacer.missed
            step.late = self._pacer.wait()
            if step.number:
                before = self._pacer.missed - missed, step.acted, step.computed
                self._journal.records[-1].slow += self.times.add(step.late, *before)
        step.waited = perf_counter()

    def _decide(self, step: EpisodeStep) -> None:
        begun, computed = perf_counter(), thread_time()
        action = np.asarray(self.policy.act(step.observation))
        step.acted, step.computed = perf_counter() - begun, thread_time() - computed
        if not step.is_last:
            require_finite_action(action, step.number, f"the episode with seed {step.seed}")
        step.action = action[()]  # a number, if it is one

    def _record(self, step: EpisodeStep) -> None:
        for observe in self.observers:
            observe(step)

    def _send(self, step: EpisodeStep) -> EpisodeStep:
        """Let the environment take the action: its task makes a command, and the guards stand before the robot."""
        self._raise_again()  # after a signal whose exception was lost, nothing more is sent
        return step.followed_by(perf_counter(), self._env.step(step.action.copy()), self._env.observation_space)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The current warnings of the robot's guards, and of the policy."""
        return (*getattr(robot_of(self._env), "warnings", ()), *getattr(self.policy, "warnings", ()))

    def _write_down(self, step: EpisodeStep, watcher: Watcher) -> None:
        """Into the journal, and before the operator's eyes."""
        self._journal.warn(self.warnings)
        record = self._journal.step(step.reward, step.success, step.end)
        watcher.ticked(record, step.action, self._pacer)
        if step.is_last:
            watcher.ended(record)


def named_arrays(observation: Any, space: gym.Space[Any], name: str = OBSERVATION) -> dict[str, NDArray[Any]]:
    """The arrays (1, ...) of an observation by name, copied, with the dtypes of `space`.

    Raises:
        LoopError: A part is neither an array nor a number.
    """
    if isinstance(observation, Mapping):
        parts = [named_arrays(value, space[key], f"{name}/{key}") for key, value in observation.items()]  # type: ignore[index]
        return {path: array for part in parts for path, array in part.items()}
    array = np.asarray(None if isinstance(observation, (tuple, str)) else observation)
    if array.dtype.kind not in "fiub":
        raise LoopError(
            f"{name!r}: expected an array, a number or a dict of them, found a {type(observation).__name__}; "
            "wrap the environment, for example in gymnasium.wrappers.FlattenObservation."
        )
    return {name: np.array(array[None], space.dtype)}
