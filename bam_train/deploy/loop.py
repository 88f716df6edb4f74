"""The deployment: a chain of agents that moves a robot, at absolute deadlines; and what ends it.

Robot, journal, pacer and policy are agents of one `TemporalAgent`; agents of one's own join the same chain. What they
read and write is checked when the chain is built, before the robot is connected. However it ends (all episodes done,
Ctrl-C, SIGTERM, a fault) the robot is halted and closed before anything is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym

from bam_envs.core.errors import BamEnvsError, LinkLost, SafetyStop
from bam_envs.core.timing import Pacer
from bam_train.deploy.agents import JournalAgent, PacerAgent, StartupAgent, Watcher
from bam_train.deploy.journal import Journal
from bam_train.deploy.signals import Stopped, StopSwitch, stop_signals
from bam_train.errors import BamTrainError
from bam_train.loop import Agent, Agents, PolicyAgent, RobotAgent, TemporalAgent, Workspace
from bam_train.loop.workspace import Sink

WINDOW = 1000
"""Ticks that the workspace of a deployment keeps at least: 50 s at 20 Hz."""


@dataclass(frozen=True)
class Ending:
    """Why the loop stopped."""

    reason: str
    """``"episodes done"``, ``"interrupted"``, ``"link lost: ..."``, ``"safety stop: ..."`` or ``"fault: ..."``."""
    status: int
    """Exit status of the program: 0, 128 + the signal, 4, 3 or 1."""


class Deployment:
    """A frozen policy and a robot in one loop.

    Memory stays flat however long it runs: the workspace keeps the last `window` ticks at least, and gives older ones
    to `sink` as they leave.

    Args:
        env: The environment, already proved to fit the policy.
        policy: What decides: has ``reset()`` and ``act(observation)``.
        pacer: The deadlines.
        journal: Filled in as it goes.
        agents: More agents, run behind the policy; they say what they read and write.
        window: Ticks that the workspace keeps at least.
        sink: ``sink(first_time, {variable: array (n, 1, ...)})`` gets every tick once, in order, episode by episode.
            It is called between two ticks, so it has to be quick; a failure ends the deployment.

    Raises:
        WiringError: An agent reads what nobody writes; nothing has been connected.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        policy: Any,
        pacer: Pacer,
        journal: Journal,
        *,
        agents: Sequence[Agent] = (),
        window: int = WINDOW,
        sink: Sink | None = None,
    ) -> None:
        self._robot, self._journal = RobotAgent(env), journal
        self._workspace = Workspace(window=window, sink=None if sink is None else _once_broken_silent(sink))
        self._signals = _SignalAgent()
        self._loop = _Loop(
            Agents(
                self._signals,
                self._robot,
                JournalAgent(journal, pacer),
                PacerAgent(pacer),
                PolicyAgent(policy, self._robot.observation_names, single=True),
                StartupAgent(journal.startup),
                *agents,
            )
        )

    def connect(self) -> None:
        """Open the link to the robot, if there is one, without moving it: what is missing shows before the loop."""
        self._robot.connect()

    def run(self, watcher: Watcher, *, seed: int) -> Ending:
        """Run ``journal.wanted`` episodes; episode k gets ``seed + k``. Never raises for what happened on the way.

        Args:
            watcher: Shows it.
            seed: Seed of the first episode.
        """
        with stop_signals() as switch:
            self._loop.switch = self._signals.switch = switch
            try:
                try:
                    switch.arm()
                    self._episodes(watcher, seed)
                finally:  # inside the outer try: a signal that comes before this line is still caught
                    switch.armed = False
                ending = Ending("episodes done", 0)
            except Stopped as stopped:
                ending = Ending("interrupted", 128 + stopped.signal)
            except Exception as error:  # whatever went wrong: the robot has to be halted and the report made
                ending = _ending_of(error)
            except BaseException:
                if not self._loop.closing:
                    self._robot.halt()
                raise
            ending = _unless_it_fails(ending, "closing", self._robot.close)
            return _unless_it_fails(ending, "recording", self._workspace.flush)  # of an episode cut short

    def _episodes(self, watcher: Watcher, seed: int) -> None:
        for k in range(self._journal.wanted):
            self._loop(self._workspace, t=0, stop_variable="env/done", seed=seed + k, watcher=watcher)
            self._robot.halt()  # a sink may take its time, and so may the next reset
            self._workspace.flush()


LINK_LOST, SAFETY_STOP = 4, 3
"""Exit statuses."""


def _ending_of(error: Exception) -> Ending:
    """What the operator has to look for first: the network, the robot, or the program."""
    text = fault_text(error).replace("call resume()", "run it again")  # a program ends here, and is not resumed
    if isinstance(error, LinkLost):
        return Ending(f"link lost: {text}", LINK_LOST)
    if isinstance(error, SafetyStop):
        return Ending(f"safety stop: {text}", SAFETY_STOP)
    return Ending(f"fault: {text}", 1)


def _unless_it_fails(ending: Ending, what: str, end: Callable[[], None]) -> Ending:
    """Call `end`; that it fails is a fault too, unless there was one before."""
    try:
        end()
    except Exception as error:  # somebody else's business, and the report must come out all the same
        if ending.status == 0:
            return replace(ending, reason=f"fault: {what} failed: {fault_text(error)}", status=1)
    return ending


def _once_broken_silent(sink: Sink) -> Sink:
    """The sink, which is not called any more after it has failed."""
    broken = False

    def guarded(first_time: int, piece: dict[str, Any]) -> None:
        nonlocal broken
        if not broken:
            broken = True  # while it runs: whatever leaves it
            sink(first_time, piece)
            broken = False

    return guarded


class _SignalAgent(Agent):
    """Ends the loop for a signal that was lost. Stands before the robot, so that it is sent nothing more."""

    reads = ()
    writes = ()
    switch: StopSwitch | None = None

    def forward(self, **kwargs: Any) -> None:
        """Nothing but after a signal."""
        if self.switch is not None:
            self.switch.raise_again()


class _Loop(TemporalAgent):
    """Once it has begun to close its agents, the robot's first of all, no signal interrupts it."""

    switch: StopSwitch | None = None
    closing: bool = False

    def _close_after(self, error: BaseException) -> None:
        self.closing = True
        if self.switch is not None:
            self.switch.armed = False
        super()._close_after(error)


def fault_text(error: Exception) -> str:
    """One line; with the exception's type unless it is one of ours, whose text says enough."""
    text = " ".join(str(error).split())
    own = isinstance(error, (BamEnvsError, BamTrainError)) and text
    return text if own else f"{type(error).__name__}: {text}".removesuffix(": ")
