"""For scripts that run a policy in a loop of their own: a command line, and the environment, here or a live robot's."""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from bam_train.cli.consent import plan_lines, require_consent

if TYPE_CHECKING:
    import gymnasium as gym

    from bam_train.checkpoint import Checkpoint


class ScriptParser(argparse.ArgumentParser):
    """An `argparse` parser whose errors are one line each, with the closest match for a typo.

    Args:
        file: The script.
        description: Its docstring, shown as it is.
    """

    def __init__(self, file: str, description: str | None) -> None:
        kind = argparse.RawDescriptionHelpFormatter
        super().__init__(
            Path(file).stem, "%(prog)s.py [options]", description, formatter_class=kind, allow_abbrev=False
        )

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Read the command line, or `args`.

        Raises:
            SystemExit: After ``-h`` (0), or for what cannot be (2).
        """
        known, rest = self.parse_known_args(args, namespace)
        if rest:
            from bam_train.values import closest

            options = [text for action in self._actions for text in action.option_strings]
            self.error(f"unknown option {rest[0]!r}. {closest(rest[0].partition('=')[0], options)}")
        return known

    def error(self, message: str) -> NoReturn:
        """End the program with one line on standard error."""
        self.exit(2, f"{self.prog}: {message.removeprefix('argument ')}\n")


def whole(least: int) -> Callable[[str], int]:
    """What reads a whole number that is at least `least`, as an argument's type."""

    def read(text: str) -> int:
        try:
            value = int(text.replace("_", ""))
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"expected a whole number from {least}, found {text!r}")
        return value

    return read


def require_cpus(number: int) -> None:
    """Refuse ``--num-cpus``, of which one learns and the others run episodes, where there are fewer.

    Raises:
        SettingsError: With the most that there can be; the one that learns counts as none.
    """
    from bam_train.errors import SettingsError
    from bam_train.trainers.rllib.cluster.resources import cores

    if number - 1 > cores():
        raise SettingsError(
            f"--num-cpus: expected at most {cores() + 1}, one to learn and one for each CPU of this computer, "
            f"found {number}"
        )


def require_address(robot: str | None) -> None:
    """Refuse a ``--robot`` that is no address before anything is trained for it; nothing is connected.

    Raises:
        InvalidValue: Says what was expected.
    """
    if robot is not None:
        from bam_envs.robots.live.building import require_robot_address

        require_robot_address(robot)


@contextlib.contextmanager
def ctrl_c_asks() -> Iterator[Callable[[], bool]]:
    """Within, the first Ctrl-C interrupts nothing, and what this gives says that it came; the second interrupts."""
    asked = False

    def ask(*_: object) -> None:
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        print("finishing the update and saving; Ctrl-C again quits at once", file=sys.stderr, flush=True)

    before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def open_env(
    checkpoint: Checkpoint, robot: str | None = None, *, who: str, episodes: int, yes: bool = False
) -> Iterator[gym.Env[Any, Any]]:
    """The environment that a checkpoint was trained in, fresh; within, a live robot is connected and may be moved.

    However it is left, the robot is halted and the link dropped. Of a live robot, each `step` waits for the end of its
    period.

    Args:
        checkpoint: What is going to act; the environment is proved to fit it.
        robot: Address of a live robot behind rosbridge, such as ``ws://10.0.0.5:9090``; None for the simulated one.
        who: What will move it, as the question to a person begins.
        episodes: How many are planned, for the same question.
        yes: Do not ask before a real robot moves.

    Raises:
        CheckpointMismatch: The environment is another than the checkpoint was trained in.
        SettingsError: It cannot be made, or nobody says that the real robot may move.
    """
    from bam_train.environments import make_env, require_fit
    from bam_train.place import Place

    manifest, place = checkpoint.manifest, Place(robot=robot)
    with contextlib.closing(make_env(manifest.env, manifest.env_kwargs, place=place)) as env:
        require_fit(checkpoint, env, place)
        if robot is not None:
            env.unwrapped.robot.connect()  # type: ignore[attr-defined]
            plan = plan_lines(env, manifest.env, place.text, episodes)
            require_consent(env, f"{who}: {checkpoint.path}", yes=yes, plan=plan)
        yield env
