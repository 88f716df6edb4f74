"""The loop that moves a robot: observe, act, step, at absolute deadlines; and what ends it.

Everything goes through ``env.step`` of a `RobotEnv`, whose robot may as well be a live one. However it ends (all
episodes done, Ctrl-C, SIGTERM, a fault) the robot is halted and closed before anything is reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import gymnasium as gym

from bam_envs.errors import BamEnvsError
from bam_train.deploy.journal import EpisodeRecord, Journal
from bam_train.deploy.pacer import Pacer
from bam_train.deploy.signals import Stopped, stop_signals
from bam_train.errors import BamTrainError
from bam_train.evaluation import require_finite

Env = gym.Env[Any, Any]


class Policy(Protocol):
    """What decides: a `FrozenPolicy`."""

    def reset(self, rows: Any = None) -> None:
        """Forget the recurrent state."""

    def act(self, observation: Any) -> Any:
        """The action for one observation."""


class Watcher(Protocol):
    """What shows the loop to a human; called between ticks, so it has to be quick."""

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> None:
        """A step was taken."""

    def ended(self, record: EpisodeRecord, pacer: Pacer) -> None:
        """An episode ended."""


@dataclass(frozen=True)
class Ending:
    """Why the loop stopped."""

    reason: str
    """``"episodes done"``, ``"interrupted"`` or ``"fault: ..."``."""
    status: int
    """Exit status of the program: 0, 128 + the signal, or 1."""


def deploy(env: Env, policy: Policy, pacer: Pacer, journal: Journal, watcher: Watcher, *, seed: int) -> Ending:
    """Run ``journal.wanted`` episodes; episode k gets ``seed + k``. Never raises for what happened on the way.

    Args:
        env: The environment, already proved to fit the policy; it is closed on return.
        policy: What decides.
        pacer: The deadlines.
        journal: Filled in as it goes.
        watcher: Shows it.
        seed: Seed of the first episode.
    """
    with stop_signals() as switch:
        try:
            try:
                switch.armed = True
                for k in range(journal.wanted):
                    play(env, policy, pacer, journal, watcher, seed + k)
            finally:  # inside the outer try: a signal that comes before this line is still caught
                switch.armed = False
            ending = Ending("episodes done", 0)
        except Stopped as stopped:
            ending = Ending("interrupted", 128 + stopped.signal)
        except Exception as error:  # whatever went wrong: the robot has to be halted and the report made
            ending = Ending(f"fault: {fault_text(error)}", 1)
        finally:
            halt(env)
        return _close(env, ending)


def play(env: Env, policy: Policy, pacer: Pacer, journal: Journal, watcher: Watcher, seed: int) -> None:
    """One episode."""
    observation, _ = env.reset(seed=seed)
    policy.reset()
    record = journal.begin(seed)
    pacer.start()
    while not record.complete:
        pacer.wait()
        action = policy.act(observation)
        require_finite(action, f"at step {record.length} of the episode with seed {seed}")
        journal.startup.finish("reset and first action")
        observation, reward, terminated, truncated, info = env.step(action)
        record.add(float(reward), info)
        record.end = "terminated" if terminated else "truncated" if truncated else "stopped"
        watcher.ticked(record, action, pacer)
    watcher.ended(record, pacer)


def connect(env: Env) -> None:
    """Open the link to the robot, if there is one, without moving it: what is missing shows before the loop."""
    robot = getattr(env.unwrapped, "robot", None)
    if robot is not None:
        robot.connect()


def halt(env: Env) -> None:
    """Stop the robot moving, if the environment has one."""
    robot = getattr(env.unwrapped, "robot", None)
    if robot is not None:
        robot.halt()


def fault_text(error: Exception) -> str:
    """One line; with the exception's type unless it is one of ours, whose text says enough."""
    text = " ".join(str(error).split())
    own = isinstance(error, (BamEnvsError, BamTrainError)) and text
    return text if own else f"{type(error).__name__}: {text}".removesuffix(": ")


def _close(env: Env, ending: Ending) -> Ending:
    """Drop the link; a failure to is a fault too, unless there was one before."""
    try:
        env.close()  # type: ignore[no-untyped-call]
    except Exception as error:  # an environment's own business, and the report must come out all the same
        if ending.status == 0:
            return replace(ending, reason=f"fault: closing failed: {fault_text(error)}", status=1)
    return ending
