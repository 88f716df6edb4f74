"""What the tasks of UR arms share: from joint targets to commands as robo-gym's trajectory controller moves an arm.

There a target c is the one point of a trajectory that takes T = max(max_i |c_i - q_i| / (s vmax_i), 0.5 s), and the
next one takes its place after 1 / rate. So in one period the joints go (c - q) / (rate T): the fastest at s vmax at
most, all of them in proportion, and slower and slower within half a second of the target. What q is here: where the
controller has got to, the last command that was sent; a live arm follows it a little later. So simulated and live
arms get the same set points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import RobotState
from bam_envs.core.task import Array, Flags, Floats, Label
from bam_envs.robots.ur import JOINTS, UrModel

SHORTEST = 0.5
"""Shortest time that a trajectory takes [s]."""
LEASH = 0.2
"""An arm that is measured farther than this from what it was told last [rad] was halted or held: it begins there."""
FIX_OPTIONS = {
    "fix_base": False,
    "fix_shoulder": False,
    "fix_elbow": False,
    "fix_wrist_1": False,
    "fix_wrist_2": False,
    "fix_wrist_3": True,
}
"""Options that take joints out of the action, in the order of the joints, with their defaults."""
WIRE_JOINTS = tuple(name.removeprefix("fix_") for name in FIX_OPTIONS)
"""robo-gym's names of the joints."""


class UrControl:
    """Actions and commands of n arms.

    Args:
        model: Which arm.
        num_rows: How many.
        rate: Commands a second [Hz].
        velocity_scale: Share of the fastest speed that joints go at.
        fixed: Which joints are not in the action; six of them.

    Raises:
        InvalidValue: All joints are fixed, or there are not six.
    """

    def __init__(
        self, model: UrModel, num_rows: int, rate: float, velocity_scale: float, fixed: Sequence[bool] = (False,) * 6
    ) -> None:
        if len(fixed) != 6 or all(fixed):
            raise InvalidValue(
                "At least one of the six joints must be free to move: set one of the fix_ options False."
            )
        self.model, self.num_rows = model, num_rows
        self.free = np.flatnonzero(~np.array(fixed, dtype=bool))
        """Places of the joints that are in the action."""
        self.fixed = np.flatnonzero(np.array(fixed, dtype=bool))
        """Places of those that are not."""
        self._rate, self._speed = rate, velocity_scale * model.max_velocity
        self._low, self._high = model.joint_limits

    def labels(self, meaning: str, unit: str, scale: str) -> tuple[Label, ...]:
        """One label for each free joint."""
        return tuple(Label(JOINTS[joint], meaning, unit, scale) for joint in self.free)

    def full(self, action: Floats, held: Array | float = 0.0) -> Array:
        """The action of all joints, cut to [-1, 1].

        Args:
            action: Of the free joints. Shape: (n, a).
            held: Of the fixed ones, in the action's units. Shape: (n, 6) or a number.

        Returns:
            Shape: (n, 6).
        """
        full = np.empty((self.num_rows, 6))
        full[:] = held
        full[:, self.free] = np.clip(action, -1.0, 1.0)
        return full

    def command(self, target: Array, state: RobotState) -> Array:
        """The set points one period on the way to `target`.

        Args:
            target: Joint positions [rad]. Shape: (n, 6).
            state: What is measured now, and what was sent last.

        Returns:
            Joint positions [rad]. Shape: (n, 6).
        """
        measured, sent = state.signals["joint_position"], state.command
        joints = np.where(np.abs(sent - measured).max(axis=1, keepdims=True) <= LEASH, sent, measured)
        way = target - joints
        duration = np.maximum((np.abs(way) / self._speed).max(axis=1), SHORTEST)
        step = way * ((1.0 / self._rate) / duration)[:, None]
        command: Array = np.clip(joints + step, self._low, self._high)
        return command


def collisions(state: RobotState) -> Flags:
    """Which arms have touched something; none where nobody knows, as of a live robot. Shape: (n,)."""
    told: Any = state.truth.get("collision")
    touched: Flags = np.zeros(len(state.stamp), dtype=bool) if told is None else told
    return touched


def normalised(model: UrModel, joints: Array) -> Array:
    """Joint positions [rad] as shares of their limits, in [-1, 1]. Shape: (n, 6)."""
    shares: Array = np.clip(joints / model.joint_limits[1], -1.0, 1.0)  # limits are the same both ways
    return shares


def spherical(vector: Array) -> Array:
    """Length, angle from z in [0, pi], and angle from x about z in [-pi, pi]. Shape: (n, 3) -> (n, 3)."""
    x, y, z = vector[:, 0], vector[:, 1], vector[:, 2]
    length = np.sqrt(x * x + y * y + z * z)
    cosine = np.divide(z, length, out=np.ones_like(z), where=length > 0)
    return np.stack([length, np.arccos(np.clip(cosine, -1.0, 1.0)), np.arctan2(y, x)], axis=1)


def in_frame(point: Array, position: Array, rotation: Array) -> Array:
    """`point` as a frame at `position` with the axes `rotation` sees it. Shapes: (n, 3), (n, 3), (n, 3, 3)."""
    offset = (point - position)[:, :, None]
    seen: Array = rotation[:, 0] * offset[:, 0] + rotation[:, 1] * offset[:, 1] + rotation[:, 2] * offset[:, 2]
    return seen  # written out: the sum of a row does not depend on how many rows there are


def joint_option(options: Mapping[str, Any], name: str, default: Sequence[float], model: UrModel) -> Array:
    """Joint positions [rad] that a reset option gives, else `default`. Shape: (6,).

    Raises:
        InvalidValue: They are not six finite numbers inside the joint limits.
    """
    joints = number_option(options, name, default, 6)
    low, high = model.joint_limits
    for label, value, least, most in zip(JOINTS, joints, low, high, strict=True):
        if not least <= value <= most:
            raise InvalidValue(
                f"The reset option {name} has {label} at {value:g} rad, outside {least:.4g} to {most:.4g} rad."
            )
    return joints


def number_option(
    options: Mapping[str, Any], name: str, default: Sequence[float], size: int, kind: str = "reset option"
) -> Array:
    """The numbers that an option of `kind` gives, else `default`. Shape: (size,).

    Raises:
        InvalidValue: They are not `size` finite numbers.
    """
    given = options.get(name)
    if given is None:
        return np.array(default, dtype=np.float64)
    try:
        numbers = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if numbers.shape != (size,) or not np.isfinite(numbers).all():
        raise InvalidValue(f"The {kind} {name} must be {size} finite numbers, not {given!r}.")
    return numbers


def flag_option(options: Mapping[str, Any], name: str) -> bool:
    """Whether a reset option is given and True.

    Raises:
        InvalidValue: It is neither True nor False.
    """
    given = options.get(name)
    if given is None or isinstance(given, (bool, np.bool_)):
        return bool(given)
    raise InvalidValue(f"The reset option {name} must be True or False, not {given!r}.")
