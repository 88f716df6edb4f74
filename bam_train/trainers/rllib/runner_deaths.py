"""Deaths of env runners: the run continues with the other runners while a new one is started.

The samples that the dead runner had not delivered are lost; an update uses and counts only delivered ones. RLlib writes
the cause to a log file on the runner's computer, so a runner also writes it to the cluster's key-value store before it
ends.
"""

import time
from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import ray
from ray.exceptions import RayError
from ray.experimental import internal_kv
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

from bam_train.errors import ProcessesLost, SettingsError, TrainingFailed

LONGEST_CAUSE = 500  # characters
SAMPLE_TIMEOUT = 60.0  # longest wait of an update for the samples of its slowest runner [s]

PROBE_TIMEOUT = 0.25
"""Longest wait of an update for an answer of dead runners [s]; RLlib's default is half a minute.

Restarted runners answer within milliseconds, and are asked again before the next update.
"""

RESTART_DELAY = 1.0  # s between the failure of a runner's environment and its restart; RLlib's default is a minute

MOST_DEATHS, WINDOW = 5, 20
"""Most deaths of one runner within a number of updates; updates without any runner do not count."""

LONGEST_ALONE = 180.0  # longest wait while all runners are dead [s]; a busy computer starts one in half a minute


class FaultReporting:
    """Mixin for a runner class: exceptions in its constructor and in `sample` are reported, and raised again."""

    def __init__(self, **kwargs: Any) -> None:
        try:
            super().__init__(**kwargs)
        except Exception as error:
            if index := int(kwargs.get("worker_index") or 0):
                _report(index, _own_cause(error))
            raise

    def sample(self, *args: Any, **kwargs: Any) -> Any:
        """Collect samples as the runner does."""
        try:
            return super().sample(*args, **kwargs)  # type: ignore[misc]
        except Exception as error:
            cause = _own_cause(error)
            if index := int(getattr(self, "worker_index", 0) or 0):
                _report(index, cause)
                raise
            raise cause from None if cause is not error else cause.__cause__


class ReportingEnvRunner(FaultReporting, SingleAgentEnvRunner):  # type: ignore[misc]
    """RLlib's own runner of single agents, which reports the cause of its death."""

    def make_env(self) -> None:
        """As RLlib's, without Gymnasium's warning that its name is registered already."""
        gym.registry.pop("rllib-single-agent-env-v0", None)
        super().make_env()


def _report(index: int, error: BaseException) -> None:
    """Store the cause of death of the runner with this index."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"[:LONGEST_CAUSE].rstrip(": ")
    internal_kv._internal_kv_put(_key(index), text.encode())


def cause_of_death(index: int) -> str | None:
    """The last cause of death of the runner with this index, if it was reported; a second call returns None."""
    text: bytes | None = internal_kv._internal_kv_get(_key(index))
    if text is None:
        return None
    internal_kv._internal_kv_del(_key(index))
    return text.decode(errors="replace")


def first_cause_of_death(number: int) -> str | None:
    """The first reported cause of death among runners 1 to `number`."""
    if not internal_kv._internal_kv_initialized():
        return None
    causes = ((index, cause_of_death(index)) for index in range(1, number + 1))
    return next((f"env runner {index} died ({why})" for index, why in causes if why), None)


def _key(index: int) -> bytes:
    return f"bam-train/{ray.get_runtime_context().get_job_id()}/runner-{index}".encode()


def _own_cause(error: Exception) -> Exception:
    """The exception of the environment, from which RLlib raises a bare RuntimeError."""
    cause = error.__cause__
    return cause if type(error) is RuntimeError and not error.args and isinstance(cause, Exception) else error


class RunnerWatch:
    """Watches the runners of an algorithm of `make_config`, which must then be trained by `train`.

    Runners are checked before each training step and after the last of an iteration. `clock` is monotonic time [s];
    `cause_of` returns the cause of death of the runner with an index.
    """

    def __init__(
        self,
        algorithm: Any,
        clock: Callable[[], float] = time.monotonic,
        cause_of: Callable[[int], str | None] = cause_of_death,
    ) -> None:
        self._algorithm, self._clock, self._cause_of = algorithm, clock, cause_of
        self._group = algorithm.env_runner_group
        self._all = set(range(1, 1 + (self._group.num_remote_env_runners() if self._group else 0)))
        self._gone: set[int] = set()
        self._deaths: dict[int, deque[int]] = {index: deque(maxlen=MOST_DEATHS + 1) for index in self._all}
        self._update = 0
        self._seen_at = clock()
        self._cause = ""
        self._lines: list[str] = []
        if self._all:
            self._rllibs_restore = algorithm.restore_env_runners
            algorithm.restore_env_runners = self._restore  # without samples, an algorithm may never leave its loop

    def train(self) -> tuple[dict[str, Any], list[str]]:
        """Train one iteration; returns RLlib's result, and messages about runners for the user, one line each.

        Raises:
            ProcessesLost: A runner dies repeatedly, or all runners are lost; the message has the cause if it is known.
            TrainingFailed: A learner or the cluster died.
        """
        try:
            result: dict[str, Any] = self._algorithm.train()
        except RayError as error:
            if isinstance(cause := getattr(error, "cause", None), SettingsError):  # of recorded episodes, in a learner
                raise cause from error
            why = " ".join(str(error).split())
            raise TrainingFailed(f"a process of the cluster that training needs is gone ({why:.300})") from error
        self._look()
        self._update += len(self._gone) < len(self._all)
        lines, self._lines = self._lines, []
        return result, lines

    def _restore(self, group: Any) -> list[int]:
        """Replacement of the algorithm's `restore_env_runners`, which it calls."""
        if group is not self._group:
            return list(self._rllibs_restore(group))
        self._look()
        back = list(self._rllibs_restore(group))
        self._gone -= set(back)
        self._lines += [f"env runner {index} is back" for index in sorted(back)]
        now = self._clock()
        if self._gone < self._all:
            self._seen_at = now
        elif (waited := now - self._seen_at) > LONGEST_ALONE:
            text = f"all {len(self._all)} env runners died{self._cause}, and none came back in {waited:.0f} s"
            raise ProcessesLost(text)
        return back

    def _look(self) -> None:
        """Record the runners that died since the last check."""
        died = self._all - set(self._group.healthy_env_runner_ids()) - self._gone if self._all else set()
        if not died:
            return
        self._gone |= died
        for index in sorted(died):
            why = self._cause_of(index)
            self._cause = f" ({why})" if why else ""
            self._lines.append(f"env runner {index} died{self._cause}: what it had not delivered yet is lost")
            deaths = self._deaths[index]
            deaths.append(self._update)
            updates = self._update - deaths[0] + 1
            if len(deaths) > MOST_DEATHS and updates <= WINDOW:
                within = f"{updates} update{'s' if updates > 1 else ''}"
                raise ProcessesLost(f"env runner {index} died {len(deaths)} times within {within}{self._cause}")
        left = len(self._all) - len(self._gone)
        goes_on = f"training goes on with {left} of {len(self._all)} env runners"
        self._lines.append(goes_on if left else "no env runner is left: waiting for one to come back")
