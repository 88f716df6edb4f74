"""How smoothly an arm moves with the controllers that take a policy's commands: jerk, lag and success.

The policy runs in closed loop, behind the guards of a live robot, on the simulated arm, whose own drives follow a set
point like a spring and a damper. What the set points are between two commands is what differs:

held            forward_position_controller: the newest command, at once
trajectory N    joint_trajectory_controller, one point that is reached after N periods; it begins at the set point, as
                with ``interpolate_from_desired_state: true``
  measured      the same, and it begins where the joint is measured, as with ``false``, which is the default
  at rest       as trajectory N, with velocity zero at the point: a cubic spline instead of a straight line

Each is measured with commands that are on time, and with each of them late by up to --late seconds. The jerk [rad/s^3]
is that of the median episode, as now and then the arm touches the cube.
"""

from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from gymnasium.wrappers import TimeLimit

from bam_envs.core.errors import SafetyStop
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot_env import RobotEnv
from bam_envs.robots.physics.mujoco_arm import PHYSICS_STEPS, SimulatedArm
from bam_envs.robots.profile import load_profile
from bam_envs.safety.gate import SafeRobot
from bam_envs.tasks.pick import PickTask
from bam_train.cli.flags import Count
from tests.benchmarks import harness


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    checkpoint: Path = harness.PICK
    """A policy of bam/pick."""
    episodes: Count = 20
    """Episodes of each row."""
    late: float = 0.015
    """Most that a command is late [s]."""
    smoothing: float = 0.0
    """Time constant with which the robot itself smooths set points, of a UR about 0.03 [s]."""
    controller: tuple[str, ...] = ()
    """These controllers alone."""


class Controller(NamedTuple):
    """When a command is reached [periods]; whether it begins where the joint is measured, and ends at rest."""

    reach: float = 0.0
    measured: bool = False
    at_rest: bool = False


CONTROLLERS = {
    "held": Controller(),
    "trajectory 1": Controller(1.0),
    "trajectory 1, measured": Controller(1.0, measured=True),
    "trajectory 1.5": Controller(1.5),
    "trajectory 1.5, measured": Controller(1.5, measured=True),
    "trajectory 2": Controller(2.0),
    "trajectory 2, at rest": Controller(2.0, at_rest=True),
}


class DrivenArm(SimulatedArm):
    """The simulated arm with a controller between commands and drives."""

    def __init__(self, controller, late, smoothing):
        super().__init__(1, with_object=True)
        self.controller, self.late = controller, late
        # What the guards know of a live arm with such a controller.
        extra = max(0.0, controller.reach - 1.0) * self.spec.period
        self.spec = replace(self.spec, lag=load_profile("ur5e").spec().lag + extra)
        self._tick = self.spec.period / PHYSICS_STEPS
        self._share = 1 - np.exp(-self._tick / smoothing) if smoothing else 1.0
        self._rng = np.random.default_rng(0)

    def reset(self, env_ids, initial):
        """Begin at rest."""
        state = super().reset(env_ids, initial)
        # Measured joints at each physics step [rad], and what was commanded by then, were it on time, moving linearly.
        self.positions, self.targets = [], []
        self._from = self._to = self._wanted = self._smooth = self._setpoint[0, :6].copy()
        self._velocity, self._begun, self._now = np.zeros(6), -np.inf, 0.0
        return state

    def slices(self, command, parts):
        """One period, in physics steps."""
        travel = self._travel(command)
        goal, arrival = self._command[0, :6], self._now + self.late * self._rng.random()
        wanted, pending, gripper = self._wanted, True, self._setpoint[0, 6]
        for k in range(1, PHYSICS_STEPS + 1):
            if pending and arrival <= self._now:
                self._take(goal)
                pending = False
            self._now += self._tick
            self._smooth = self._smooth + (self._at(self._now)[0] - self._smooth) * self._share
            setpoint = np.append(self._smooth, gripper + travel[0, 6] * k / PHYSICS_STEPS)
            self.physics.step(setpoint[None, None])
            self._setpoint = setpoint[None]
            self.positions.append(self.physics.qpos[0, :6].copy())
            self.targets.append(wanted + (goal - wanted) * k / PHYSICS_STEPS)
        self._wanted = goal
        yield self._measure(self._all)

    def _take(self, goal):
        """A new command replaces the one that runs."""
        here, speed = self._at(self._now)
        if self.controller.measured:
            here, speed = self.physics.qpos[0, :6].copy(), self.physics.qvel[0, :6].copy()
        self._from, self._velocity, self._to, self._begun = here, speed, goal, self._now

    def _at(self, now):
        """Set point [rad] and its speed [rad/s]."""
        reach, way = self.controller.reach * self.spec.period, self._to - self._from
        share = (now - self._begun) / reach if reach else 1.0
        if share >= 1.0:
            return self._to, np.zeros(6)
        if not self.controller.at_rest:
            return self._from + way * share, way / reach
        first = self._velocity * reach
        square, cube = 3 * way - 2 * first, first - 2 * way
        place = self._from + first * share + square * share**2 + cube * share**3
        return place, (first + 2 * square * share + 3 * cube * share**2) / reach


def play(arm, policy, episodes):
    """Jerk [rad/s^3], rms and 99.9 %, in the median episode; lag [s] and share of successes."""
    limit, tick = ENVIRONMENTS["bam/pick-v0"].max_episode_steps, arm.spec.period / PHYSICS_STEPS
    rms, peaks, lags, successes = [], [], [], 0
    with closing(TimeLimit(RobotEnv(SafeRobot(arm), PickTask(1)), limit)) as env:
        for seed in range(episodes):
            env.unwrapped.robot.resume()
            observation, info = env.reset(seed=seed)
            policy.reset()
            done = False
            with suppress(SafetyStop):  # a guard finds that it does not follow
                while not done:
                    observation, _, terminated, truncated, info = env.step(policy.act(observation))
                    done = terminated or truncated
            successes += bool(info["is_success"])
            positions, targets = np.array(arm.positions), np.array(arm.targets)
            jerk = np.diff(positions, 3, axis=0) / tick**3
            rms.append(np.sqrt((jerk**2).mean()))
            peaks.append(np.percentile(np.abs(jerk), 99.9))
            # By how much the measured joints are behind the commanded ones: the shift that fits best.
            errors = [np.square(positions[k:] - targets[: len(targets) - k]).mean() for k in range(60)]
            lags.append(int(np.argmin(errors)) * tick)
    return np.median(rms), np.median(peaks), np.mean(lags), successes / episodes


def measure_controllers(flags):
    """Each controller."""
    from bam_train.policy import FrozenPolicy

    policy = FrozenPolicy.load(flags.checkpoint)
    yield "controller                commands   jerk rms   99.9 %   lag [ms]   success"
    for name in flags.controller or CONTROLLERS:
        for late in (0.0, flags.late):
            rms, peak, lag, success = play(
                DrivenArm(CONTROLLERS[name], late, flags.smoothing), policy, flags.times(flags.episodes)
            )
            when = "late" if late else "on time"
            yield f"{name:<26}{when:<10}{rms:>9.0f}{peak:>9.0f}{1000 * lag:>11.0f}{success:>10.0%}"
