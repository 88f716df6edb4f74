"""A simulated robot behind a simulated link, with the guards of a live robot, for rehearsals of a deployment.

Time is simulated: it advances by one period with each command, and the ages of states are in simulated time.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.core.robot import EnvIds, Initial, RobotSpec, RobotState
from bam_envs.live.building import profile_limits, require_effect
from bam_envs.robots.linked import Array, LinkedRobot
from bam_envs.robots.profile import fitting_profile, profile_for
from bam_envs.ros.codec import RobotInfo
from bam_envs.safety.gate import ClearedCommand, SafeRobot
from bam_envs.safety.guard import is_base, measured_places

AT_REST = 0.02
"""Speed below which a joint [rad/s], or a base [m/s and rad/s], is at rest."""
LONGEST_STOP = 5.0
"""Maximum time until a halted robot is at rest [s]."""


class RehearsedRobot:
    """One simulated robot behind a link, which takes cleared commands only, like a live robot.

    Args:
        robot: The robot behind the link.
        live: The spec of its live counterpart, whose way to follow commands the guards expect.
    """

    needs_clearance = stands_for_a_real_one = True

    def __init__(self, robot: LinkedRobot, live: RobotSpec) -> None:
        self.robot, self.num_robots = robot, robot.num_robots
        self.spec = replace(robot.spec, lag=live.lag, is_timed=live.is_timed)
        text = f"{robot.spec.name}, simulated behind a link; its time advances with commands"
        self.info = RobotInfo(robot.spec.name, simulated=True, lockstep=True, period=robot.spec.period, text=text)

    def connect(self) -> None:
        """Make the robot ready."""
        self.robot.connect()

    def not_ready(self) -> None:
        """Return None: it is always ready."""

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Set the robot to `initial`, at rest."""
        return self.robot.reset(env_ids, initial)

    def step(self, command: Array | ClearedCommand) -> RobotState:
        """Send a cleared command; one period later, the newest state that has arrived.

        Raises:
            InvalidValue: No `SafeRobot` cleared it.
        """
        if not isinstance(command, ClearedCommand):
            raise InvalidValue(
                f"Commands to {self.spec.name} must be cleared by a SafeRobot: use rehearsed_robot(...)."
            )
        return self.robot.step(command.for_robot(self))

    def measure(self) -> RobotState:
        """The newest state that has arrived; `ResetNeeded` before `connect`."""
        if not self.robot.newest.signals:
            raise ResetNeeded("The rehearsed robot is not connected. Call connect() first.")
        return self.robot.newest

    def age(self) -> float:
        """Age of that state [s]."""
        return float(self.robot.age[0])

    def halt(self) -> None:
        """Stop moving."""
        self.robot.halt()

    def close(self) -> None:
        """Halt, and drop the link."""
        self.robot.close()


def rehearsed_robot(
    robot: LinkedRobot,
    *,
    profile: str | None = None,
    guards: Mapping[str, float] | None = None,
    trial: bool = False,
    straight: bool = False,
) -> SafeRobot:
    """A `SafeRobot` around `robot`, with the limits and the lag of a live robot.

    Args:
        robot: One simulated robot behind a link.
        profile: The robot profile with the limits of the guards; by default the shipped one for the robot.
        guards: Limits that replace the profile's, such as ``{"lag": 0.15}``.
        trial: Whether it is on trial: slow, and in a box around its start; see `Limits.on_trial`.
        straight: Whether the task moves the tool in straight lines, see `SafeRobot`.

    Raises:
        InvalidValue: There are several robots, the profile has no such commands, or a limit is outside its bounds or
            changes no guard.
    """
    labels = robot.spec.command.labels
    chosen = profile_for(robot.spec) if profile is None else fitting_profile(profile, robot.spec).narrowed(labels)
    tool = getattr(robot.robot, "tool_position", None)  # forward kinematics of an arm that is no UR5e
    limits = profile_limits(chosen).changed({} if guards is None else guards)
    if trial:
        limits = limits.on_trial(base=chosen.kind == "base")
    live = replace(chosen, period=robot.spec.period).spec()
    safe = SafeRobot(RehearsedRobot(robot, live), limits=limits, tool_position=tool, straight=straight)
    require_effect(safe, guards or {})
    return safe


def time_to_stop(robot: LinkedRobot) -> float:
    """Time from sending a halt to one robot until it is at rest [s]; infinite if longer than `LONGEST_STOP`.

    The halt is sent through the link once, like any command, and nothing follows it. The robot's state is restored
    afterwards.
    """
    before, spec = robot.state_dict(), robot.spec
    speeds = spec.command.units if is_base(spec) else [f"{unit}/s" for unit in spec.command.units]
    places = measured_places(spec, speeds)

    def moves() -> bool:
        return any(abs(robot.there.signals[name][0, column]) > AT_REST for _, name, column in places)

    robot.step(robot.rest(robot.newest))
    periods = 1
    while moves() and periods * spec.period < LONGEST_STOP:
        robot.wait()
        periods += 1
    seconds = math.inf if moves() else periods * spec.period
    robot.load_state_dict(before)
    return seconds
