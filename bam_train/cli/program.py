"""What every program shares: flags out of a frozen dataclass, every expected failure one line and a status.

Only the standard library is imported before signals are handled, and only tyro before the flags are parsed, so that
Ctrl-C is one line at any moment and ``--help`` is quick.
"""

import atexit
import contextlib
import errno
import gc
import io
import os
import pkgutil
import re
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, get_args

from bam_train.cli.console import drop, say, show_logs_and_tracebacks
from bam_train.signals import SignalMemory, Terminated
from bam_train.stand_ins import standing_in

Config = TypeVar("Config")

EXTRAS = {
    "torch": "train",
    "stable_baselines3": "train",
    "sb3_contrib": "train",
    "ray": "rllib",
    "pyarrow": "data",
    "minari": "data",
    "h5py": "data",
    "d3rlpy": "offline",
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


def run_program(
    prog: str, flags: str, main: Callable[[Any, SignalMemory], int | None], arguments: Sequence[str] | None = None
) -> None:
    """Read the command line, run a program and exit with its status.

    Args:
        prog: The program's name, as it starts each error line.
        flags: Its configuration, ``"module:Class"``; imported once signals are handled.
        main: Takes the configuration and the signals that have come; returns an exit status (None for 0).
        arguments: Instead of those of the process.
    """
    sys.path.append(os.getcwd())  # --env my_module:Env-v0, as with python -m; last, so that it hides nothing
    show_logs_and_tracebacks()
    atexit.register(gc.freeze)  # Python's last collection of garbage takes seconds after torch was imported
    signals = SignalMemory()

    def run() -> int | None:
        with standing_in(parse(pkgutil.resolve_name(flags), prog, arguments)) as config:
            return main(config, signals)

    sys.exit(guarded(run, prog, signals))


def guarded(main: Callable[[], int | None], prog: str, signals: SignalMemory | None = None) -> int:
    """Run `main`; what is expected to go wrong becomes one line on standard error and a status other than 0."""
    try:
        with signals or SignalMemory() as signals:
            try:
                status = main() or 0
                if not status:
                    signals.raise_again()  # of which Python discarded the exception
                return status
            except KeyboardInterrupt as error:
                if not isinstance(error, Terminated) and signals.came[:1] != [signal.SIGINT]:
                    signals.raise_again()  # of SIGTERM, of which Ray raises a plain KeyboardInterrupt
                raise
            except Exception as error:
                cause: BaseException | None = error
                while cause is not None and not isinstance(cause, ImportError):
                    cause = cause.__cause__ or cause.__context__
                if cause is not None:
                    signals.raise_again()  # an extension that is interrupted while it is imported raises ImportError
                raise
    except Terminated as stop:
        _complain(prog, f"ended by {stop.signal.name}")
        return 128 + stop.signal
    except KeyboardInterrupt as stop:
        _complain(prog, str(stop) or "interrupted")
        return 128 + signal.SIGINT
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        _complain(prog, f'needs {package}, which is not installed. Run: pip install "bam-train[{EXTRAS[package]}]"')
    except MemoryError as error:
        _complain(prog, f"not enough memory: {error}" if str(error) else "not enough memory")
    except Exception as error:
        from bam_envs.core.errors import BamEnvsError
        from bam_train.errors import BamTrainError

        if isinstance(error, (BamTrainError, BamEnvsError)):
            _complain(prog, str(error))
            return getattr(error, "exit_status", 1)
        if isinstance(error, BrokenPipeError) or (isinstance(error, OSError) and error.errno == errno.ENOSPC):
            # Standard output is closed, as by head, or full; Python would complain about what its buffer still holds.
            drop(sys.stdout)
            if error.errno == errno.ENOSPC:
                _complain(prog, "standard output cannot be written: no space left on its device")
        else:
            raise
    return 1


def _complain(prog: str, text: str) -> None:
    line = " ".join(text.split())
    say(f"{prog}: {line if len(line) <= LONGEST else f'{line[:LONGEST]} ... ({len(line)} characters)'}")


def parse(
    config: type[Config], prog: str, arguments: Sequence[str] | None = None, description: str | None = None
) -> Config:
    """The command line as a `config`; what is wrong with it becomes one line, with status 2.

    Args:
        config: A frozen dataclass; one field is one flag.
        prog: The program's name.
        arguments: Instead of those of the process.
        description: The docstring of a script; of a program it is that of `config`.
    """
    from inspect import cleandoc

    import tyro

    remedy = f"Run {prog if description is None else f'python {sys.argv[0]}'} --help"
    no_pairs = (tyro.conf.FlagCreatePairsOff,)  # --force, no --no-force
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            parsed = tyro.cli(
                config,
                prog=prog,
                description=description or cleandoc(config.__doc__ or ""),
                args=arguments,
                config=no_pairs,
            )
    except SystemExit as stop:
        if stop.code:
            _complain(prog, f"{usage_error(box.getvalue(), config)} {remedy}")
        raise
    from bam_envs.core.errors import InvalidValue
    from bam_envs.core.validation import check_fields
    from bam_envs.core.wording import as_flag

    try:
        check_fields(parsed, as_flag)
    except InvalidValue as error:
        _complain(prog, f"{error}. {remedy}")
        raise SystemExit(2) from error
    return parsed


def usage_error(box: str, config: type[Any]) -> str:
    """What tyro's box of several lines says, in one.

    Examples: ``unknown option --enb, did you mean --env?``, ``--steps: expected a whole number, found 'x'.``
    """
    import tyro

    from bam_envs.core.validation import expected, type_hints
    from bam_envs.core.wording import as_flag, closest

    text = " ".join(re.sub(r"[─│╭╮╰╯]+|-{4,}|(?<!\S)[|+](?!\S)", " ", box).split())  # drawn in ASCII where it must be
    text = re.split(r" For full helptext| Argument helptext", text)[0]
    hints, (_, positional) = type_hints(config), get_args(tyro.conf.Positional[str])
    if match := re.search(r"Unrecognized options: ([^\s,]+)", text):
        if not match[1].startswith("-"):
            return f"unexpected argument {match[1]}."
        named = [name for name, hint in hints.items() if positional not in get_args(hint)]
        flags = [*map(as_flag, named), "--help"]
        close = closest(match[1].partition("=")[0], flags)
        choice = f"; there are {' and '.join(flags)}." if len(flags) < 3 else "."
        return f"unknown option {match[1]}{f', did you mean {close}?' if close else choice}"
    if match := re.search(r"Error parsing (\S+?):? .*(?:from \[|: )'(.*?)'", text):
        flag, found = match.groups()
        kind = hints.get(flag.lstrip("-").replace("-", "_"))
        if kind is None:
            return f"{flag} cannot be {found!r}."
        wanted, remedy = expected(kind), "."
        with contextlib.suppress(ValueError):
            if "whole number" in wanted and float(found).is_integer():  # 1e5
                remedy = f"; write {float(found):.0f}."
        return f"{flag}: expected {wanted}, found {found!r}{remedy}"
    if match := re.search(r"invalid choice '(.*?)' for argument '(\S+)'\. Expected one of \((.*?)\)", text):
        found, flag, choices = match.groups()
        names = sorted({*re.findall(r"'(.*?)'", choices)} - {"None"})  # tyro does not keep their order
        return f"{flag}: expected {', '.join(names[:-1])} or {names[-1]}, found {found!r}."
    if match := re.search(r"Missing value for argument '(\S+)'", text):
        return f"{match[1]} needs a value." if match[1].startswith("--") else f"{match[1].upper()} is missing."
    if match := re.search(r"Missing from \S+: (\S+)", text):
        return f"{match[1]} is missing."
    return f"{text}."
