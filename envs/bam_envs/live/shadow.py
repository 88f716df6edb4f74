"""A live robot that somebody else drives: what a policy would do is compared with that, and nothing is sent."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import StaleState
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.timing import Pacer
from bam_envs.live import bringup
from bam_envs.live.rosbridge_robot import RosbridgeRobot
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.safety.guard import Limits

Watch = Callable[[NDArray[np.float64], RobotState, RobotState], None]
"""Called at each step with the command (1, m) that was not sent, the state before it, and the one a period later."""
_STALE = 1.0
"""Age of a state at which the robot is taken as gone [s]."""


class ShadowRobot(RosbridgeRobot):
    """The states of a `RosbridgeRobot`. It advertises nothing, opens no session, and publishes nothing, halts included.

    A command in its states is that of a robot at rest where it is: tasks count from the robot, not from the policy.
    """

    needs_clearance = False

    def __init__(self, *arguments: Any, limits: Limits, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.limits = limits
        """Those that its guards would have, if it was commanded."""
        self.watch: Watch = lambda command, before, after: None

    def _advertise(self, control: RosbridgeLink, halting: RosbridgeLink, types: bringup.TopicTypes) -> None:
        """Nothing: it sends no commands."""

    def _open_session(self, control: RosbridgeLink) -> None:
        """Nothing: it does not drive."""

    def not_ready(self) -> str | None:
        """None: whoever drives it looks after that."""
        return None

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """A fresh state; the robot goes on with what it does, and `initial` has no effect."""
        control = self._wait_up()
        if control.epoch != self._epoch or self._cut.is_set():
            self._begin(control)
        self._await(lambda slots: self.age() <= self.profile.max_age)
        self._pacer = Pacer(self.spec.period, now=self._clock)
        return self.measure()

    def step(self, command: Any) -> RobotState:
        """Wait until one period is over; `command` (1, m) goes to `watch`, and not to the robot.

        Raises:
            LinkLost: The link dropped.
            StaleState: The robot publishes no more.
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
        """Nothing: a client that only reads must not stop the robot of another one."""
