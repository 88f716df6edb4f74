"""The guards that keep an arm out of forbidden regions: outside its workspace box, its own links, and the table.

Each computes where the arm would come to rest if it braked after the command, and shortens the step until that pose is
outside the region, if necessary by braking harder than the limit on acceleration. An arm that is inside such a region
already may stay or leave, and must not go farther in.
"""

import math
from collections.abc import Sequence
from operator import mul, sub

from bam_envs.arms.serial_chain import arm_of
from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import RobotSpec
from bam_envs.safety.arm_tubes import Tubes, tool_levers
from bam_envs.safety.guard import Guard, Limits, Numbers, Tick, ToolPosition, columns_in, picker, tool_point_of

_HALVINGS = 6
"""Number of bisections: the allowed share of a step is found to 1/64."""
_TOUCH = 1e-9
"""An arm this little inside a region [m] counts as outside."""


class ForbiddenRegion(Guard):
    """Base class: `depth` gives the distance by which an arm is inside a forbidden region."""

    keeps_out = True

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self._joints, self._change = columns_in(spec.command, "rad"), limits.joint_acceleration * spec.period**2
        self._pick = picker(self._joints)

    def depth(self, joints: Sequence[float]) -> float:
        """Distance by which the arm is inside the region at `joints` (k,) [rad], in m; 0 outside."""
        raise NotImplementedError

    def is_outside(self, joints: Sequence[float]) -> bool:
        """Whether the arm is outside at `joints` (k,) [rad]; called once in each tick, so subclasses make it fast."""
        return self.depth(joints) <= _TOUCH

    def rest(self, last: Numbers, step: Numbers, share: float = 1.0) -> Numbers:
        """Where the joints come to rest after `share` of `step` from `last`, if they brake together. Shape: (k,)."""
        # Braking takes n steps, each shorter by the same amount: together they have (n - 1) / 2 times the first length.
        braking = math.ceil(share * max(max(step), -min(step)) / self._change - 1e-6)
        share *= 1.0 + max(0, braking - 1) / 2.0
        return [start + share * way for start, way in zip(last, step, strict=True)]

    def limit(self, tick: Tick) -> bool:
        """Shorten the step of all joints."""
        last, wanted = self._pick(tick.last), self._pick(tick.command)
        step = list(map(sub, wanted, last))
        if tick.rest[0] != wanted:
            tick.rest = wanted, self.rest(last, step)
        if self.is_outside(tick.rest[1]):
            return False
        here = max(self.depth(last), _TOUCH)
        if self.depth(tick.rest[1]) <= here:  # it leaves
            return False
        least, most = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = (least + most) / 2.0
            if self.depth(self.rest(last, step, middle)) <= here:
                least = middle
            else:
                most = middle
        for at, start, way in zip(self._joints, last, step, strict=True):
            tick.command[at] = start + least * way
        return True


class WorkspaceBox(ForbiddenRegion):
    """The tool stays in a box; the limit shown is its longest edge.

    Args:
        spec: The arm.
        limits: Its limits; `joint_acceleration` is used.
        low: Lowest x, y and z [m], in ``base_link``; minus infinity for no limit.
        high: Highest x, y and z [m].
        tool_position: Forward kinematics, (n, k) [rad] to (n, 3) [m].

    Raises:
        InvalidValue: `low` is not below `high`.
    """

    number, name, unit = "G10", "workspace box", "m"
    setting = "box_x_min, box_x_max, box_y_min, box_y_max, box_z_min, box_z_max"

    def __init__(
        self,
        spec: RobotSpec,
        limits: Limits,
        low: Sequence[float],
        high: Sequence[float],
        tool_position: ToolPosition,
    ) -> None:
        super().__init__(spec, limits)
        self._low, self._high = (*map(float, low),), (*map(float, high),)
        require_room(self._low, self._high)
        self._tool, size = tool_point_of(tool_position), len(self._joints)
        self._levers = tool_levers(arm_of(tool_position)) or [math.inf] * size
        self._at, self._room = [0.0] * size, -math.inf  # how far inside the tool is at the joints `_at` [m]
        edges = [most - least for least, most in zip(self._low, self._high, strict=True)]
        self.limit_value = max(edge for edge in edges if edge < math.inf)

    def depth(self, joints: Sequence[float]) -> float:
        """Distance of the tool outside the box, along the axis where it is farthest [m]."""
        return max(0.0, -self._inside(joints))

    def _inside(self, joints: Sequence[float]) -> float:
        """Distance of the tool from the nearest side of the box [m]; below 0 outside."""
        x, y, z = self._tool(joints)
        low, high = self._low, self._high
        return min(x - low[0], high[0] - x, y - low[1], high[1] - y, z - low[2], high[2] - z)

    def is_outside(self, joints: Sequence[float]) -> bool:
        """As in the base class; computed again only when the joints have turned far enough to bring the tool out."""
        if sum(map(mul, self._levers, map(abs, map(sub, joints, self._at)))) < self._room:
            return True
        self._at, self._room = [*joints], self._inside(joints)
        return self._room >= -_TOUCH

    def start_fault(self, start: Numbers) -> str | None:
        """Why the arm must not go to `start` (m,)."""
        joints = [start[at] for at in self._joints]
        if self.depth(joints) <= _TOUCH:
            return None
        at, low, high = (
            ", ".join(f"{value:.3f}" for value in point) for point in (self._tool(joints), self._low, self._high)
        )
        return (
            f"the tool would be at {at} m, outside the box from {low} to {high} m: widen the box, or choose another "
            "start"
        )


class Collision(ForbiddenRegion):
    """Links of the arm that share no joint stay apart, and all links stay above the table."""

    number, name, unit, setting = "G24", "collision", "m", "clearance"

    def __init__(self, spec: RobotSpec, limits: Limits, tubes: Tubes) -> None:
        super().__init__(spec, limits)
        self.limit_value, self._tubes, self._table = limits.clearance, tubes, limits.table_height

    def depth(self, joints: Sequence[float]) -> float:
        """By how much the least distance is below the limit [m]."""
        distance = min(self._tubes.nearest(joints), self._tubes.lowest(joints) - self._table)
        return max(0.0, self.limit_value - distance)

    def is_outside(self, joints: Sequence[float]) -> bool:
        """As in the base class; distances that the motion cannot have used up are not computed again."""
        return not self._tubes.nearer_than(self.limit_value, joints, self._table)

    def start_fault(self, start: Numbers) -> str | None:
        """Why the arm must not go to `start` (m,)."""
        if (depth := self.depth([start[at] for at in self._joints])) <= _TOUCH:
            return None
        return (
            f"the arm would be {self.limit_value - depth:.3f} m from itself or from the table at "
            f"{self._table:g} m, and {self.limit_value:g} m are kept: choose another start, or correct table_height"
        )


def require_room(low: Sequence[float], high: Sequence[float]) -> None:
    """`InvalidValue` if a box from `low` to `high` [m] is empty."""
    if not all(least < most for least, most in zip(low, high, strict=True)):
        raise InvalidValue(
            f"A workspace box needs room: low {low} must be below high {high} on every axis. Change the limits box_* "
            "(box_z_min is table_height unless it is given)."
        )
