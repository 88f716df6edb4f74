"""What a run does when an env runner dies: it goes on with the others while a new one takes its place.

Lost is what the dead runner had sampled since its last delivery: an update takes and counts the samples that were
delivered. RLlib keeps the cause in a log file on the runner's computer; so a runner writes it into the cluster's
key-value store before it ends.
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
SAMPLE_TIMEOUT = 60.0  # s that an update waits for the samples of its slowest runner

PROBE_TIMEOUT = 0.25
"""How long each update waits for a sign of life of the runners that are gone [s]; RLlib's own is half a minute.

They answer within milliseconds once they are back, and are asked again before the next update.
"""

RESTART_DELAY = 1.0  # s between the failure of a runner's environment and its restart; RLlib's own is a minute

MOST_DEATHS, WINDOW = 5, 20
"""How often one runner may die within so many updates; those made while no runner was there do not count."""

LONGEST_ALONE = 180.0  # s that a run waits while all runners are gone; a busy computer takes half a minute to start one


class FaultReporting:
    """Before a runner class: what goes wrong while it is made, or in `sample`, is reported, and raised as it was."""

    def __init__(self, **named: Any) -> None:
        try:
            super().__init__(**named)
        except Exception as error:
            if index := int(named.get("worker_index") or 0):
                _report(index, _own_cause(error))
            raise

    def sample(self, *arguments: Any, **named: Any) -> Any:
        """Collect samples as the runner does."""
        try:
            return super().sample(*arguments, **named)  # type: ignore[misc]
        except Exception as error:
            cause = _own_cause(error)
            if index := int(getattr(self, "worker_index", 0) or 0):
                _report(index, cause)
                raise
            raise cause from None if cause is not error else cause.__cause__


class ReportingEnvRunner(FaultReporting, SingleAgentEnvRunner):  # type: ignore[misc]
    """RLlib's own runner of single agents, which says why it dies."""

    def make_env(self) -> None:
        """As RLlib's, which registers the same name every time, and Gymnasium warns of it from the second time on."""
        gym.registry.pop("rllib-single-agent-env-v0", None)
        super().make_env()


def _report(index: int, error: BaseException) -> None:
    """Keep why the runner with this index dies."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"[:LONGEST_CAUSE].rstrip(": ")
    internal_kv._internal_kv_put(_key(index), text.encode())


def cause_of_death(index: int) -> str | None:
    """Why the runner with this index died last, if it could report it; the next call does not say it again."""
    text: bytes | None = internal_kv._internal_kv_get(_key(index))
    if text is None:
        return None
    internal_kv._internal_kv_del(_key(index))
    return text.decode(errors="replace")


def first_cause_of_death(number: int) -> str | None:
    """Why the first that died of runners 1 to `number` did, if one could report it."""
    if not internal_kv._internal_kv_initialized():
        return None
    causes = ((index, cause_of_death(index)) for index in range(1, number + 1))
    return next((f"env runner {index} died ({why})" for index, why in causes if why), None)


def _key(index: int) -> bytes:
    return f"bam-train/{ray.get_runtime_context().get_job_id()}/runner-{index}".encode()


def _own_cause(error: Exception) -> Exception:
    """RLlib raises a bare RuntimeError from what an environment raised."""
    cause = error.__cause__
    return cause if type(error) is RuntimeError and not error.args and isinstance(cause, Exception) else error


class RunnerWatch:
    """Looks after the runners of an algorithm of `make_config`, which is trained by `train` from now on.

    It looks before each training step and after the last of an iteration; `clock` is monotonic time [s], and `cause_of`
    says why the runner of an index died.
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
            algorithm.restore_env_runners = self._restore  # an algorithm without samples may never leave its loop

    def train(self) -> tuple[dict[str, Any], list[str]]:
        """One iteration: RLlib's result, and what the user should know about runners, one line each.

        Raises:
            ProcessesLost: A runner dies again and again, or all are gone for good; says why they died if they could.
            TrainingFailed: A learner died, or the cluster did.
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
        """Replaces the algorithm's own `restore_env_runners`, which it calls."""
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
        """Note who died since the last look."""
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
