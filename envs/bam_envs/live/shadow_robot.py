"""A live robot that somebody else drives: its motion is compared with a policy's commands, which are not sent."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import StaleState
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.timing import Pacer
from bam_envs.live import bringup
from bam_envs.live.rosbridge_robot import RosbridgeRobot
from bam_envs.rosbridge.ros_bus import RosBus
from bam_envs.safety.guard import Limits

Watch = Callable[[NDArray[np.float64], RobotState, RobotState], None]
"""Called at each step with the command (1, m) that was not sent, the state before it, and the one a period later."""
_STALE = 1.0
"""Age of the newest state from which the robot counts as lost [s]."""


class ShadowRobot(RosbridgeRobot):
    """A read-only `RosbridgeRobot`: it advertises no topic, opens no session, and publishes nothing, not even a halt.

    The command in its states is that of a robot at rest, so that tasks continue from the robot, not from the policy.
    """

    needs_clearance = False
    enabling = ()

    def __init__(self, *arguments: Any, limits: Limits, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.limits = limits
        """The limits that its guards would have; the commands are compared with them."""
        self.watch: Watch = lambda command, before, after: None

    def _advertise(self, control: RosBus, halting: RosBus, types: bringup.TopicTypes) -> None:
        """Do nothing: no command is sent."""

    def _needed_proof(self, control: RosBus) -> None:
        """Return None: nothing is sent."""

    def _open_session(self, control: RosBus) -> None:
        """Do nothing: a session is for the program that drives."""

    def enable(self) -> None:
        """Do nothing: whoever drives the robot enables it."""

    def not_ready(self) -> str | None:
        """Return None: readiness is the concern of whoever drives the robot."""
        return None

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """A fresh state; the robot is not moved, and `initial` has no effect."""
        control = self._wait_up()
        if control.epoch != self._epoch or self._cut.is_set():
            self._begin(control)
        self._await(lambda slots: self.age() <= self.profile.max_age)
        self._pacer = Pacer(self.spec.period, now=self._clock)
        return self.measure()

    def step(self, command: Any) -> RobotState:
        """Wait until the period is over; `command` (1, m) is passed to `watch` instead of the robot.

        Raises:
            LinkLost: The link dropped.
            StaleState: The robot has stopped publishing states.
        """
        before = self.measure()
        self._pacer.tick()
        self._cut.wait(max(0.0, self._pacer.slack))
        self._require_link()
        if (age := self.age()) > _STALE:
            raise StaleState(f"{self.url}: the newest state is {age:.3f} s old. Does the robot run?", age, _STALE)
        after = self.measure()
        self.watch(np.asarray(command, dtype=np.float64), before, after)
        return after

    def halt(self) -> None:
        """Do nothing: a read-only client must not stop a robot that somebody else drives."""
