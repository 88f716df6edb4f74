"""How smoothly an arm moves behind each driver's controller: jerk, lag and success, against commands that are held.

The policy of bam/pick (of a UR5e), or the scripted one, runs in closed loop, behind the guards of a live robot, on the
simulated arm, whose own drives follow a set point like a spring and a damper. The controller, of a mode of the driver's
profile at its own rate, makes the set points between two commands: a command is held, or reached after some periods, on
a straight line or at rest, on a cubic spline.

Each is measured with commands that are on time, and with each of them late by up to --late seconds. The jerk [rad/s^3]
is of the median episode, as now and then the arm touches the cube. Physics take steps of 1 ms, and the jerk is of
positions 5 ms apart.
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
from bam_envs.ros.profile_tables import SPLINE_PERIODS
from bam_envs.safety.gate import SafeRobot
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.scripted import scripted_policy
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
    smoothing: float = 0.03
    """Time constant with which the robot itself smooths set points, of a UR about 0.03 [s]; 0: stiff drives."""
    stack: tuple[str, ...] = ()
    """These stacks alone."""


LIVE_LAG = load_profile("ur5e_position").spec(mode="position").lag
"""Delay of a live arm without that of its controller [s]."""


class Controller(NamedTuple):
    """When a command is reached [periods], and whether the joint is at rest then."""

    reach: float = 0.0
    at_rest: bool = False
    rate: float = 1e9
    """Of its set points [Hz]."""


STACKS = {
    "ur_robot_driver": ("ur5e", "ur5e", "trajectory", 500),
    "franka_ros2": ("fr3", "franka_ros2", "trajectory", 1000),
    "xarm_ros2": ("xarm7", "xarm_ros2", "trajectory", 250),
    "ros2_kortex": ("gen3", "ros2_kortex", "trajectory", 1000),
    "ros2_so_arm100": ("so101", "ros2_so_arm100", "position", 100),
}
"""The arm, the profile and its mode, and the rate of the controller [Hz]."""
GOAL = 50.0
"""Greatest jerk of a stack, rms [rad/s^3]."""
_SUBSTEPS = 5
"""Physics steps of 1 ms between two positions whose jerk is measured."""


class DrivenArm(SimulatedArm):
    """The simulated arm with a controller between commands and drives."""

    def __init__(self, controller, late, smoothing, arm="ur5e"):
        super().__init__(1, with_object=True, robot_model=arm)
        self.controller, self.late = controller, late
        # What the guards know of a live arm with such a controller.
        delay = controller.reach * (0.75 if controller.at_rest else 1.0)
        self.spec = replace(self.spec, lag=LIVE_LAG + max(0.0, delay - 1.0) * self.spec.period)
        self._tick = self.spec.period / PHYSICS_STEPS
        self._share = 1 - np.exp(-self._tick / _SUBSTEPS / smoothing) if smoothing else 1.0
        self._rng = np.random.default_rng(0)

    def connect(self):
        """Build the physics."""
        super().connect()
        self.physics.model.opt.timestep = self._tick / _SUBSTEPS

    def reset(self, env_ids, initial):
        """Begin at rest."""
        state = super().reset(env_ids, initial)
        # Measured joints at each physics step [rad], and what was commanded by then, were it on time, moving linearly.
        self.positions, self.targets = [], []
        size = self._size = self.description.num_joints
        self._from = self._to = self._wanted = self._smooth = self._held = self._setpoint[0, :size].copy()
        self._velocity, self._begun, self._now, self._ticked = np.zeros(size), -np.inf, 0.0, -1.0
        return state

    def slices(self, command, parts):
        """One period, in physics steps."""
        travel, size = self._travel(command), self._size
        goal, arrival = self._command[0, :size], self._now + self.late * self._rng.random()
        wanted, pending, gripper = self._wanted, True, self._setpoint[0, size]
        for k in range(1, PHYSICS_STEPS + 1):
            rows = []
            for substep in range(1, _SUBSTEPS + 1):
                if pending and arrival <= self._now:
                    self._take(goal)
                    pending = False
                self._now += self._tick / _SUBSTEPS
                due = np.floor(self._now * self.controller.rate + 1e-6) / self.controller.rate
                if due > self._ticked:
                    self._ticked, self._held = due, self._at(due)[0]
                self._smooth = self._smooth + (self._held - self._smooth) * self._share
                share = (k - 1 + substep / _SUBSTEPS) / PHYSICS_STEPS
                rows.append(np.append(self._smooth, gripper + travel[0, size] * share))
            self.physics.step(np.array(rows)[None])
            self._setpoint = rows[-1][None]
            self.positions.append(self.physics.qpos[0, :size].copy())
            self.targets.append(wanted + (goal - wanted) * k / PHYSICS_STEPS)
        self._wanted = goal
        yield self._measure(self._all)

    def _take(self, goal):
        """A new command replaces the one that runs."""
        (self._from, self._velocity), self._to, self._begun = self._at(self._now), goal, self._now

    def _at(self, now):
        """Set point [rad] and its speed [rad/s]."""
        reach, way = self.controller.reach * self.spec.period, self._to - self._from
        share = max(0.0, (now - self._begun) / reach) if reach else 1.0
        if share >= 1.0:
            return self._to, np.zeros(self._size)
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
    safe, task = SafeRobot(arm, tool_position=arm.tool_position), PickTask(1, robot_model=arm.description)
    with closing(TimeLimit(RobotEnv(safe, task), limit)) as env:
        for seed in range(episodes):
            env.unwrapped.robot.resume()
            observation, info = env.reset(seed=seed)
            policy.reset()
            done = False
            with suppress(SafetyStop):  # a guard finds that it does not follow
                while not done:
                    action = policy.act_batch(np.asarray(observation)[None])[0]
                    observation, _, terminated, truncated, info = env.step(action)
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


def _controller(profile, mode, rate, period):
    """The controller of the arm in a mode of a profile, and the same one if it only held the commands."""
    (sink,) = (one for one in load_profile(profile).sinks(mode) if len(one.labels) > 1)
    if sink.is_timed:
        is_spline = sink.is_spline(period)
        return Controller(sink.reach_at(period) / period, at_rest=is_spline, rate=rate), Controller(rate=rate)
    reach = 0.0 if sink.rate is None else SPLINE_PERIODS
    return Controller(reach, at_rest=reach > 0.0, rate=min(rate, sink.rate or rate)), Controller(rate=rate)


def measure_stacks(flags):
    """Each driver with its arm: jerk, its ratio to that of held set points, lag and share of successes."""
    from bam_train.policy import FrozenPolicy

    for name, (arm, profile, mode, rate) in STACKS.items():
        if flags.stack and name not in flags.stack:
            continue
        policy = FrozenPolicy.load(flags.checkpoint) if arm == "ur5e" else scripted_policy("bam/pick-v0", arm)
        now, held = _controller(profile, mode, rate, ENVIRONMENTS["bam/pick-v0"].period)
        for late in (0.0, flags.late):
            before, after = (
                play(DrivenArm(one, late, flags.smoothing, arm), policy, flags.times(flags.episodes))
                for one in (held, now)
            )
            share, lag = after[0] / before[0], 1000 * after[2]
            found = f"{after[0]:.0f}, {share:.2f} of {before[0]:.0f} held; {lag:.0f} ms; {after[3]:.0%}"
            when = "late" if late else "on time"
            yield harness.at_most(f"{name}, {arm}, {when}", after[0], GOAL, "rad/s^3", found=found)
