"""What every program shares: flags out of a frozen dataclass, every expected failure one line and a status.

Only the standard library is imported before signals are handled, and only tyro before the flags are parsed, so that
Ctrl-C is one line at any moment and ``--help`` is quick.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass
from typing import Any, TextIO, TypeVar, get_args

from bam_train.cli.console import say, show_logs_and_tracebacks
from bam_train.signals import SIGNALS, SignalMemory, Terminated

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

LONGEST = 2000
"""Characters of an error line; a file or a server may bring a name of millions."""

INTERRUPTED = 130
"""Exit status of a program that Ctrl-C ended (128 + SIGINT)."""


def run_program(main: Callable[[], int | None], prog: str) -> None:
    """Run `main`, which returns an exit status (None for 0), and exit with it.

    Args:
        main: The program; it parses its own command line.
        prog: The program's name, as it starts each error line.

    Raises:
        SystemExit: Always.
    """
    sys.path.append(os.getcwd())  # --env my_module:Env-v0, as with python -m; last, so that it hides nothing
    show_logs_and_tracebacks()
    sys.exit(guarded(main, prog))


def parse(config: type[Config], prog: str, arguments: Sequence[str] | None = None) -> Config:
    """The command line as a `config`; what is wrong with it becomes one line, with status 2.

    Args:
        config: A frozen dataclass; one field is one flag, its docstring the description.
        prog: The program's name.
        arguments: Instead of those of the process.

    Raises:
        SystemExit: After ``--help`` (0), or a command line that cannot be read (2).
        SettingsError: A value is outside the range of its field.
    """
    import tyro

    no_pairs = (tyro.conf.FlagCreatePairsOff,)  # --force, no --no-force
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            parsed = tyro.cli(config, prog=prog, description=config.__doc__, args=arguments, config=no_pairs)
    except SystemExit as stop:
        if stop.code:
            _complain(prog, f"{usage_error(box.getvalue(), config)} Run {prog} --help")
        raise
    from bam_envs.core.validation import check_fields
    from bam_envs.core.wording import as_flag
    from bam_train.errors import SettingsError

    check_fields(parsed, as_flag, SettingsError)
    return parsed


def usage_error(box: str, config: type[Any]) -> str:
    """What tyro's box of several lines says, in one.

    Examples: ``unknown option --enb, did you mean --env?``, ``--steps: expected a whole number, found 'x'.``
    """
    text = " ".join(re.sub(r"[─│╭╮╰╯]+|-{4,}|(?<!\S)[|+](?!\S)", " ", box).split())  # drawn in ASCII where it must be
    text = re.split(r" For full helptext| Argument helptext", text)[0]
    if match := re.search(r"Unrecognized options: (.*?)(?: Perhaps you meant: .*?(--[\w-]+).*)?$", text):
        return f"unknown option {match[1].split(',')[0]}{f', did you mean {match[2]}?' if match[2] else '.'}"
    if match := re.search(r"Error parsing (\S+?):? .*(?:from \[|: )'(.*?)'", text):
        return _wrong_value(match[1], match[2], config)
    if match := re.search(r"Missing value for argument '(\S+)'", text):
        return f"{match[1]} needs a value." if match[1].startswith("--") else f"{match[1].upper()} is missing."
    if match := re.search(r"Missing from \S+: (\S+)", text):
        return f"{match[1]} is missing."
    return f"{text}."


def _wrong_value(flag: str, found: str, config: type[Any]) -> str:
    from bam_envs.core.validation import expected

    kind = _type_of(flag.lstrip("-").replace("-", "_"), config)
    if kind is None:
        return f"{flag} cannot be {found!r}."
    wanted = expected(kind)
    with contextlib.suppress(ValueError):
        if "whole number" in wanted and float(found).is_integer():  # 1e5
            return f"{flag}: expected {wanted}, found {found!r}; write {float(found):.0f}."
    return f"{flag}: expected {wanted}, found {found!r}."


def _type_of(field: str, config: type[Any]) -> Any:
    """The annotation of a field of `config` or of a dataclass in it; None if there is no such field."""
    from bam_envs.core.validation import type_hints

    hints = type_hints(config)
    inner = [
        part for hint in hints.values() for part in get_args(hint)[:1] if isinstance(part, type) and is_dataclass(part)
    ]
    return hints.get(field) or next((kind for part in inner if (kind := _type_of(field, part))), None)


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


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Within this, SIGTERM and SIGHUP raise `Terminated`, so that what is open is closed."""
    with SignalMemory([number for number in SIGNALS if number != signal.SIGINT]) as signals:
        try:
            yield
        except KeyboardInterrupt as error:
            if not isinstance(error, Terminated):  # Ray raises one of its own instead
                signals.raise_again()
            raise


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
