"""An agent that runs in another process while this one goes on, on a workspace of its own.

Differences from BBRL: a failure there is a `RemoteAgentError` here, from `is_running` or `get_workspace`, where BBRL's
seems to run for ever; weights are in shared memory, so that later calls see what was learnt in between; the agent can
be seeded; `close` can be called at any time, and the process ends with the parent.
"""

from __future__ import annotations

import pickle
from typing import Any

from bam_train.errors import LoopError
from bam_train.loop.agent import Agent, agent_name
from bam_train.loop.tensors.process_agent import ProcessAgent
from bam_train.loop.workspace import Workspace


class AsynchronousAgent(ProcessAgent):
    """Starts an agent in another process, without gradients, and gives its workspace when it has ended.

    ::

        agent(t=0, n_steps=100)
        while agent.is_running():
            ...
        workspace = agent.get_workspace()

    The weights of `agent` are shared with the process. For a run on weights that stay as they are, give it a clone and
    load new weights into that between runs.

    Args:
        agent: What to run there; its weights move into shared memory.
        verbose: Kept as an attribute.
        start_method: "spawn", "forkserver" or "fork".
    """

    def __init__(self, agent: Agent, verbose: bool = False, *, start_method: str = "spawn") -> None:
        super().__init__(agent, verbose=verbose, start_method=start_method)
        self._last: Workspace | None = None
        self._expected = False

    def __call__(self, **kwargs: Any) -> None:  # type: ignore[override]  # it has its own workspace
        """Start the agent on a new workspace with these keywords; does not wait.

        Raises:
            LoopError: The last call has not ended.
            RemoteAgentError: The keywords or the agent cannot be sent to the process, or the last call failed.
        """
        if self.is_running():
            raise LoopError(f"{agent_name(self)} is still running; wait until is_running() is False.")
        self._running_worker().send("run_alone", kwargs)
        self._last, self._expected = None, True

    def is_running(self) -> bool:
        """Whether the last call is still under way.

        Raises:
            RemoteAgentError: It failed.
        """
        if super().is_running():
            return True
        if self._expected and self._worker is not None:
            self._expected = False
            self._last = _workspace(self._worker.result())
        return False

    def get_workspace(self) -> Workspace | None:
        """The workspace of the last call; None while it is under way, and before the first.

        Raises:
            RemoteAgentError: The call failed.
        """
        return None if self.is_running() else self._last

    def close(self) -> None:
        """End the process; at any time, as often as one likes. The last workspace stays."""
        super().close()
        self._expected = False


def _workspace(data: bytes) -> Workspace:
    """A workspace of the variables that the process sent."""
    workspace = Workspace()
    for name, value in pickle.loads(data).items():
        workspace.set_full(name, value)
    return workspace
