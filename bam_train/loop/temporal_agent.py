"""The loop: runs one agent at consecutive times.

Differences from BBRL's `TemporalAgent`: the variables that agents read are checked before the first of them runs; an
exception names the time, and closes every agent's environment and robot; a progress display.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from bam_train.errors import LoopError
from bam_train.loop.agent import Agent, agent_name, is_live
from bam_train.loop.agents import Agents, KWAgentWrapper
from bam_train.loop.workspace.variables import unknown_variable
from bam_train.loop.workspace.workspace import Workspace

if TYPE_CHECKING:
    from rich.progress import Progress


class TemporalAgent(Agent):
    """Runs an agent at times t, t + 1, ....

    Args:
        agent: The agent to run; often an `Agents` whose first member is the environment.
        progress: True for a progress display on standard error, or a ``rich.progress.Progress`` to add a task to.

    Raises:
        LoopError: `agent` is not an agent.
        LoopError: The agent moves a robot, and an inner agent reads a variable that no agent writes.
    """

    def __init__(self, agent: Agent, name: str | None = None, *, progress: bool | Progress = False) -> None:
        super().__init__(name=name)
        if not isinstance(agent, Agent):
            raise LoopError(f"TemporalAgent: expected an agent, found {type(agent).__name__}.")
        if is_live(agent):  # before the robot is connected
            _check(agent, (), None)
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
        """Run the agent from time t on. After an exception every agent is closed; earlier times stay readable.

        Args:
            workspace: The workspace to read and write.
            t: The first time.
            n_steps: The number of times, of which one is always run, as in BBRL; None for no limit.
            stop_variable: Name of a variable (B,): the loop stops after a time at which it is true for the whole batch.
            kwargs: Passed to every agent.

        Raises:
            LoopError: It is running already: loops are not shared by threads.
            LoopError: Neither `n_steps` nor `stop_variable`, or no workspace.
            LoopError: An agent reads a variable that no agent writes, or no agent writes the stop variable.
            LoopError: No agent has written the stop variable at the first time.
        """
        if n_steps is None and stop_variable is None:
            raise LoopError("TemporalAgent: when should it stop? Give n_steps, stop_variable or both.")
        if not (n_steps is None or isinstance(n_steps, (int, float)) or hasattr(n_steps, "__index__")):
            raise LoopError(f"n_steps: expected a whole number, found {n_steps!r}.")
        super().__call__(workspace, t=t, n_steps=n_steps, stop_variable=stop_variable, **kwargs)

    def forward(self, t: int, n_steps: int | None, stop_variable: str | None, **kwargs: Any) -> None:
        """Check the agents, run them, and close them after an exception."""
        workspace = self.workspace
        try:
            _check(self.agent, workspace, stop_variable)
            display: Any = nullcontext(None)
            if self.progress is not False:
                from bam_train.loop.progress import progress_display

                display = progress_display(self.progress, n_steps, t, self.name or "steps")
            with display as advance:
                self._run(workspace, t, n_steps, stop_variable, advance, kwargs)
        except BaseException as error:  # raised even if closing fails
            try:
                self.agent.close()
            except Exception as failure:
                _note(error, f"Closing failed too: {type(failure).__name__}: {failure}")
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
        # A bound method is faster than agent(...).
        calls = [(agent, agent.__call__) for agent in _unfolded(self.agent, (Agents,))]
        end = None if n_steps is None else t + n_steps
        while True:
            for agent, call in calls:
                try:
                    call(workspace, t=t, **kwargs)
                except BaseException as error:  # noqa: PERF203 - costs nothing without an exception
                    _note(error, f"In {agent_name(agent)} of {_describe(self.agent)} at t={t}.")
                    raise
            if advance is not None:
                advance(1)
            if stop_variable is not None:
                if stop_variable not in workspace:
                    raise unknown_variable(stop_variable, workspace.keys(), "stop_variable")
                if all(workspace.get(stop_variable, t).ravel().tolist()):  # quicker for a few
                    return
            t += 1
            if end is not None and t >= end:
                return

    def _inner(self) -> tuple[Agent, ...]:
        return (self.agent,)

    def __getstate__(self) -> dict[str, Any]:
        """Copies do not keep the caller's progress display."""
        return {**super().__getstate__(), "progress": self.progress is True}


def _unfolded(agent: Agent, kinds: tuple[type[Agent], ...]) -> list[Agent]:
    """The agents of the tree in the order in which they run; agents of `kinds` are replaced by their inner agents."""
    cls = type(agent)
    if any(cls.forward is kind.forward and cls.__call__ is kind.__call__ for kind in kinds):
        return [leaf for inner in agent._inner() for leaf in _unfolded(inner, kinds)]
    return [agent]


def _describe(agent: Agent) -> str:
    """The agent's structure, such as ``Agents(RobotAgent, PolicyAgent)``."""
    return f"Agents({', '.join(map(_describe, agent))})" if isinstance(agent, Agents) else agent_name(agent)


def _note(error: BaseException, text: str) -> None:
    if hasattr(error, "add_note"):  # Python 3.11
        error.add_note(text)


def _check(agent: Agent, held: Iterable[str], stop_variable: str | None) -> None:
    """Check, before anything runs, that the stop variable and all variables that agents read are written.

    In a chain with a robot every agent must declare the variables that it reads and writes. In other chains, variables
    in the workspace (`held`) count as written, and nothing is checked if an agent does not declare what it writes.
    """
    chain, before = _unfolded(agent, (Agents, KWAgentWrapper, TemporalAgent)), set(held)
    if is_live(agent):
        for one in chain:
            if one.reads is None or one.writes is None:
                raise LoopError(
                    f"{agent_name(one)} is in a chain with a robot and does not say what it reads and writes; "
                    f'give its class reads = ("name", ...) and writes = ("name", ...).'
                )
    if any(one.writes is None for one in chain):
        return
    everything = before.union(*(one.writes or () for one in chain))
    for one in chain:
        for name in one.reads_previous:
            if name not in everything:
                raise LoopError(f"{agent_name(one)} reads {name!r}, which nobody writes{_close(name, everything)}")
        for name in one.reads or ():
            if name not in before and name in everything:
                raise LoopError(
                    f"{agent_name(one)} reads {name!r}, which only an agent after it writes; put it behind that one."
                )
            if name not in before:
                raise LoopError(f"{agent_name(one)} reads {name!r}, which nobody writes{_close(name, before)}")
        before.update(one.writes or ())
    if stop_variable is not None and stop_variable not in everything:
        raise LoopError(f"stop_variable {stop_variable!r} is written by nobody{_close(stop_variable, everything)}")


def _close(name: str, known: Iterable[str]) -> str:
    from bam_envs.core.wording import closest  # brings Gymnasium

    names = sorted(known)
    match = closest(name, names)
    question = "." if match is None else f", did you mean {match!r}?"
    return f"{question} Written are {', '.join(map(repr, names))}." if names else f"{question} Nothing is written."
