"""Agents that run in other processes: `RemoteAgent`, `NRemoteAgent` and `AsynchronousAgent`.

Differences from BBRL, where the processes of the first two die at their start while the parent waits without end, and
an `AsynchronousAgent` that failed seems to run without end:

- They work, with every start method. The default is "spawn", because torch's threads and CUDA do not survive a fork; in
  a notebook, or with agents that cannot be pickled, give ``start_method="fork"``.
- A failure in a process raises a `LoopError` in the parent, and ends the processes; the next call restarts them.
- Weights are in shared memory: ``load_state_dict`` on an agent of `get_by_name` applies to the process at once.
- `seed` seeds the process's global generators too, before and after the start. By default process k has seed k; the
  generators of a single agent have a seed drawn from torch's.
- `close` is idempotent; processes also end with the agent's last reference and with the parent.
- A process is a daemon, which cannot start processes itself, with one torch thread.
"""

from __future__ import annotations

import copy
import pickle
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bam_train.compat.bbrl.shared_workspace import SharedWorkspace, shared_workspace
from bam_train.compat.bbrl.worker import Worker, close_all, wait_for
from bam_train.errors import LoopError
from bam_train.loop.agent import Agent, agent_name
from bam_train.loop.agents import Agents
from bam_train.loop.workspace.workspace import Workspace

if TYPE_CHECKING:
    from typing_extensions import Self


class _ProcessAgent(Agent):
    """Runs an agent in a process, which starts at the first call, without gradients.

    Args:
        agent: The agent to run; its weights move into shared memory.
        start_method: "spawn", "forkserver" or "fork".
    """

    _worker: Worker | None = None

    def __init__(
        self, agent: Agent, name: str | None = None, verbose: bool = False, *, start_method: str = "spawn"
    ) -> None:
        super().__init__(name=name, verbose=verbose)
        self.agent = agent
        self.start_method = start_method
        self._seed: int | None = None

    def seed(self, seed: int) -> Self:
        """Seed the agent, and the process's global generators (torch, NumPy, random), now or when it starts.

        Raises:
            LoopError: The agent refuses the seed, for example because it has one already.
        """
        self._tell("seed", seed)
        self._seed = seed
        return self

    def train(self, mode: bool = True) -> Self:
        """Set the mode, here and in the process; `eval` is ``train(False)``."""
        super().train(mode)
        self._tell("train", mode)
        return self

    def close(self) -> None:
        """End the process; may be called at any time, and is idempotent. The next call starts a new process."""
        if self._worker is not None:
            self._worker.close()

    def _inner(self) -> tuple[Agent, ...]:
        return (self.agent,)

    def _idle_worker(self) -> Worker:
        """The idle process, which is started if there is none."""
        if self._worker is None or self._worker.closed:
            self._worker = Worker(self.agent, self.start_method, self._seed)
            weakref.finalize(self, self._worker.close)
        elif self._worker.poll():
            raise LoopError(f"{agent_name(self)} is still running; wait until is_running() is False.")
        return self._worker

    def _tell(self, command: str, argument: Any) -> None:
        """Send a command to the process if there is one, and wait for its end."""
        if self._worker is not None and not self._worker.closed:
            worker = self._idle_worker()
            worker.send(command, argument)
            wait_for([worker])

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_worker": None}


class RemoteAgent(_ProcessAgent):
    """Runs an agent in another process, on a shared workspace."""

    def forward(self, **kwargs: Any) -> None:
        """Run the agent with these keywords, and wait for its end.

        Raises:
            LoopError: The workspace is not shared.
            LoopError: The agent failed, or its process ended.
        """
        if not self.workspace.is_shared:
            raise LoopError(
                f"{agent_name(self)} needs a shared workspace; NRemoteAgent.create makes one, or "
                f"bam_train.compat.bbrl.shared_workspace.shared_workspace(workspace)."
            )
        wait_for([self.begin(self.workspace, kwargs)])

    def begin(self, workspace: Workspace, kwargs: dict[str, Any]) -> Worker:
        """Start a run in the process and return its worker; a workspace is sent only once."""
        worker = self._idle_worker()
        worker.send("run", None if workspace is worker.workspace else workspace, kwargs)
        worker.workspace = workspace
        return worker


class NRemoteAgent(Agents):
    """Runs copies of an agent in several processes, each on its own batch columns; see `create`.

    Args:
        agents: One agent for each process.
        batch_dims: The first column of each agent, and one after its last.
    """

    def __init__(self, agents: Sequence[RemoteAgent], batch_dims: Sequence[tuple[int, int]]) -> None:
        super().__init__(*agents)
        self.batch_dims = list(batch_dims)
        self._split: tuple[Workspace | None, list[SharedWorkspace]] = (None, [])

    @staticmethod
    def create(
        agent: Agent,
        num_processes: int = 0,
        time_size: int | None = None,
        *,
        start_method: str = "spawn",
        **extra_kwargs: Any,
    ) -> tuple[Agent, SharedWorkspace]:
        """Make an agent of `num_processes` processes, and the shared workspace to call it with.

        A copy of `agent` runs once in this process, with seed 0 and `extra_kwargs`, to find the variables that it
        writes. Process k writes the batch columns k * B to (k + 1) * B - 1, where B is the batch size of `agent`, and
        has seed k until ``seed(s)`` sets s + k. Seed the returned agent, not `agent`.

        Args:
            agent: The agent to run; it is copied.
            num_processes: Number of processes; 0 returns a copy of `agent` for this process, for debugging.
            time_size: Number of times of the workspace; None for that of the first run.
            start_method: "spawn", "forkserver" or "fork".
            extra_kwargs: Keywords of the first run, such as ``t=0, n_steps=10``.

        Raises:
            LoopError: The agent writes no variable, or variables of different batch sizes; or `num_processes` < 0.
        """
        if num_processes < 0:
            raise LoopError(f"num_processes: expected at least 0, found {num_processes}.")
        workspace, trial = Workspace(), copy.deepcopy(agent)
        try:
            trial.seed(0)
        except LoopError as error:
            raise LoopError(
                f"NRemoteAgent.create: give it an agent without a seed, and seed what it returns. {error}"
            ) from error
        try:
            trial(workspace, **extra_kwargs)
        finally:
            trial.close()
        size = workspace.batch_size() or 0
        shared = shared_workspace(workspace, max(1, num_processes), time_size)
        if num_processes == 0:
            return copy.deepcopy(agent), shared
        remotes = [RemoteAgent(copy.deepcopy(agent), start_method=start_method) for _ in range(num_processes)]
        columns = [(k * size, (k + 1) * size) for k in range(num_processes)]
        return NRemoteAgent(remotes, columns).seed(0), shared

    def forward(self, **kwargs: Any) -> None:
        """Run all copies in parallel, each on its columns of the workspace, and wait for their end.

        Raises:
            LoopError: The workspace is not shared, or has another batch size than all copies together.
            LoopError: A copy failed, or its process ended; all are closed.
        """
        parts = self._columns()
        try:
            wait_for([agent.begin(part, kwargs) for agent, part in zip(self, parts, strict=True)])
        except BaseException:
            self.close()
            raise

    def seed(self, seed: int, inc: int = 1) -> Self:
        """Seed copy k with seed + k * inc; returns the agent."""
        for k, agent in enumerate(self):
            agent.seed(seed + k * inc)
        return self

    def close(self) -> None:
        """End all processes; may be called at any time, and is idempotent. The next call starts new processes."""
        close_all([agent._worker for agent in self if agent._worker is not None])

    def _columns(self) -> list[SharedWorkspace]:
        """Each copy's part of the workspace; cached for the last workspace."""
        workspace = self.workspace
        if not isinstance(workspace, SharedWorkspace):
            raise LoopError(f"{agent_name(self)} needs the shared workspace that NRemoteAgent.create made for it.")
        if self._split[0] is not workspace:
            width = self.batch_dims[-1][1]
            if workspace.batch_size() != width:
                raise LoopError(f"Expected a shared workspace of {width} columns, found {workspace.batch_size()}.")
            self._split = (workspace, [workspace.columns(*columns) for columns in self.batch_dims])
        return self._split[1]

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_split": (None, [])}


class AsynchronousAgent(_ProcessAgent):
    """Starts an agent in another process, and returns its workspace after the end.

    ::

        agent(t=0, n_steps=100)
        while agent.is_running():
            ...
        workspace = agent.get_workspace()
    """

    def __init__(self, agent: Agent, verbose: bool = False, *, start_method: str = "spawn") -> None:
        super().__init__(agent, verbose=verbose, start_method=start_method)
        self._last: Workspace | None = None

    def __call__(self, **kwargs: Any) -> None:  # type: ignore[override]  # it has its own workspace
        """Start the agent on a new workspace with these keywords, without waiting; raises LoopError while it runs."""
        worker = self._idle_worker()
        worker.result = self._last = None
        worker.send("run", Workspace(), kwargs)

    def is_running(self) -> bool:
        """Whether the last call is still running; raises its failure, after which the process is closed."""
        if self._worker is None or self._worker.poll():
            return self._worker is not None
        if self._worker.result is not None:
            self._last, self._worker.result = pickle.loads(self._worker.result), None
        return False

    def get_workspace(self) -> Workspace | None:
        """The workspace of the last call; None while it is running, and before the first call."""
        return None if self.is_running() else self._last
