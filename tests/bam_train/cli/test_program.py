"""What every program shares."""

from __future__ import annotations

import errno
import logging
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from bam_envs.core.errors import MissingExtra, UnknownName
from bam_train.cli import console, deploy, envs, serve, train
from bam_train.cli.console import count, duration, number, percent, rich_text, shown
from bam_train.cli.data import bam_data
from bam_train.cli.program import guarded, run_program, usage_error
from bam_train.errors import OutputError, SettingsError


@dataclass(frozen=True)
class Flags:
    """Does things.
    These are many, so that the text is longer than a line.

    Examples:
      prog --steps 5 --force
    """

    steps: int = 3
    """How many."""
    force: bool = False
    """Whether."""


def ended(arguments, main=lambda flags: 0):
    with pytest.raises(SystemExit) as caught:
        run_program("prog", f"{__name__}:Flags", lambda flags, _: main(flags), arguments)
    return caught.value.code


def python(code, **options):
    """A process of its own that imports what this one does."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, env=environment, **options)


def test_flags_reach_the_program_and_its_status_the_shell():
    seen = []
    assert ended(["--steps", "5", "--force"], lambda flags: seen.append(flags) or 7) == 7
    assert seen == [Flags(5, True)]
    assert ended([], lambda flags: None) == 0


def test_help(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    assert ended(["--steps", "5", "--help"]) == 0
    assert (
        capsys.readouterr().out
        == """\
usage: prog [OPTIONS]

Does things. These are many, so that the text is longer
than a line.

Examples:
  prog --steps 5 --force

Options:
  --steps N   How many. (default: 3)
  --force     Whether.
  -h, --help  Show this text.
"""
    )


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--stps", "5"], "prog: unknown option --stps, did you mean --steps? Run prog --help\n"),
        (["--qqq"], "prog: unknown option --qqq. Run prog --help\n"),
        (["--steps", "many"], "prog: --steps: expected a whole number, found 'many'. Run prog --help\n"),
        (["--steps", "1e5"], "prog: --steps: expected a whole number, found '1e5'; write 100000. Run prog --help\n"),
        (["--steps"], "prog: --steps needs a value: a whole number. Run prog --help\n"),
        (["stray"], "prog: unexpected argument stray. Run prog --help\n"),
    ],
)
def test_a_command_line_that_cannot_be_read_is_one_line(arguments, line, capsys, monkeypatch):
    """Also in a terminal, where the box of several lines would have colours."""
    monkeypatch.setenv("TERM", "xterm")
    for is_terminal in (False, True):
        monkeypatch.setattr(sys.stdout, "isatty", lambda is_terminal=is_terminal: is_terminal)
        assert ended(arguments) == 2
        assert capsys.readouterr().err == line


@pytest.mark.parametrize(
    ("error", "line", "status"),
    [
        (OutputError("a.zip: cannot be written"), "prog: a.zip: cannot be written\n", 1),
        (UnknownName("environment", "pik", ["pick"]), "prog: Unknown environment 'pik'. Did you mean 'pick'?\n", 1),
        (
            MissingExtra("mujoco", "sim", "The simulated robot"),
            'prog: The simulated robot needs mujoco, which is not installed. Run: pip install "bam-train[sim]"\n',
            1,
        ),
        (
            ModuleNotFoundError("No module named 'torch'", name="torch"),
            'prog: needs torch, which is not installed. Run: pip install "bam-train[train]"\n',
            1,
        ),
        (
            ModuleNotFoundError("No module named 'mujoco.rollout'", name="mujoco.rollout"),
            'prog: needs mujoco, which is not installed. Run: pip install "bam-train[sim]"\n',
            1,
        ),
        (KeyboardInterrupt(), "prog: interrupted\n", 130),
        (KeyboardInterrupt("quit at once"), "prog: quit at once\n", 130),
        (OutputError("two\nlines"), "prog: two lines\n", 1),
        (
            OSError(errno.ENOSPC, "No space left on device", "data/pick/info.json"),
            "prog: data/pick/info.json cannot be written: no space left on its device. Free some, or choose another\n",
            1,
        ),
        (MemoryError("4 EiB"), "prog: not enough memory: 4 EiB\n", 1),
        (SettingsError("\x1b[2J\u202egnp"), "prog: \\x1b[2J\\u202egnp\n", 1),
        (SettingsError("x" * 1_000_000), f"prog: {'x' * 2000} ... (1000000 characters)\n", 1),
    ],
)
def test_what_is_expected_to_go_wrong_is_one_line(capsys, error, line, status):
    def fail():
        raise error

    assert guarded(fail, "prog") == status
    assert capsys.readouterr() == ("", line)


@pytest.mark.parametrize("error", [ValueError("a bug"), ModuleNotFoundError("No module named 'x'", name="x")])
def test_a_bug_keeps_its_traceback(error):
    def fail():
        raise error

    with pytest.raises(type(error)):
        guarded(fail, "prog")


def test_a_reader_that_went_away_is_no_error():
    code = """
import sys
from bam_train.cli.program import guarded
def main():
    for _ in range(100000): print('x' * 80)
sys.exit(guarded(main, 'prog'))
"""
    with python(code, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 1


def test_the_end_waits_for_no_last_collection_of_garbage():
    """Of torch's objects it takes seconds; this one says so if it is collected."""
    code = """
import os
from bam_train.cli import envs
class Cycle:
    def __init__(self):
        self.itself, self.say = self, os.write
    def __del__(self):
        self.say(2, b'collected')
cycle = Cycle()
envs.main(['bam/reach', '--json'])
"""
    with python(code, stdout=subprocess.DEVNULL) as run:
        assert run.stderr.read() == ""
    assert run.returncode == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_device_behind_standard_output_is_one_line():
    with (
        Path("/dev/full").open("w") as full,
        python("from bam_train.cli.envs import main; main([])", stdout=full) as run,
    ):
        remedy = "Free some, or choose another"
        what = "standard output, or a file that it writes, cannot be written"
        assert run.stderr.read() == f"bam-envs: {what}: no space left on its device. {remedy}\n"
    assert run.returncode == 1


def test_help_imports_nothing_heavy():
    """Neither NumPy nor Gymnasium: it takes 0.3 s of CPU time at most."""
    code = """
import sys
from bam_train.cli import deploy, envs, eval, export, serve, train
from bam_train.cli.play import run_play
for program in (deploy, envs, eval, export, run_play, serve, train):
    try: program.main(['--help'])
    except SystemExit: pass
print(*{'torch', 'stable_baselines3', 'gymnasium', 'mujoco', 'numpy', 'rich'} & set(sys.modules), file=sys.stderr)
"""
    with python(code, stdout=subprocess.DEVNULL) as process:
        assert process.stderr.read() == "\n"


def test_ctrl_c_while_flags_are_imported_is_one_line():
    """So nothing slow is imported before signals are handled."""
    code = """
import signal, sys
from bam_train.cli import deploy, envs, eval, export, serve, train
class Interrupted:
    def find_spec(self, name, *_):
        if name == 'tyro': signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupted())
for program in (deploy, envs, eval, export, serve, train):
    try: program.main(['--help'])
    except SystemExit as end: print(end.code)
"""
    with python(code, stdout=subprocess.PIPE) as process:
        out, err = process.communicate()
    assert out == "130\n" * 6
    names = ("deploy", "envs", "eval", "export", "serve", "train")
    assert err == "".join(f"bam-{name}: interrupted\n" for name in names)


@pytest.mark.parametrize(
    ("write", "value", "text"),
    [
        (count, 950, "950"),
        (count, 9_999, "9999"),
        (count, 12_345, "12.35k"),
        (count, 1_250_000, "1.25M"),
        (duration, None, "-"),
        (duration, float("inf"), "-"),
        (duration, 4.21, "4.2 s"),
        (duration, 65, "1 min 05 s"),
        (duration, 3599.8, "1 h 00 min"),
        (percent, None, "-"),
        (percent, 1.0, "100 %"),
        (percent, 0.985, "98.5 %"),
        (number, None, "-"),
        (number, 1234.56, "1235"),
    ],
)
def test_numbers_to_read(write, value, text):
    assert write(value) == text


def test_a_signal_that_comes_twice_at_once_does_not_interrupt_the_closing(capsys):
    closed = []

    def main(flags):
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGTERM)  # timeout: to the process, and then to its group
            closed.append(True)

    assert ended([], main) == 143
    assert closed == [True]
    assert capsys.readouterr().err == "prog: ended by SIGTERM\n"


def test_a_signal_that_ray_makes_a_ctrl_c_of_is_still_what_it_was(capsys):
    def main(flags):
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:  # it waits in C++, and tells this kind alone
            raise KeyboardInterrupt from None

    assert ended([], main) == 143
    assert capsys.readouterr().err == "prog: ended by SIGTERM\n"


@pytest.mark.parametrize(
    "error", [ImportError("initialization failed"), MissingExtra("mujoco", "sim", "A simulated robot")]
)
def test_an_import_that_ctrl_c_broke_is_an_interruption(error, capsys):
    def main():
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise error from None

    assert guarded(main, "prog") == 130
    assert capsys.readouterr().err == "prog: interrupted\n"


def test_what_goes_wrong_after_ctrl_c_is_reported(capsys):
    def main():
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise SettingsError("The robot could not be halted.") from None

    assert guarded(main, "prog") == 1
    assert capsys.readouterr().err == "prog: The robot could not be halted.\n"


OUT_OF_RANGE = [
    (deploy, ["a.zip", "--episodes", "-1"], "--episodes: expected a whole number of at least 1, found -1"),
    (deploy, ["a.zip", "--seed", "-1"], "--seed: expected a whole number of at least 0, found -1"),
    (deploy, ["a.zip", "--rate", "nan"], "--rate: expected a number above 0, found nan"),
    (deploy, ["a.zip", "--timeout", "0"], "--timeout: expected a number above 0, found 0.0"),
    (serve, ["--num-envs", "0"], "--num-envs: expected a whole number of at least 1, found 0"),
    (serve, ["--port", "99999"], "--port: expected a whole number from 0 to 65535, found 99999"),
    (serve, ["--port", "abc"], "--port: expected a whole number from 0 to 65535, found 'abc'"),
    (train, ["--steps", "0"], "--steps: expected a whole number from 1 to 1000000000000000, found 0"),
    (envs, ["--lst"], "unknown option --lst"),
    (deploy, ["x.zip", "--stage", "slow"], "--stage: expected full or trial, found 'slow'"),
    (envs, ["a", "b"], "unexpected argument b"),
    (train, ["--normalize"], "--normalize is no option: give --set normalize=true"),
    (train, ["--env_kwargs", "x"], "--env_kwargs is no option: give --set env_kwargs.NAME=VALUE"),
    (train, ["--lr", "1"], "unknown option --lr; an argument of the algorithm is --set NAME=VALUE"),
]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["export"], "export: PLACE, --to and --out are missing. Run bam-data export"),
        (["split", "d", "--out=a"], "split: --rest is missing. Run bam-data split"),
        (["collect", "d"], "collect: --policy is missing. Run bam-data collect"),
        (["merge", "--out=a"], "merge: PLACE is missing. Run bam-data merge"),
        (["import", "d"], "import: RECORDING is missing. Run bam-data import"),
    ],
)
def test_missing_options_are_named(run, arguments, text):
    assert run(bam_data.main, *arguments) == (2, "", f"bam-data {text} --help\n")


@pytest.mark.parametrize(("program", "arguments", "text"), OUT_OF_RANGE)
def test_a_flag_that_cannot_be_has_one_status(run, program, arguments, text):
    name = f"bam-{program.__name__.rpartition('.')[2]}"
    assert run(program.main, *arguments) == (2, "", f"{name}: {text}. Run {name} --help\n")


def test_the_box_of_a_terminal_without_unicode_is_one_line_too():
    lines = ["+- Unrecognized options ---+", "| Unrecognized options: --qqq |", "| -------- |", "| For full helptext |"]
    box = "\n".join([*lines, "+------+"])
    assert usage_error(box, Flags) == "unknown option --qqq."


STRANGE = "\x1b]0;title\x07\x1b[2J\x9b31m\x7f\r\n\u202egnp\u2028\ud800 é µ"
SHOWN = r"\x1b]0;title\x07\x1b[2J\x9b31m\x7f\r\n\u202egnp\u2028\ud800 é µ"


def test_what_acts_on_a_terminal_is_shown(capsys, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    assert shown(STRANGE) == SHOWN
    console.say(STRANGE)
    console.tell(STRANGE, "next")
    console.make_console().print(rich_text(f"[red]{STRANGE}[/red] :smile:"), soft_wrap=True)
    assert capsys.readouterr() == (f"{SHOWN}\nnext\n", f"{SHOWN}\n[red]{SHOWN}[/red] :smile:\n")


def test_logs_and_tracebacks_are_shown(capsys, monkeypatch):
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    monkeypatch.setattr(logging, "lastResort", logging.StreamHandler())
    console.show_logs_and_tracebacks()
    record = logging.LogRecord("a", logging.WARNING, "", 1, "%s", (STRANGE,), None)
    assert logging.lastResort.format(record) == SHOWN
    try:
        raise RuntimeError("\x1b[2J")
    except RuntimeError as error:
        sys.excepthook(type(error), error, error.__traceback__)
        record = logging.LogRecord("a", logging.WARNING, "", 1, "failed", (), sys.exc_info())
    assert capsys.readouterr().err.splitlines()[-1] == r"RuntimeError: \x1b[2J"
    assert logging.lastResort.format(record).splitlines()[-1] == r"RuntimeError: \x1b[2J"
