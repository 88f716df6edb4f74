"""The loop: one agent, run at one time after the other.

Differences from BBRL's `TemporalAgent`: what agents read is checked before the first of them runs; an exception says at
which time and closes every agent's environment and robot; a progress display.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from bam_train.errors import LoopError, UnknownVariable, WiringError
from bam_train.loop.agent import Agent, agent_name, in_use
from bam_train.loop.agents import describe, is_live, members
from bam_train.loop.wiring import check_built, check_called
from bam_train.loop.workspace import Workspace

if TYPE_CHECKING:
    from rich.progress import Progress


class TemporalAgent(Agent):
    """Runs an agent at times t, t + 1, ....

    Args:
        agent: What to run; often an `Agents` whose first member is the environment.
        name: What `get_by_name` finds.
        progress: True for a progress display on standard error, or a ``rich.progress.Progress`` to add a task to.

    Raises:
        LoopError: `agent` is no agent.
        WiringError: The agent moves a robot, and something in it reads what nobody writes.
    """

    def __init__(self, agent: Agent, name: str | None = None, *, progress: bool | Progress = False) -> None:
        super().__init__(name=name)
        if not isinstance(agent, Agent):
            raise LoopError(f"TemporalAgent: expected an agent, found {type(agent).__name__}.")
        check_built(agent)
        self.agent = agent
        self.progress = progress

    def __call__(
        self,
        workspace: Workspace,
        t: int = 0,
        n_steps: int | None = None,
        stop_variable: str | None = None,
        **kwargs: Any,
    ) -> None:
        """Run the agent from time t on.

        When an exception leaves it, every agent's `close` is called; earlier times stay readable.

        Args:
            workspace: What it reads and writes.
            t: The first time.
            n_steps: How many times; one at least, as in BBRL. None for until the stop variable says.
            stop_variable: Stop after a time at which it is true for the whole batch.
            kwargs: Given to every agent.

        Raises:
            AgentInUse: It is running already: loops are not shared by threads.
            LoopError: Neither `n_steps` nor `stop_variable`, or no workspace.
            WiringError: An agent reads what nobody writes, or nobody writes the stop variable.
            UnknownVariable: Nobody has written the stop variable at the first time.
        """
        if n_steps is None and stop_variable is None:
            raise LoopError("TemporalAgent: when should it stop? Give n_steps, stop_variable or both.")
        if workspace is None:
            raise LoopError("TemporalAgent needs a workspace, found None.")
        _require_steps(n_steps)
        own, key = self.__dict__, object()
        begun = False
        try:
            if own.setdefault("_call", key) is not key:
                raise in_use(self)
            self._check(workspace, stop_variable)
            begun = True
            with self._advance(n_steps, t) as advance:
                self._run(workspace, t, n_steps, stop_variable, advance, kwargs)
        except BaseException as error:
            if begun:
                self._close_after(error)
            raise
        finally:
            if "_call" in own and own["_call"] is key:
                del own["_call"]

    def _check(self, workspace: Workspace, stop_variable: str | None) -> None:
        """Check who reads what; a robot that is waiting for the next call is halted when something is wrong."""
        try:
            check_called(self.agent, workspace.keys(), stop_variable)
        except WiringError:
            if is_live(self.agent):
                self.agent.close()
            raise

    def _run(
        self,
        workspace: Workspace,
        t: int,
        n_steps: int | None,
        stop_variable: str | None,
        advance: Callable[[int], None] | None,
        kwargs: dict[str, Any],
    ) -> None:
        """The loop itself."""
        # Of each member of an `Agents`: its dictionary, unless it is called in a way of its own, and its forward.
        plain = Agent.__call__
        calls = [
            (one, one.__dict__ if type(one).__call__ is plain else None, one.forward) for one in members(self.agent)
        ]
        key = object()
        end = None if n_steps is None else t + n_steps
        while True:
            try:
                for agent, own, forward in calls:
                    if own is None:
                        agent(workspace, t=t, **kwargs)
                        continue
                    # What Agent.__call__ does, without its frame and a second copy of the keywords: 0.25 µs less each.
                    try:
                        if own.setdefault("_call", key) is not key:
                            raise in_use(agent)
                        own["workspace"] = workspace
                        forward(t=t, **kwargs)
                    finally:
                        if "_call" in own and own["_call"] is key:
                            own["workspace"] = None
                            del own["_call"]
            except BaseException as error:
                _note(error, f"In {agent_name(agent)} of {describe(self.agent)} at t={t}.")
                raise
            if advance is not None:
                advance(1)
            if stop_variable is not None and _is_reached(workspace, stop_variable, t):
                return
            t += 1
            if end is not None and t >= end:
                return

    def _advance(self, n_steps: int | None, t: int) -> Any:
        if self.progress is False:
            return nullcontext(None)
        from bam_train.loop.progress import progress_display

        return progress_display(self.progress, n_steps, t, self.name or "steps")

    def _close_after(self, error: BaseException) -> None:
        """Close all agents."""
        try:
            self.agent.close()
        except Exception as failure:  # the first error is the one to be seen
            _note(error, f"Closing failed too: {type(failure).__name__}: {failure}")

    def _inner(self) -> tuple[Agent, ...]:
        return (self.agent,)

    def _parts(self) -> tuple[Agent, ...] | None:
        return self._inner() if type(self).__call__ is TemporalAgent.__call__ else None

    def __getstate__(self) -> dict[str, Any]:
        """A display of the caller's stays with the original."""
        return {**super().__getstate__(), "progress": self.progress is True}

    def forward(self, **kwargs: Any) -> None:
        """Not used.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError("TemporalAgent has no forward; call it with a workspace.")

    def close(self) -> None:
        """Close the agent."""
        self.agent.close()

    def seed(self, seed: int) -> Any:
        """Seed the agent."""
        return self.agent.seed(seed)

    def get_by_name(self, n: str) -> list[Agent]:
        """The agents of that name in the tree: members first, then the container."""
        return self.agent.get_by_name(n) + super().get_by_name(n)


def _require_steps(n_steps: Any) -> None:
    """Refuse what is no number.

    Raises:
        LoopError: It is none.
    """
    if not (n_steps is None or isinstance(n_steps, (int, float)) or hasattr(n_steps, "__index__")):
        raise LoopError(f"n_steps: expected a whole number, found {n_steps!r}.")


def _is_reached(workspace: Workspace, stop_variable: str, t: int) -> bool:
    """Whether the stop variable is true for the whole batch."""
    try:
        return bool(workspace.get(stop_variable, t).all())
    except UnknownVariable:
        raise UnknownVariable(stop_variable, workspace.keys(), "stop_variable") from None


def _note(error: BaseException, text: str) -> None:
    if hasattr(error, "add_note"):  # Python 3.11
        error.add_note(text)
