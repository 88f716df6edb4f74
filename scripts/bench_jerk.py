"""How smoothly an arm moves with the controllers that take a policy's commands: jerk, lag and success.

The policy runs in closed loop, behind the guards of a live robot, on the simulated arm, whose own drives follow a set
point like a spring and a damper. What the set points are between two commands is what differs:

held            forward_position_controller: the newest command, at once
trajectory N    joint_trajectory_controller, one point that is reached after N periods; it begins at the set point, as
                with ``interpolate_from_desired_state: true``
  measured      the same, and it begins where the joint is measured, as with ``false``, which is the default
  at rest       as trajectory N, with velocity zero at the point: a cubic spline instead of a straight line

Each is measured with commands that are on time, and with each of them late by up to --late seconds.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from bam_envs.core.errors import SafetyStop
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.robot_env import RobotEnv
from bam_envs.robots.physics.mujoco_arm import PHYSICS_STEPS, SimulatedArm
from bam_envs.robots.profile import load_profile
from bam_envs.safety.gate import SafeRobot
from bam_envs.tasks.pick import PickTask

Array = NDArray[np.float64]
CHECKPOINT = Path(__file__).parent.parent / "checkpoints" / "pick-ppo.zip"
LATE = 0.015


@dataclass(frozen=True)
class Controller:
    """What a controller makes of commands."""

    reach: float = 0.0
    """When a command is reached [periods]; 0: at once."""
    measured: bool = False
    """Whether a trajectory begins where the joint is measured, or at the last set point."""
    at_rest: bool = False
    """Whether the point says that the arm rests there."""


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
    """The simulated arm with a controller between commands and drives.

    Args:
        controller: Which one.
        late: Each command comes late by up to so much [s].
        smoothing: Time constant with which the robot itself smooths its set points [s], as a UR's servoj does; 0: none.
    """

    def __init__(self, controller: Controller, late: float, smoothing: float = 0.0) -> None:
        super().__init__(1, with_object=True)
        self.controller, self.late = controller, late
        # What the guards know of a live arm with such a controller.
        extra = max(0.0, controller.reach - 1.0) * self.spec.period
        self.spec = replace(self.spec, lag=load_profile("ur5e").spec().lag + extra)
        self._share = 1 - np.exp(-self.spec.period / PHYSICS_STEPS / smoothing) if smoothing else 1.0
        self.positions: list[Array] = []
        """Measured joints at each physics step since the reset [rad]. Shape of each: (6,)."""
        self.targets: list[Array] = []
        """What was commanded by then, were it on time, moving linearly within a period [rad]."""
        self._rng = np.random.default_rng(0)

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Begin at rest."""
        state = super().reset(env_ids, initial)
        self.positions, self.targets = [], []
        self._from = self._to = self._wanted = self._smooth = self._setpoint[0, :6].copy()
        self._velocity, self._begun, self._now = np.zeros(6), -np.inf, 0.0
        return state

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """One period, in physics steps."""
        travel, period = self._travel(command), self.spec.period
        goal, arrival = self._command[0, :6], self._now + self.late * self._rng.random()
        wanted, pending, tick = self._wanted, True, period / PHYSICS_STEPS
        gripper = self._setpoint[0, 6]
        for k in range(1, PHYSICS_STEPS + 1):
            if pending and arrival <= self._now:
                self._take(goal)
                pending = False
            self._now += tick
            self._smooth = self._smooth + (self._at(self._now)[0] - self._smooth) * self._share
            setpoint = np.append(self._smooth, gripper + travel[0, 6] * k / PHYSICS_STEPS)
            self.physics.step(setpoint[None, None])
            self._setpoint = setpoint[None]
            self.positions.append(self.physics.qpos[0, :6].copy())
            self.targets.append(wanted + (goal - wanted) * k / PHYSICS_STEPS)
        self._wanted = goal
        yield self._measure(self._all)

    def _take(self, goal: Array) -> None:
        """A new command replaces the one that runs."""
        physics = self.physics
        here, speed = self._at(self._now)
        if self.controller.measured:
            here, speed = physics.qpos[0, :6].copy(), physics.qvel[0, :6].copy()
        self._from, self._velocity, self._to, self._begun = here, speed, goal, self._now

    def _at(self, now: float) -> tuple[Array, Array]:
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


def play(arm: DrivenArm, policy: Any, episodes: int) -> dict[str, float]:
    """Jerk of the joints in the median episode [rad/s^3], lag [s] and share of successes."""
    task: Any = PickTask(1)
    env: Any = TimeLimit(RobotEnv(SafeRobot(arm), task), ENVIRONMENTS["bam/pick-v0"].max_episode_steps)
    jerks, lags, successes = [], [], 0
    tick = arm.spec.period / PHYSICS_STEPS
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
        jerks.append(np.diff(positions, 3, axis=0) / tick**3)
        lags.append(lag(positions, targets, tick))
    env.close()
    # The median episode: now and then the arm touches the cube.
    rms = float(np.median([np.sqrt((jerk**2).mean()) for jerk in jerks]))
    peak = float(np.median([np.percentile(np.abs(jerk), 99.9) for jerk in jerks]))
    return {"rms": rms, "peak": peak, "lag": float(np.mean(lags)), "success": successes / episodes}


def lag(positions: Array, targets: Array, tick: float) -> float:
    """By how much the measured joints are behind the commanded ones [s]: the shift that fits best."""
    errors = [np.square(positions[k:] - targets[: len(targets) - k]).mean() for k in range(60)]
    return int(np.argmin(errors)) * tick


def main() -> None:
    """Measure, and print a table."""
    from bam_train.policy import FrozenPolicy

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, default=CHECKPOINT, help="a policy of bam/pick")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of each row")
    parser.add_argument("--late", type=float, default=LATE, help="most that a command is late [s]")
    parser.add_argument("--smoothing", type=float, default=0.0, help="of the robot itself; a UR's is about 0.03 [s]")
    parser.add_argument("--only", choices=CONTROLLERS, action="append", help="this alone; may be given several times")
    options = parser.parse_args()
    policy = FrozenPolicy.load(options.checkpoint)
    print("controller                commands   jerk rms   99.9 %  [rad/s^3]   lag [ms]   success")
    for name in options.only or CONTROLLERS:
        for late in (0.0, options.late):
            row = play(DrivenArm(CONTROLLERS[name], late, options.smoothing), policy, options.episodes)
            print(
                f"{name:<26}{'late' if late else 'on time':<10}{row['rms']:>9.0f}{row['peak']:>9.0f}"
                f"{1000 * row['lag']:>20.0f}{row['success']:>10.0%}",
                flush=True,
            )


if __name__ == "__main__":
    main()
