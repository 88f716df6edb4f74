"""What every program of ours shares: flags out of a frozen dataclass, every expected failure one line and a status.

Only tyro is imported before the flags are parsed, so that ``--help`` is quick.
"""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import TextIO, TypeVar

from bam_train.cli.console import say, show_logs_and_tracebacks

Config = TypeVar("Config")

EXTRAS = {
    "torch": "train",
    "stable_baselines3": "train",
    "sb3_contrib": "train",
    "ray": "rllib",
    "pyarrow": "rllib",
    "onnx": "train",
    "tensorboard": "train",
    "matplotlib": "train",
    "mujoco": "sim",
    "PIL": "video",
    "imageio": "video",
}
"""Optional package to the extra of bam-train that brings it."""

TOGETHER = 0.5
"""A signal of a program that comes again within this time is the same one [s]: ``timeout`` sends SIGTERM to the process
and then to its group. Ctrl-C is a person's, and counts each time."""

LONGEST = 2000
"""Characters of an error line; a file or a server may bring a name of millions."""

INTERRUPTED = 130
"""Exit status of a program that Ctrl-C ended (128 + SIGINT)."""


def run_program(
    main: Callable[[Config], int | None],
    config: type[Config],
    *,
    prog: str,
    description: str,
    arguments: Sequence[str] | None = None,
) -> None:
    """Parse the command line into `config`, run `main`, and exit with its status.

    Args:
        main: The program; returns its exit status, None for 0.
        config: A frozen dataclass; one field is one flag.
        prog: The program's name, as it starts each error line.
        description: First line of ``--help``.
        arguments: Instead of those of the process.

    Raises:
        SystemExit: Always.
    """
    prepare()
    sys.exit(guarded(lambda: main(parse(config, prog, description, arguments)), prog))


def prepare() -> None:
    """What comes before everything: where modules of the user are found, and how Python's own texts are shown."""
    sys.path.append(os.getcwd())  # --env my_module:Env-v0, as with python -m; last, so that it hides nothing
    show_logs_and_tracebacks()


def parse(config: type[Config], prog: str, description: str, arguments: Sequence[str] | None) -> Config:
    """The command line as a `config`; what is wrong with it becomes one line, with status 2.

    Raises:
        SystemExit: After ``--help`` (0), or a command line that cannot be read (2).
    """
    import tyro

    one_way = (tyro.conf.FlagCreatePairsOff,)  # --force, no --no-force
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(config, prog=prog, description=description, args=arguments, config=one_way)
    except SystemExit as stop:
        if stop.code:
            _complain(prog, f"{usage_error(box.getvalue())} Run {prog} --help")
        raise


def usage_error(box: str) -> str:
    """What tyro's box of several lines says, in one.

    Examples: ``unknown option --enb, did you mean --env?``, ``--steps cannot be 'x'.``
    """
    text = " ".join(re.sub(r"[─│╭╮╰╯]+|-{4,}|(?<!\S)[|+](?!\S)", " ", box).split())  # drawn in ASCII where it must be
    text = re.split(r" For full helptext| Argument helptext", text)[0]
    if match := re.search(r"Unrecognized options: (.*?)(?: Perhaps you meant: .*?(--[\w-]+).*)?$", text):
        return f"unknown option {match[1].split(',')[0]}{f', did you mean {match[2]}?' if match[2] else '.'}"
    if match := re.search(r"Error parsing (\S+?):? .*(?:from \[|: )('.*?')", text):
        return f"{match[1]} cannot be {match[2]}."
    if match := re.search(r"Missing value for argument '(\S+)'", text):
        return f"{match[1]} needs a value." if match[1].startswith("--") else f"{match[1].upper()} is missing."
    if match := re.search(r"Missing from \S+: (\S+)", text):
        return f"{match[1]} is missing."
    return f"{text}."


def guarded(main: Callable[[], int | None], prog: str) -> int:
    """Run `main`; what is expected to go wrong becomes one line on standard error and a status other than 0."""
    try:
        with _terminable():
            return main() or 0
    except Terminated as stop:
        _complain(prog, f"ended by {stop.signal.name}")
        return 128 + stop.signal
    except KeyboardInterrupt as stop:
        _complain(prog, str(stop) or "interrupted")
        return INTERRUPTED
    except BrokenPipeError:  # somebody closed our standard output, such as head
        _silence(sys.stdout)
        return 1
    except ModuleNotFoundError as error:
        _complain(prog, missing_extra(error))
        return 1
    except MemoryError as error:
        _complain(prog, f"not enough memory: {error}" if str(error) else "not enough memory")
        return 1
    except OSError as error:
        if error.errno != errno.ENOSPC or is_expected(error):
            return _expected(prog, error)
        _silence(sys.stdout)
        _complain(prog, "standard output cannot be written: no space left on its device")
        return 1
    except Exception as error:
        return _expected(prog, error)


def _expected(prog: str, error: Exception) -> int:
    """One line for an error of our own; any other is raised again."""
    if not is_expected(error):
        raise error
    _complain(prog, str(error))
    return 1


class Terminated(KeyboardInterrupt):
    """A signal other than Ctrl-C asked for the end; Ray, waiting in C++, hears of no other kind of exception.

    Attributes:
        signal: Which.
    """

    def __init__(self, number: int) -> None:
        self.signal = signal.Signals(number)
        super().__init__(self.signal)  # what it is made from, so that it can be copied


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Within this, SIGTERM and SIGHUP raise `Terminated`, so that what is open is closed; in the main thread only.

    One that comes again at once is the same one: it does not interrupt the closing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    first, came = -math.inf, 0

    def stop(number: int, _: FrameType | None) -> None:
        nonlocal first, came
        if time.monotonic() < first + TOGETHER:
            return
        first, came = time.monotonic(), number
        raise Terminated(number)

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]  # not on Windows
    heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]  # nohup ignores SIGHUP
    before = [(number, signal.signal(number, stop)) for number in heard]
    try:
        yield
    except KeyboardInterrupt as error:
        if came and not isinstance(error, Terminated):  # Ray raises one of its own instead
            raise Terminated(came) from None
        raise
    finally:
        for number, handler in before:
            signal.signal(number, handler)


def _silence(stream: TextIO) -> None:
    """Let what is still to be written to `stream` go nowhere, or Python complains about it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def is_expected(error: Exception) -> bool:
    """Whether an error is of our own two trees, whose text says what to do."""
    from bam_envs.core.errors import BamEnvsError
    from bam_train.errors import BamTrainError

    return isinstance(error, (BamTrainError, BamEnvsError))


def missing_extra(error: ModuleNotFoundError) -> str:
    """The line for a missing package: which command installs it.

    Raises:
        ModuleNotFoundError: It is none of ours.
    """
    package = (error.name or "").partition(".")[0]
    if package not in EXTRAS:
        raise error
    return f'needs {package}, which is not installed. Run: pip install "bam-train[{EXTRAS[package]}]"'


def _complain(prog: str, text: str) -> None:
    line = " ".join(text.split())
    say(f"{prog}: {line if len(line) <= LONGEST else f'{line[:LONGEST]} ... ({len(line)} characters)'}")
