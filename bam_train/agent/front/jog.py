"""Jogging: from a person's twist of the tool or the base to a command of the robot, one period at a time.

A twist is good for `JOG_LIFETIME` on the clock of this computer. Then it ends by itself, whatever became of the page,
the browser or the network that sent it.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.serial_chain import Arm
from bam_envs.core.errors import InvalidValue
from bam_envs.core.kinematics import UR5E_GRIPPER, UR_JOINTS
from bam_envs.core.robot import RobotSpec, RobotState
from bam_envs.safety.guard import columns_in, is_base, measured_places

Array = NDArray[np.float64]
JOG_LIFETIME = 0.2
"""Time for which a twist is valid [s]."""
SPEED, TURN_SPEED = 0.25, 0.5
"""Fastest motion [m/s] and turn [rad/s] of the tool or the base."""
JOINT_SPEED = 0.5
"""Fastest joint of an arm [rad/s]; near a singularity the tool slows down instead."""
LEASH = 0.03
"""Farthest that the commanded tool is ahead of the measured one [m], as in `bam_envs.tasks.tool_control`."""
_SAG = 0.002
"""A motion begins at the last command if the arm is as near to it as this [m], else where the arm is: it was halted."""
_SINGULAR, _DAMPING = 0.1, 0.1
"""Least singular value of the Jacobian without damping, and the damping at 0 (m and rad weigh the same)."""
_DRIFT = 1e-3
"""Two clocks drift apart by less than this share of the time."""


@dataclass(frozen=True)
class _Twist:
    seq: int
    at: float  # when it came [s, monotonic]
    twist: tuple[float, ...]  # vx, vy, vz [m/s] and wz [rad/s]
    grip: int  # 1 closes the gripper, -1 opens it, 0 leaves it


class Jogger:
    """Turns the newest twist into commands.

    Args:
        spec: The robot: a base, or an arm that is commanded by its joints.
        period: Time between two commands [s].
        geometry: Kinematics of the arm; None: those of a UR5e with a gripper.
        clock: Monotonic clock [s].

    Raises:
        InvalidValue: The kinematics of the arm are not known.
    """

    def __init__(
        self,
        spec: RobotSpec,
        period: float,
        *,
        geometry: Arm | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._spec, self._period, self._clock = spec, period, clock
        self._geometry, self._joints = geometry or UR5E_GRIPPER, columns_in(spec.command, "rad")
        if (
            geometry is None
            and not is_base(spec)
            and tuple(spec.command.labels[at] for at in self._joints) != UR_JOINTS
        ):
            raise InvalidValue(f"{spec.name} cannot be jogged: its kinematics are not known. Drive it by a program.")
        self._measured = measured_places(spec, spec.command.units)
        self.release()

    def release(self) -> None:
        """Forget the twist, the motion and the sequence: another person, or another connection, drives from now on."""
        self._newest, self._delay = _Twist(-1, -math.inf, (0.0,) * 4, 0), math.inf
        self.sent: Array | None = None
        """Command of the tick before, from which a motion goes on (m,); None if nothing was sent."""

    def put(self, seq: int, twist: Sequence[float], gripper: int = 0, sent: float | None = None) -> bool:
        """Take a twist; False if it came late or out of order, and has no effect.

        Args:
            seq: Its number, which grows.
            twist: vx, vy, vz [m/s] and wz [rad/s] in ``base_link``; of a base vx, vy if it drives sideways, and wz.
                Shape: (4,), finite.
            gripper: 1 closes the gripper, -1 opens it, 0 leaves it.
            sent: The sender's time [s]: a twist that was on its way for `JOG_LIFETIME` longer than the quickest one
                counts as late.
        """
        now = self._clock()
        if seq <= self._newest.seq or (sent is not None and self._is_late(now - sent, now)):
            return False
        self._newest = _Twist(seq, now, _limited(twist), gripper)
        return True

    def _is_late(self, delay: float, now: float) -> bool:
        """Whether a twist took `JOG_LIFETIME` longer than the quickest one; `delay` [s] is between two clocks."""
        drift = _DRIFT * (now - self._newest.at)  # infinite for the first one
        self._delay = min(delay, self._delay + drift)
        return delay - self._delay > JOG_LIFETIME

    def command(self, state: RobotState) -> Array | None:
        """The command of the next period (1, m), or None: nothing is to be sent, as there is no fresh twist.

        `state` has n = 1; its ``command`` is the last one that the robot was sent, from where the gripper goes on.
        """
        newest = self._newest
        if self._clock() - newest.at > JOG_LIFETIME:
            self.sent = None
            return None
        if self.sent is None and not (any(newest.twist) or newest.grip):  # nothing moves, nothing is to move
            return None
        self.sent = command = self._drive() if is_base(self._spec) else self._reach(state)
        return np.array([command])

    def _drive(self) -> Array:
        """Speeds of a base (m,)."""
        forwards, left, _, turn = self._newest.twist
        driven = iter((forwards, left))
        return self._inside(np.array([next(driven) if unit == "m/s" else turn for unit in self._spec.command.units]))

    def _reach(self, state: RobotState) -> Array:
        """Joints and gripper of an arm, one step on (m,): from the last command, or from where the arm is."""
        goal, joints = (state.command[0] if self.sent is None else self.sent).copy(), self._joints
        here = goal.copy()
        for place, signal, column in self._measured:
            here[place] = state.signals[signal][0, column]
        if self._gap(goal, here) > (_SAG if self.sent is None else 2 * LEASH):  # it was halted, or is held
            goal[joints] = here[joints]
        ahead = goal.copy()
        ahead[joints] += self._step(goal[joints])
        if (gap := self._gap(ahead, here)) <= LEASH or gap <= self._gap(goal, here):
            goal = ahead
        if self._newest.grip:
            for at in columns_in(self._spec.command, "m"):
                goal[at] = self._spec.command.low[at] if self._newest.grip > 0 else self._spec.command.high[at]
        return self._inside(goal)

    def _gap(self, one: Array, other: Array) -> float:
        """Distance of the tool between two commands (m,) [m]."""
        tool = self._geometry.tool_point
        return math.dist(tool(one[self._joints].tolist()), tool(other[self._joints].tolist()))

    def _step(self, joints: Array) -> Array:
        """Turn of the joints in one period, by damped least squares. Shape: (k,) [rad]."""
        vx, vy, vz, wz = self._newest.twist
        jacobian = self._geometry.tool_jacobian(joints.tolist())
        left, values, right = np.linalg.svd(jacobian, full_matrices=False)
        damping = _DAMPING * max(0.0, 1.0 - (values[-1] / _SINGULAR) ** 2) ** 0.5
        speeds = right.T @ (values / (values**2 + damping**2) * (left.T @ [vx, vy, vz, 0.0, 0.0, wz]))
        speeds *= min(1.0, JOINT_SPEED / max(float(np.abs(speeds).max()), 1e-9))
        step: Array = speeds * self._period
        return step

    def _inside(self, command: Array) -> Array:
        """`command` (m,) within the data sheet; the guards have their own margins."""
        inside: Array = np.clip(command, self._spec.command.low, self._spec.command.high)
        return inside


def _limited(twist: Sequence[float]) -> tuple[float, ...]:
    """The twist, as fast as a person may jog, in its own direction."""
    *way, turn = twist
    share = min(1.0, SPEED / max(math.hypot(*way), 1e-9))
    return *(share * speed for speed in way), max(-TURN_SPEED, min(TURN_SPEED, turn))
