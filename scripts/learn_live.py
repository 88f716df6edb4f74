"""A policy meets another robot than it was trained on, and learns from it while it works.

The shipped policy of pick on a simulated UR5e with half the friction, 0.5 kg more payload, commands that come late,
and all of it together; then the learner of ``bam-train --learner`` with its defaults, in lockstep: the robot waits for
the learner, and candidates act without trials. A scripted person drives the first episodes, at most 5 % of all steps.
"""

import argparse
import sys
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.scripted import ScriptedPolicy, Sight, Take, tool_actions
from bam_train.agent.transitions import TransitionLog
from bam_train.evaluation import evaluate, wilson_interval
from bam_train.policy import FrozenPolicy
from bam_train.settings import SB3Settings
from bam_train.trainers.learning.live_learner import LiveLearner

ENV, SHIPPED = "bam/pick-v0", str(Path(__file__).parents[1] / "checkpoints" / "pick-ppo.zip")
ROBOTS = {"as in training": (1.0, 0.0, 0), "friction x 0.5": (0.5, 0.0, 0), "payload + 0.5 kg": (1.0, 0.5, 0)}
ROBOTS |= {"2 periods late": (1.0, 0.0, 2), "all three": (0.5, 0.5, 2), "all three, 4 late": (0.5, 0.5, 4)}
SHARE, LONGEST, PUSH_EVERY = 0.05, 100, 10  # of a person; steps of an episode; episodes between candidates


class ChangedArm(SimulatedArm):
    """`n` arms with another friction (a factor) and payload [kg], whose commands come `late` periods late."""

    def __init__(self, n: int, friction: float, payload: float, late: int) -> None:
        super().__init__(n)
        self._changes, self._coming, self._arrived = (friction, payload), np.zeros((late + 1, n, 7)), np.zeros((n, 7))

    def connect(self) -> None:
        """Build the physics, and change it."""
        if self._physics is None:
            super().connect()
            (friction, payload), model = self._changes, self.physics.model
            for name in ("object", "left_pad", "right_pad"):
                model.geom_friction[model.geom(name).id, 0] *= friction
            body = model.body("object").id
            model.body_inertia[body] *= 1.0 + payload / model.body_mass[body]
            model.body_mass[body] += payload
            self.physics.recompute(0)

    def reset(self, env_ids: Any, initial: Any) -> Any:
        """As of `SimulatedArm`; commands on their way are dropped."""
        state = super().reset(env_ids, initial)
        self._coming[:, env_ids] = self._arrived[env_ids] = self._setpoint[env_ids]
        return state

    def halt(self) -> None:
        """As of `SimulatedArm`; commands on their way are dropped."""
        super().halt()
        self._coming[:], self._arrived = self._setpoint, self._setpoint.copy()

    def _travel(self, command: Any) -> Any:
        self._coming, self._command = np.concatenate([self._coming[1:], command[None]]), self._arrived
        travel = super()._travel(self._coming[0])
        self._arrived, self._command = self._command, command.copy()  # a state has the command that was sent
        return travel


def make_robot(name: str, n: int = 1) -> Any:
    """`n` environments of a robot of `ROBOTS`."""
    env: Any = gym.make(ENV, disable_env_checker=True) if n == 1 else gym.make_vec(ENV, num_envs=n)
    env.unwrapped.robot = ChangedArm(n, *ROBOTS[name])
    return env


def scripted_person(take: Take) -> Any:
    """The scripted pick of somebody who knows that the robot is late: a flatter funnel, and a gentle wrist."""
    sight = Sight(take, TABLE)
    across = np.hypot(sight.offset[:, 0], sight.offset[:, 1])
    astray = np.maximum((across - 0.012) / 0.04, (np.abs(sight.turn) - 0.08) / 0.15)
    travel, grip = sight.offset - sight.lead, (astray < 0.3) & (np.abs(sight.offset[:, 2]) < 0.01) | sight.closed
    travel[:, 2] += 0.05 * np.clip(astray, 0.0, 1.0)
    travel[sight.closed], travel[sight.holding] = 0.0, (0.0, 0.0, 1.0)
    turn = np.where(sight.closed, 0.0, 0.3 * (sight.turn - 0.05 * take("target_dyaw")[:, 0]))
    return tool_actions(travel, turn, np.where(grip, 1.0, -1.0), TABLE)


TABLE = PickTask().table
PERSON = ScriptedPolicy(PickTask.labels(TABLE), scripted_person)


def tell(what: str, successes: int, episodes: int) -> None:
    """Print a success rate."""
    low, high = wilson_interval(successes, max(episodes, 1))
    print(f"{what}: {successes / episodes:.1%} of {episodes} episodes succeed ({low:.1%} to {high:.1%})", flush=True)


def measure(what: str, policy: Any, name: str, episodes: int) -> None:
    """Print the success rate of a policy on a robot."""
    with closing(make_robot(name, 50)) as env:
        tell(what, evaluate(policy, ENV, env=env, episodes=episodes).successes or 0, episodes)


def learn(name: str, args: argparse.Namespace) -> None:
    """Learn on a robot, and print the success of the policy every so often, and at the end."""
    learner = LiveLearner.create(
        SB3Settings(ENV, "rlpd", steps=args.steps, seed=args.seed, trainer="live", start=SHIPPED)
    )
    log, driver, said, seen = TransitionLog(), FrozenPolicy.load(SHIPPED), 0, learner.experience
    with closing(make_robot(name)) as env, TemporaryDirectory() as folder:
        while learner.steps < args.steps:
            person, episode = seen.interventions + LONGEST <= SHARE * args.steps, len(seen.outcomes)
            step, done = 0, False
            policy: Any = PERSON if person else driver
            policy.reset()
            after, _ = env.reset(seed=100_000 * (args.seed + 1) + episode)
            while not done:
                before, action = after, policy.act_batch(after[None])[0]
                after, reward, *ends, info = env.step(action)
                log.add(before, action, reward, after, *ends, bool(info.get("is_success")), person, episode, step, "")
                step, done = step + 1, any(ends)
            if (transitions := log.take()) is not None:
                learner.add(transitions)
            learner.learn(sys.maxsize)
            if (episode + 1) % PUSH_EVERY == 0 and learner.is_ready:
                driver = FrozenPolicy.load(learner.save_candidate(Path(folder) / "driver.zip").path)
            if learner.steps // args.every > said or learner.steps >= args.steps:
                said = learner.steps // args.every
                what = f"  {name}: {learner.steps} steps, {seen.interventions} of a person"
                measure(what, learner.freeze(), name, args.episodes)


def main() -> int:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="*", choices=[*ROBOTS], default=[*ROBOTS][-2:], help="which to learn on")
    parser.add_argument("--steps", type=int, default=20_000, help="steps to learn from (default 20000)")
    parser.add_argument("--seed", type=int, default=0, help="of weights, exploration and episodes (default 0)")
    parser.add_argument("--episodes", type=int, default=400, help="of a measurement (default 400)")
    parser.add_argument("--every", type=int, default=5000, help="steps between measurements (default 5000)")
    args = parser.parse_args()
    for name in ROBOTS:
        measure(f"shipped policy, {name}", FrozenPolicy.load(SHIPPED), name, args.episodes)
    for name in args.robots:
        learn(name, args)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
