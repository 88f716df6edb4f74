"""For scripts that run a policy in a loop of their own: a command line, and the environment, here or a live robot's."""

from __future__ import annotations

import argparse
import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from bam_train.cli.console import say
from bam_train.signals import SignalMemory, handled, interrupt

if TYPE_CHECKING:
    import gymnasium as gym

    from bam_train.checkpoint import Checkpoint


class ScriptParser(argparse.ArgumentParser):
    """Parses the options of the script `file`, described by its docstring; an error is one line, with status 2."""

    def __init__(self, file: str, description: str | None) -> None:
        kind, name = argparse.RawDescriptionHelpFormatter, Path(file).stem
        super().__init__(name, "%(prog)s.py [options]", description, formatter_class=kind, allow_abbrev=False)

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Read the command line, or `args`; an unknown option has the closest match."""
        known, rest = self.parse_known_args(args, namespace)
        if rest:
            from bam_envs.core.wording import did_you_mean

            options = [text for action in self._actions for text in action.option_strings]
            self.error(f"unknown option {rest[0]!r}. {did_you_mean(rest[0].partition('=')[0], options)}")
        return known

    def add_environment(self, own: str) -> None:
        """Add ``--env``, ``--parity`` and ``--out``, what is trained on and where it goes."""
        self.add_argument("--env", metavar="ID", help=f"environment, any that bam-train takes (default {own})")
        self.add_argument("--parity", action="store_true", help="robo-gym's own arithmetic: env_kwargs.parity=true")
        where = "checkpoint (default checkpoints/NAME.zip, or a numbered one)"
        self.add_argument("--out", type=Path, metavar="FILE", help=where)

    def add_robot(self) -> None:
        """Add ``--robot``, ``--yes`` and ``--render``, where the policy acts and who watches."""
        what = "use the policy on a live robot behind rosbridge, such as ws://10.0.0.5:9090"
        self.add_argument("--robot", metavar="URL", help=what)
        self.add_argument("--yes", action="store_true", help="do not ask before a real robot moves")
        self.add_argument("--render", action="store_true", help="show the policy's episodes in a window")

    def error(self, message: str) -> NoReturn:
        """End the program with one line on standard error."""
        self.exit(2, f"{self.prog}: {message.removeprefix('argument ')}\n")


def whole(least: int) -> Callable[[str], int]:
    """What reads a whole number that is at least `least`, as an argument's type."""

    def read(text: str) -> int:
        with contextlib.suppress(ValueError):
            if int(text) >= least:
                return int(text)
        raise argparse.ArgumentTypeError(f"expected a whole number from {least}, found {text!r}")

    return read


def environment_of(args: argparse.Namespace, own: str, own_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """The settings ``env`` and ``env_kwargs`` of ``--env`` and ``--parity``; without ``--env`` the script's own."""
    kwargs = dict(own_kwargs) if args.env is None else {}
    return {"env": args.env or own, "env_kwargs": kwargs | ({"parity": True} if args.parity else {})}


def require_place(env_id: str, robot: str | None, render: bool) -> None:
    """Refuse a ``--robot`` that cannot be and a ``--render`` without a screen; nothing is made or connected."""
    if robot is not None:
        from bam_envs.live.building import require_robot_address
        from bam_train.env_location import Place

        require_robot_address(robot)
        Place(robot).robot_kwargs(env_id, {})
    if render:
        from bam_train.cli.consent import require_screen

        require_screen(remote=robot is not None)


@contextlib.contextmanager
def signals_ask() -> Iterator[Callable[[], bool]]:
    """Within, the first Ctrl-C, SIGTERM or SIGHUP interrupts nothing, and what this gives says that it came.

    A second one interrupts, and leaving raises what the first one asked for.
    """
    came: list[int] = []

    def handle(number: int) -> None:
        if came:
            interrupt(number)
        came.append(number)
        again = "Ctrl-C again" if number == signal.SIGINT else "another signal"
        say(f"finishing the update and saving; {again} quits at once")

    with handled(handle):
        yield lambda: bool(came)
    if came:
        interrupt(came[0])


@contextlib.contextmanager
def open_env(
    checkpoint: Checkpoint, robot: str | None = None, *, render: bool = False, **asked: Any
) -> Iterator[gym.Env[Any, Any]]:
    """The environment that a checkpoint was trained in, fresh; within, a live robot is connected and may be moved.

    However it is left, the robot is halted and the link dropped. Of a live robot, each `step` waits for the end of its
    period. `robot` is its address; what is `asked` is as of `bam_train.cli.consent.connected_env`.
    """
    from bam_train.cli.consent import connected_env
    from bam_train.env_location import Place

    require_place(checkpoint.manifest.env, robot, render)
    with SignalMemory() as signals:
        env = connected_env(checkpoint, Place(robot), signals, render=render, **asked)
        with contextlib.closing(env):
            yield env
