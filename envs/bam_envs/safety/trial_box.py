"""The guard that keeps a robot on trial near its start."""

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import RobotSpec
from bam_envs.safety.base_guards import BaseBox
from bam_envs.safety.guard import Guard, Limits, Tick, ToolPosition, columns_in, tool_point_of
from bam_envs.safety.region_guards import WorkspaceBox


class TrialBox(Guard):
    """A robot on trial stays near the place where its first command begins: the tool of an arm, or a base.

    The way to a start pose is not limited.

    Args:
        spec: The robot.
        limits: Its limits.
        half: Maximum distance from the start along each axis [m].
        tool_position: Forward kinematics of an arm, (n, k) [rad] to (n, 3) [m]; None for a base.

    Raises:
        InvalidValue: The pose of a base is not measured.
    """

    number, name, unit, setting, keeps_out = "G10", "trial box", "m", "trial_box", True

    def __init__(self, spec: RobotSpec, limits: Limits, half: float, tool_position: ToolPosition | None) -> None:
        self._spec, self._limits, self.limit_value, self._tool = spec, limits, half, tool_position
        self._joints = columns_in(spec.command, "rad")
        if tool_position is None and "base_pose" not in [signal.name for signal in spec.signals]:
            raise InvalidValue(
                f"The {self.title} of {spec.name} needs base_pose, which the task does not measure. Add the signal to "
                "the task, or run without a trial box (--stage full)."
            )
        self._box: Guard | None = None

    def limit(self, tick: Tick) -> bool:
        """Shorten the step as `WorkspaceBox` and `BaseBox` do."""
        if tick.approach:
            return False
        if self._box is None:
            self._box = self._around(tick)
        return self._box.limit(tick)

    def _around(self, tick: Tick) -> Guard:
        """The box around the robot's position."""
        if self._tool is not None:
            here = [*tool_point_of(self._tool)([tick.last[at] for at in self._joints])]
        else:
            here = tick.signals["base_pose"][0, :2].tolist()
        low, high = [value - self.limit_value for value in here], [value + self.limit_value for value in here]
        if self._tool is None:
            return BaseBox(self._spec, self._limits, low, high)
        return WorkspaceBox(self._spec, self._limits, low, high, self._tool)
