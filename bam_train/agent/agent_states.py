"""The states of a live agent, and the one table of what leads from one to another."""

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType


class State(Enum):
    """What a live agent does; the value is its name for people."""

    WAITING = "waiting for the robot"
    """There is no link to the robot, or it was not checked yet; the agent tries again every second."""
    PAUSED = "paused"
    """Nothing is sent, and the robot rests."""
    RUNNING = "running"
    """The champion drives, episode after episode."""
    TRIAL = "trial"
    """A candidate drives; or, on a real robot, the policy drives at trial speed."""
    TAKEN_OVER = "taken over"
    """A person or their program drives; without a fresh command the robot rests."""
    STOPPED = "stopped by a guard"
    """A guard halted the robot, which rests until a person resumes or pauses the agent."""

    @property
    def drives(self) -> bool:
        """Whether the policy drives the robot."""
        return self in (State.RUNNING, State.TRIAL)


TRANSITIONS: Mapping[State, frozenset[State]] = MappingProxyType(
    {
        # Once the robot is there and its contract was checked, the agent goes on with what the cut ended.
        State.WAITING: frozenset({State.PAUSED, State.RUNNING, State.TRIAL, State.STOPPED}),
        State.PAUSED: frozenset({State.RUNNING, State.TRIAL, State.TAKEN_OVER, State.WAITING}),
        State.RUNNING: frozenset({State.PAUSED, State.TRIAL, State.TAKEN_OVER, State.STOPPED, State.WAITING}),
        State.TRIAL: frozenset({State.PAUSED, State.RUNNING, State.TAKEN_OVER, State.STOPPED, State.WAITING}),
        State.TAKEN_OVER: frozenset({State.PAUSED, State.RUNNING, State.TRIAL, State.STOPPED, State.WAITING}),
        # A person looks at the robot first, and resumes or pauses the agent afterwards.
        State.STOPPED: frozenset({State.PAUSED, State.RUNNING, State.TRIAL, State.WAITING}),
    }
)
"""The states that may follow each state."""
