"""A robot that plays recorded states: whatever it is commanded, it measures what was measured then."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, ResetNeeded, RobotFault
from bam_envs.core.robot import Array, EnvIds, Initial, RobotSpec, RobotState, checked_command


class ReplayRobot:
    """One robot whose states were recorded; each `reset` begins the next episode, and the first one after the last.

    Args:
        spec: The spec of the recorded robot.
        episodes: The states of each episode: the first one as `reset` returned it, then one for each step.
        drawn_by: The simulated robot that draws the states, if any; it has ``show(state)``.
    """

    num_robots = 1

    def __init__(self, spec: RobotSpec, episodes: Sequence[Sequence[RobotState]], drawn_by: Any = None) -> None:
        if not episodes or not all(episodes):
            raise InvalidValue("A ReplayRobot needs at least one episode, and each episode at least one state.")
        self.spec, self._episodes, self._drawn_by = spec, episodes, drawn_by
        self._begun, self._step, self._connected = 0, 0, False

    def connect(self) -> None:
        """Accept commands from now on."""
        self._connected = True

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Begin the next episode; returns its first state, whatever `initial` is."""
        self._require_link()
        self._begun, self._step = self._begun + 1, 0
        if self._drawn_by is not None:
            self._drawn_by.connect()
            self._drawn_by.reset(env_ids, initial)  # for what is not in the states, such as obstacles
        return self._now()

    def step(self, command: Array) -> RobotState:
        """Check `command` (1, m), ignore it, and return the next state.

        Raises:
            RobotFault: The episode has no more states.
        """
        self._require_link()
        checked_command(command, (1, len(self.spec.command.labels)))
        if self._step + 1 >= len(self._episode):
            raise RobotFault(f"The recorded episode has {len(self._episode) - 1} steps, and no more. Call reset().")
        self._step += 1
        return self._now()

    def halt(self) -> None:
        """Nothing: it does not move."""

    def close(self) -> None:
        """Take no command until `connect`."""
        self._connected = False
        if self._drawn_by is not None:
            self._drawn_by.close()

    def render(self, mode: str, marks: Any) -> NDArray[np.uint8] | None:
        """Show the state and `marks`, as the simulated robot does."""
        if self._drawn_by is None:
            raise InvalidValue(f"The recorded robot {self.spec.name!r} has no picture; use render_mode=None.")
        image: NDArray[np.uint8] | None = self._drawn_by.render(mode, marks)
        return image

    @property
    def _episode(self) -> Sequence[RobotState]:
        return self._episodes[(self._begun - 1) % len(self._episodes)]

    def _now(self) -> RobotState:
        state = self._episode[self._step]
        if self._drawn_by is not None:
            self._drawn_by.show(state)
        signals = {name: values.copy() for name, values in state.signals.items()}
        return RobotState(signals, state.stamp.copy(), state.command.copy(), dict(state.truth))

    def _require_link(self) -> None:
        if not self._connected:
            raise ResetNeeded("The recorded robot is not connected. Call connect() first.")
