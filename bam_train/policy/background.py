"""A policy with chunks that computes them in a thread beside the steps of a robot, so that no step waits for it."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.close_at_exit import close_at_exit
from bam_envs.core.errors import LinkLost
from bam_train.policy.chunks import Plan

if TYPE_CHECKING:
    from collections.abc import Callable

    from bam_train.policy.frozen_policy import FrozenPolicy

SPARE = 1.5
"""A chunk is asked for so many times its longest duration before it is due."""
NICE = 5
"""How much the thread gives way to the loop, where the system knows threads (Linux)."""


class Background:
    """Takes the place of its policy in a loop with deadlines.

    What waits is a plan of actions, which only `act` hands out, one for each step: after `reset` there is none.

    Args:
        policy: The policy.
        period: Time between two steps [s].
        fade: See `Plan`; None: a change-over fades in `bam_train.policy.chunks.FADE` steps.
        is_held: Whether a guard held the robot in the last step, so that its action was not executed.
        request: Asks the policy for a chunk; a `ChunkRequest`.
    """

    def __init__(
        self,
        policy: FrozenPolicy,
        period: float,
        *,
        fade: NDArray[Any] | None = None,
        is_held: Callable[[], bool] = lambda: False,
        request: Callable[[FrozenPolicy, Plan], ChunkRequest] | None = None,
    ) -> None:
        self.policy, self._period, self._is_held = policy, period, is_held
        self._fade, self._request = np.asarray(np.inf) if fade is None else fade, request or ChunkRequest
        self._plan = policy.plan(self._fade)
        self._asked: ChunkRequest | None = None
        self._requests: list[ChunkRequest] = []
        self._lost: LinkLost | None = None
        self._took: deque[float] = deque(maxlen=8)
        close_at_exit(self)

    def __getattr__(self, name: str) -> Any:
        """Any other attribute is the policy's: its spaces, its detector."""
        if name == "policy" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.policy, name)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the operator should know now: that the server of the policy is lost."""
        reason = str(self._lost).partition(": ")[2].partition(" (")[0].partition(". ")[0]
        return (f"policy server: {reason}; the actions that wait are executed",) if self._lost else ()

    def reset(self) -> None:
        """Drop what waits, and a chunk that is on its way, as an episode starts or ends."""
        self._plan, self._asked, self._lost = self.policy.plan(self._fade), None, None

    def prepare(self, observation: Any) -> None:
        """Compute the first chunk, for the first observation of an episode."""
        self._plan.see(self.policy.checked(observation))
        self._ask()
        self._receive(wait=True)

    def act(self, observation: Any) -> Any:
        """The action of this step; only the first one of a plan that was not prepared waits for its chunk.

        Raises:
            PolicyError: No chunk has an action for this step, or the last one cannot be used.
            LinkLost: The same, as the server of the policy is lost.
        """
        plan = self._plan
        if plan.tick and self._is_held():
            plan.repeat()
        plan.see(self.policy.checked(observation))
        self._receive()
        lead = plan.delay = math.ceil(SPARE * max(self._took, default=0.0) / self._period) + 1
        if self._asked is None and plan.is_due(lead):
            self._ask()
        if not (plan.tick or plan.has_action):
            self._receive(wait=True)
        if self._lost is not None and not plan.has_action:
            raise self._lost
        return plan.take()

    def close(self) -> None:
        """Drop what waits; returns when no thread of it runs, since onnxruntime must not run while Python ends."""
        self.reset()
        for request in self._requests:
            request.wait()

    def _ask(self) -> None:
        self._requests = [one for one in self._requests if not one.ended]
        self._asked = self._request(self.policy, self._plan)
        self._requests.append(self._asked)

    def _receive(self, *, wait: bool = False) -> None:
        """Take the chunk that was asked for, if it has come; one that a lost server owes is asked for again."""
        asked = self._asked
        if asked is None:
            return
        if wait:
            asked.wait()
        if not (wait or asked.ended):
            return
        self._asked = self._lost = None
        try:
            asked.give(self._plan)
        except LinkLost as error:
            if wait or self._plan.chunk.when_lost == "halt":
                raise
            self._lost = error
            return
        self._took.append(asked.took)


class ChunkRequest:
    """The computation of one chunk in a thread, for what a plan has seen."""

    def __init__(self, policy: FrozenPolicy, plan: Plan) -> None:
        self._policy, self._plan, self._seen = policy, plan, plan.seen()
        self._step, self._tick = plan.step, plan.tick
        self._chunk: NDArray[Any] | None = None
        self._error: Exception | None = None
        self.took = 0.0
        """How long it took [s]."""
        self.thread = threading.Thread(target=self._run, name="bam-chunk", daemon=True)
        self.thread.start()

    def _run(self) -> None:
        begun = time.perf_counter()
        with contextlib.suppress(AttributeError, OSError):  # elsewhere a thread has no priority of its own
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + NICE)
        try:
            self._chunk = self._policy.answer({name: value[None] for name, value in self._seen.items()})[0]
        except Exception as error:  # it is the loop that must end
            self._error = error
        self.took = time.perf_counter() - begun

    @property
    def ended(self) -> bool:
        """Whether the chunk has come, or will not come."""
        return not self.thread.is_alive()

    def wait(self) -> None:
        """Wait for the end."""
        self.thread.join()

    def give(self, plan: Plan) -> None:
        """Give the chunk to the plan; raises what the computation did."""
        if self._error is not None:
            raise self._error
        if self._chunk is not None:
            plan.add(self._step, self._chunk, self._tick)
