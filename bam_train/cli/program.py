"""What every program shares: flags out of a frozen dataclass, every expected failure one line and a status.

Only the standard library is imported before signals are handled, and only tyro before the flags are parsed, so that
Ctrl-C is one line at any moment and ``--help`` is quick.
"""

import argparse
import ast
import atexit
import contextlib
import errno
import gc
import inspect
import io
import itertools
import os
import pkgutil
import re
import signal
import sys
import textwrap
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from bam_train.cli.console import drop, say, show_logs_and_tracebacks, tell
from bam_train.files.place import standing_in
from bam_train.signals import SignalMemory, Terminated

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
    "optuna": "sweep",
    "mujoco": "sim",
    "PIL": "video",
    "imageio": "video",
    "mujoco_menagerie": "robots",
    "trimesh": "robots",
    "xacrodoc": "robots",
    "wandb": "wandb",
    "mlflow": "mlflow",
    "sqlalchemy": "mlflow",
    "trackio": "trackio",
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


@dataclass(frozen=True)
class Command:
    """One command of a program that has several."""

    help: str
    flags: str
    """Its configuration, ``"module:Class"``."""
    run: str
    """Takes the configuration and returns an exit status, ``"module:function"``; imported once the flags are read."""


def run_commands(prog: str, what: str, commands: Mapping[str, Command], arguments: list[str] | None = None) -> None:
    """Run the command that the first argument names, with the others as its flags; `what` is the text of the help."""
    given = sys.argv[1:] if arguments is None else arguments
    name = given[0] if given else ""
    if name in ("-h", "--help"):
        tell(f"usage: {prog} COMMAND [OPTIONS]", "", what, "")
        tell(*(f"  {command:<10}{row.help}" for command, row in commands.items()))
        tell("", f"{prog} COMMAND --help shows the options of one.")
        raise SystemExit(0)
    if name not in commands:
        from bam_envs.core.wording import closest

        close = closest(name, commands)
        error = "COMMAND is missing" if not name else f"there is no command {name!r}"
        choice = f", did you mean {close!r}?" if close else f"; there are {', '.join(commands)}."
        say(f"{prog}: {error}{choice} Run {prog} --help")
        raise SystemExit(2)
    command = commands[name]
    run_program(f"{prog} {name}", command.flags, lambda config, _: pkgutil.resolve_name(command.run)(config), given[1:])


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
                where = error.filename or "standard output, or a file that it writes,"
                _complain(prog, f"{where} cannot be written: no space left on its device. Free some, or choose another")
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
    import tyro

    given = sys.argv[1:] if arguments is None else arguments
    if {"-h", "--help"} & {*given}:
        description = inspect.cleandoc(description or config.__doc__ or "")
        tell(*help_text(config, prog, description).rstrip().split("\n"))
        raise SystemExit(0)
    remedy = f"Run {prog if description is None else f'python {sys.argv[0]}'} --help"
    no_pairs = (tyro.conf.FlagCreatePairsOff,)  # --force, no --no-force
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box), contextlib.redirect_stdout(box):  # to a terminal tyro writes colours
            parsed = tyro.cli(config, prog=prog, args=given, config=no_pairs)
    except SystemExit as stop:
        _complain(prog, f"{usage_error(box.getvalue(), config)} {remedy}")
        raise SystemExit(2) from stop
    from bam_envs.core.errors import InvalidValue
    from bam_envs.core.validation import check_fields
    from bam_envs.core.wording import as_flag

    try:
        check_fields(parsed, as_flag)
    except InvalidValue as error:
        _complain(prog, f"{error}. {remedy}")
        raise SystemExit(2) from error
    arm = getattr(parsed, "robot_model", None)
    if arm is not None and hasattr(parsed, "set"):  # one flag more for one argument of the environment
        flagged: Any = parsed
        return replace(flagged, set=(f"{flagged.SET}={arm}", *flagged.set))  # type: ignore[no-any-return]
    return parsed


def usage_error(box: str, config: type[Any]) -> str:
    """What tyro's box of several lines says, in one.

    Examples: ``unknown option --enb, did you mean --env?``, ``--steps: expected a whole number, found 'x'.``
    """
    from bam_envs.core.validation import expected, type_hints
    from bam_envs.core.wording import closest

    text = " ".join(re.sub(r"[─│╭╮╰╯]+|-{4,}|(?<!\S)[|+](?!\S)", " ", box).split())  # drawn in ASCII where it must be
    text = re.split(r" For full helptext| Argument helptext", text)[0]
    hints = type_hints(config)
    if match := re.search(r"Unrecognized options: ([^\s,]+)", text):
        if not match[1].startswith("-"):
            return f"unexpected argument {match[1]}."
        flags = [_flag(name, hint) for name, hint in hints.items() if not (is_positional(hint) or is_hidden(hint))]
        flags, instead = [*flags, "--help"], getattr(config, "INSTEAD", {})
        name = match[1].partition("=")[0].replace("_", "-")
        if name in instead:
            return f"{match[1]} is no option: {instead[name]}."
        close = closest(name, flags)
        choice = f"; there are {' and '.join(flags)}." if len(flags) < 3 else f"{instead.get('', '')}."
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
        close = closest(found, names)
        end = f", did you mean {close}?" if close else "."
        return f"{flag}: expected {', '.join(names[:-1])} or {names[-1]}, found {found!r}{end}"
    if match := re.search(r"Missing value for argument '(\S+)'", text):
        kind = hints.get(match[1].lstrip("-").replace("-", "_"))
        wanted = "" if kind is None else f": {expected(kind)}"
        return f"{match[1]} needs a value{wanted}." if match[1].startswith("--") else f"{match[1].upper()} is missing."
    if match := re.search(r"Missing from [^:]*: (.*)", text):
        *rest, last = [part.split()[0] for part in match[1].split("(required)") if part.strip()]
        return f"{', '.join(rest)} and {last} are missing." if rest else f"{last} is missing."
    return f"{text}."


# The help

_METAVARS: dict[Any, str] = {int: "N", float: "X", Path: "FILE", str: "TEXT"}


class _Paragraphs(argparse.HelpFormatter):
    """Fills paragraphs, without breaking flags, and keeps the lines of those with indented lines, such as examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        parts = text.split("\n\n")
        return "\n\n".join(one if "\n " in one else "\n".join(self._split_lines(one, width)) for one in parts)

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False)


def help_text(config: type[Any], prog: str, description: str) -> str:
    """The help of a program.

    Args:
        config: A frozen dataclass; one field is one flag. ``GROUPS``, if it has one, gives the titles of its groups of
            flags, and their fields.
        prog: The program's name.
        description: What it does, with examples.
    """
    hints, docs = get_type_hints(config, include_extras=True), field_docs(config)
    known = {field.name: field for field in fields(config) if not is_hidden(hints[field.name])}
    first = [name for name in known if is_positional(hints[name])]
    groups = getattr(config, "GROUPS", {})
    own_first = dict.fromkeys(name for owner in config.__mro__ for name in inspect.get_annotations(owner))
    rest = [name for name in own_first if name in known.keys() - {*first, *itertools.chain(*groups.values())}]
    usage = " ".join([prog, *(_metavar(hints[name]) for name in first), "[OPTIONS]"])
    parser = argparse.ArgumentParser(
        prog, usage, description, formatter_class=lambda prog: _Paragraphs(prog, max_help_position=26), add_help=False
    )
    for title, names in {"Arguments": first, **groups, "Other options" if groups else "Options": rest}.items():
        group = parser.add_argument_group(title)
        for name in names:
            text = f"{docs[name]}{_default(known[name], docs[name])}".replace("%", "%%")
            if name in first:
                group.add_argument(name, metavar=_metavar(hints[name]), help=text)
                continue
            value: dict[str, Any] = {"action": "store_true"}
            if hints[name] is not bool:
                value = {"metavar": _metavar(hints[name])}
            group.add_argument(_flag(name, hints[name]), help=text, **value)
    group.add_argument("-h", "--help", action="store_true", help="Show this text.")
    return parser.format_help()


def field_docs(kind: type) -> dict[str, str]:
    """The string below each field of a dataclass or member of an enum, inherited ones too."""
    docs = {}
    for owner in reversed(kind.__mro__[:-1]):
        with contextlib.suppress(OSError):  # made without a source
            body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0].body  # type: ignore[attr-defined]
            for field, text in itertools.pairwise(body):
                if isinstance(field, (ast.AnnAssign, ast.Assign)) and isinstance(text, ast.Expr):
                    target = field.target if isinstance(field, ast.AnnAssign) else field.targets[0]
                    docs[ast.unparse(target)] = str(ast.literal_eval(text.value))
    return docs


def is_positional(hint: Any) -> bool:
    """Whether a field is given without a flag."""
    import tyro

    return get_args(tyro.conf.Positional[str])[1] in get_args(hint)


def is_hidden(hint: Any) -> bool:
    """Whether a field has no flag."""
    import tyro

    return tyro.conf.Suppress in get_args(hint)


def _flag(name: str, hint: Any) -> str:
    """The flag of a field: its name, or the one in its hint."""
    given: list[str] = [one.name for one in get_args(hint)[1:] if getattr(one, "metavar", None) and one.name]
    return "--" + (given or [name])[-1].replace("_", "-")


def _metavar(hint: Any) -> str:
    """The word for the value of a field."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        named = [one.metavar for one in arguments[1:] if getattr(one, "metavar", None)]
        return str(named[-1]) if named else _metavar(arguments[0])
    if origin is Literal:
        return "|".join(map(str, arguments))
    if origin in (Union, types.UnionType, tuple):
        return _metavar(arguments[0])
    return _METAVARS[hint]


def _default(field: Field[Any], text: str) -> str:
    """The default of a field, unless it says nothing or is in the field's own `text`."""
    value = field.default
    is_empty = value is MISSING or value is None or value is False or value in ((), "")
    return "" if is_empty or "default" in text else f" (default: {value})"
