"""For scripts of experiments: flags, the environment of a checkpoint, simulated or with a live robot, and episodes."""

import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from bam_envs.core.location import HERE, LiveRobot
from bam_envs.core.timing import Pacer
from bam_envs.live.building import require_robot_address
from bam_train.checkpoint import Checkpoint
from bam_train.cli.consent import connected_env, require_screen
from bam_train.cli.console import say_in_handler
from bam_train.cli.flags import EnvId, File, Url
from bam_train.deploy.deployment import Deployment
from bam_train.deploy.journal import EpisodeRecord, Journal
from bam_train.environments import with_live_robot
from bam_train.signals import SignalMemory, handled, interrupt


@dataclass(frozen=True, kw_only=True)
class RobotFlags:
    """Flags of the robot and its display; a script's own flags come before these."""

    robot: Url = None
    """Use the policy on a live robot behind rosbridge, such as ws://10.0.0.5:9090."""
    yes: bool = False
    """Do not ask before a real robot moves."""
    render: bool = False
    """Show the policy's episodes in a window."""


@dataclass(frozen=True, kw_only=True)
class TrainingFlags(RobotFlags):
    """Flags of the training environment and the checkpoint."""

    env: EnvId = None
    """Environment, any that bam-train takes, instead of the script's own."""
    parity: bool = False
    """robo-gym's own arithmetic: env_kwargs.parity=true."""
    out: File = None
    """Checkpoint (default checkpoints/NAME.zip, or a numbered one)."""


def environment_of(args: TrainingFlags, own: str, own_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """The settings ``env`` and ``env_kwargs`` of ``--env`` and ``--parity``; without ``--env`` the script's own."""
    kwargs = dict(own_kwargs) if args.env is None else {}
    return {"env": args.env or own, "env_kwargs": kwargs | ({"parity": True} if args.parity else {})}


def require_place(env_id: str, robot: str | None, render: bool) -> None:
    """Refuse an invalid ``--robot`` and a ``--render`` without a screen; makes and connects nothing."""
    if robot is not None:
        require_robot_address(robot)
        with_live_robot(env_id, {}, LiveRobot(robot))
    if render:
        require_screen(remote=robot is not None)


@contextlib.contextmanager
def signals_ask() -> Iterator[Callable[[], bool]]:
    """Within the ``with`` block, the first Ctrl-C, SIGTERM or SIGHUP only makes the yielded function return True.

    A second signal interrupts the block; at its end, the exception of the first one is raised.
    """
    came: list[int] = []

    def handle(number: int) -> None:
        if came:
            interrupt(number)
        came.append(number)
        again = "Ctrl-C again" if number == signal.SIGINT else "another signal"
        say_in_handler(f"finishing the update and saving; {again} quits at once")

    with handled(handle):
        yield lambda: bool(came)
    if came:
        interrupt(came[0])


@contextlib.contextmanager
def open_env(
    checkpoint: Checkpoint, robot: str | None = None, *, render: bool = False, **asked: Any
) -> Iterator[gym.Env[Any, Any]]:
    """Make the environment of a checkpoint; within the ``with`` block, a live robot is connected and may be moved.

    At the end of the block, for any reason, the robot is halted and the link dropped. With a live robot, each `step`
    waits for the end of its period. `robot` is its address; `asked` has options of
    `bam_train.cli.consent.connected_env`.
    """
    require_place(checkpoint.manifest.env, robot, render)
    with SignalMemory() as signals:
        place = HERE if robot is None else LiveRobot(robot, stage="full")
        env = connected_env(checkpoint, place, signals, render=render, **asked)
        with contextlib.closing(env):
            yield env


class _Unwatched:
    """A `Watcher` that displays nothing."""

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> None:
        """Called after every step."""

    def ended(self, record: EpisodeRecord) -> None:
        """Called after every episode."""


def play(env: gym.Env[Any, Any], policy: Any, *, episodes: int, seed: int) -> Iterator[EpisodeRecord]:
    """Play episodes of a policy in the loop of `bam-deploy`, and yield the record of each; episode k gets ``seed + k``.

    Args:
        env: An environment of `open_env`; a live robot is halted after every episode.
        policy: Has ``reset()`` and ``act(observation)``.
        episodes: Number of episodes.
        seed: Seed of the first one.
    """
    deployment = Deployment(env, policy, Pacer(None), Journal(episodes))
    for k in range(episodes):
        yield deployment.episode(_Unwatched(), seed=seed + k)
