"""The robot of a live agent as its front process has it: states from the robot itself, commands to the resident."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import BamEnvsError, RobotFault, SafetyStop
from bam_envs.core.robot import RobotState
from bam_envs.live.shadow_robot import ShadowRobot
from bam_train.agent.agent_messages import Drive, Halt, Message

Array = NDArray[np.float64]
_PARTS = 5  # looks at the state in a period
_RECONNECT_PERIOD = 1.0  # time between two attempts to reach the robot [s]


class RemoteRobot:
    """What a `RobotService` serves: the methods of a `ServedRobot`, whose motion happens in another process.

    Args:
        shadow: The robot's states.
        send: Sends a message to the resident.
        driver: Returns the owner of the lease, or None.
        ask: Asks the resident something and waits: ``ask(op, arguments)``; raises what it refuses.
        command_timeout: Time after which the robot rests without a command [s].
        connected: Called when the robot has described itself.
    """

    realtime = True
    at_once = True

    def __init__(
        self,
        shadow: ShadowRobot,
        send: Callable[[Message], None],
        driver: Callable[[], str | None],
        ask: Callable[[str, dict[str, Any]], dict[str, Any]],
        command_timeout: float,
        connected: Callable[[], None],
    ) -> None:
        self.spec, self.command_timeout = shadow.spec, command_timeout
        self.tick_period = shadow.spec.period / _PARTS
        self.state: RobotState | None = None
        """The newest state; None while the robot sends none."""
        self.why_not = "the agent waits for the robot"
        """Why nobody can drive now; empty if somebody can."""
        self._shadow, self._send, self._driver, self._ask = shadow, send, driver, ask
        self._connected = connected
        self._target = self._nothing = np.full((1, len(shadow.spec.command.labels)), math.nan)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._stay_connected, name="bam-states", daemon=True)

    @property
    def fault(self) -> RobotFault | None:
        """Why commands are refused, or None."""
        return (SafetyStop.told(self.why_not) or RobotFault(self.why_not)) if self.why_not else None

    def start(self) -> None:
        """Connect to the robot, now or when it is there, and again after each loss."""
        self._thread.start()

    def close(self) -> None:
        """Drop the link for the states."""
        self._closed.set()
        self._thread.join()
        self._shadow.close()

    def _stay_connected(self) -> None:
        connected = False
        while True:
            try:
                if not connected:
                    self._shadow.connect()
                    connected = True
                    self._connected()
                elif self._shadow.age() > _RECONNECT_PERIOD:
                    self._shadow.reset(np.array([0]), None)  # type: ignore[arg-type]
            except BamEnvsError:  # the status says what the agent waits for
                pass
            if self._closed.wait(_RECONNECT_PERIOD):
                return

    def tick(self) -> None:
        """Take the newest state, or none if it is too old."""
        try:
            fresh = self._shadow.age() <= self._shadow.profile.max_age
            self.state = self._shadow.measure() if fresh else None
        except BamEnvsError:
            self.state = None

    def target(self) -> Array:
        """The command that the robot executes, or that of a robot at rest. Shape: (1, m)."""
        command = self._target
        if self.state is not None:
            command = np.where(np.isnan(command), self.state.command, command)
        high = np.array(self.spec.command.high)
        result: Array = np.where(np.isnan(command), high, command)  # a gripper that is not measured is taken as open
        return result

    def follow(self, command: Array, *, at_once: bool = False, count: int = 1) -> None:
        """Let the resident send `command` (1, m) through the guards; for `count` see `ServedRobot.follow`."""
        driver = self._driver()
        if driver is not None:
            self._target = command
            self._send(Drive(command[0].tolist(), driver))

    def halt(self) -> None:
        """Halt the robot; whoever drives may go on from where it stands."""
        self._target = self._nothing
        self._send(Halt("a client"))

    def place_object(self, pose: Array | None, seeds: NDArray[np.int64]) -> None:
        """Set the scene of a simulated robot; see `ServedRobot.place_object`."""
        self._ask("scene", {"pose": None if pose is None else pose.tolist(), "seed": int(seeds[0])})
