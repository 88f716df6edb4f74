"""Why a runner died, told to the trainer's process by the runner itself, on whichever computer it is.

RLlib ends a runner whose environment fails and keeps the cause in a log file over there; the trainer learns that an
actor is gone. So a runner writes the cause into the cluster's key-value store before it ends.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import ray
from ray.experimental import internal_kv
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

LONGEST = 500
"""Characters of a cause that are kept."""


class FaultReporting:
    """Beside a runner class, before it: what goes wrong in `sample` is reported, and raised as it was.

    So is what goes wrong while it is made, such as its environment on a computer that lacks something.
    """

    def __init__(self, **named: Any) -> None:
        try:
            super().__init__(**named)
        except Exception as error:
            if index := int(named.get("worker_index") or 0):
                report(index, _own_cause(error))
            raise

    def sample(self, *arguments: Any, **named: Any) -> Any:
        """Collect samples as the runner does."""
        try:
            return super().sample(*arguments, **named)  # type: ignore[misc]
        except Exception as error:
            cause = _own_cause(error)
            index = int(getattr(self, "worker_index", 0) or 0)
            if index:
                report(index, cause)
                raise
            raise cause from None if cause is not error else cause.__cause__


class ReportingEnvRunner(FaultReporting, SingleAgentEnvRunner):  # type: ignore[misc]
    """RLlib's own runner of single agents, which says why it dies."""

    def make_env(self) -> None:
        """As RLlib's, which registers the same name every time, and Gymnasium warns of it from the second time on."""
        gym.registry.pop("rllib-single-agent-env-v0", None)
        super().make_env()


def report(index: int, error: BaseException) -> None:
    """Keep why the runner with this index dies."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"[:LONGEST].rstrip(": ")
    internal_kv._internal_kv_put(_key(index), text.encode())


def take(index: int) -> str | None:
    """Why the runner with this index died last, as far as it could say; the next call does not say it again."""
    text: bytes | None = internal_kv._internal_kv_get(_key(index))
    if text is not None:
        internal_kv._internal_kv_del(_key(index))
    return None if text is None else text.decode(errors="replace")


def take_first(number: int) -> str | None:
    """Why the first that died of runners 1 to `number` did, as far as one could say."""
    if not internal_kv._internal_kv_initialized():
        return None
    said = ((index, take(index)) for index in range(1, number + 1))
    return next((f"env runner {index} died ({why})" for index, why in said if why), None)


def _key(index: int) -> bytes:
    return f"bam-train/{ray.get_runtime_context().get_job_id()}/runner-{index}".encode()


def _own_cause(error: Exception) -> Exception:
    """RLlib raises a bare RuntimeError from what an environment raised."""
    cause = error.__cause__
    return cause if type(error) is RuntimeError and not error.args and isinstance(cause, Exception) else error
