"""What `RemoteAgent` and `AsynchronousAgent` have in common: one process that runs one agent."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, Any

from bam_train.errors import LoopError, RemoteAgentError
from bam_train.loop.agent import Agent, agent_name
from bam_train.loop.tensors.worker import Worker

if TYPE_CHECKING:
    from typing_extensions import Self


class ProcessAgent(Agent):
    """What the agents that run another one in a process have in common.

    The process starts at the first call.

    Args:
        agent: What to run there; its weights move into shared memory.
        name: What `get_by_name` finds.
        verbose: Kept as an attribute.
        start_method: "spawn", "forkserver" or "fork".
    """

    def __init__(
        self, agent: Agent, name: str | None = None, verbose: bool = False, *, start_method: str = "spawn"
    ) -> None:
        super().__init__(name=name, verbose=verbose)
        self.agent = agent
        self.start_method = start_method
        self._seed: int | None = None
        self._worker: Worker | None = None

    def forward(self, **kwargs: Any) -> None:
        """Not used.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError(f"{type(self).__name__} has no forward; call it.")

    def get_by_name(self, n: str) -> list[Agent]:
        """The agents of that name: this one, then those in the agent it runs, whose weights are shared."""
        return super().get_by_name(n) + self.agent.get_by_name(n)

    def seed(self, seed: int) -> Self:
        """Seed the agent, and the process's global generators (torch, NumPy, random); itself is returned.

        Before the start it is kept for the start.

        Raises:
            RemoteAgentError: The agent refuses, for instance because it is seeded already.
        """
        self._seed = seed
        self._tell("seed", seed)
        return self

    def train(self, mode: bool = True) -> Self:
        """Set the mode, here and in the process; `eval` is ``train(False)``."""
        super().train(mode)
        self._tell("train", mode)
        return self

    def is_running(self) -> bool:
        """Whether a call that did not wait is still under way.

        Raises:
            RemoteAgentError: It failed; the process is closed.
        """
        try:
            return self._worker is not None and self._worker.poll()
        except RemoteAgentError:
            self.close()
            raise

    def ask_to_end(self) -> None:
        """Begin to end an idle process, so that several end at the same time; only `close` may follow."""
        if self._worker is not None:
            self._worker.ask_to_end()

    def close(self) -> None:
        """End the process; at any time, as often as one likes. The next call starts a new one."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def _running_worker(self) -> Worker:
        """The process, started if there is none.

        Raises:
            LoopError: It is busy.
        """
        if self._worker is not None and self._worker.closed:
            self._worker = None
        if self._worker is None:
            self._worker = Worker(self.agent, self.start_method, self._seed)
            weakref.finalize(self, self._worker.close)
        elif self._worker.poll():
            raise LoopError(f"{agent_name(self)} is still running; wait until is_running() is False.")
        return self._worker

    def _tell(self, command: str, argument: Any) -> None:
        """Give a command to the process if there is one, and wait for its end unless it is busy."""
        worker = self.__dict__.get("_worker")
        if worker is None or worker.closed:
            return
        busy = worker.poll()
        worker.send(command, argument)
        if not busy:
            worker.wait()

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_worker": None}
