"""What benchmarks and checks share: flags, timing in turns, percentiles, ratios, and the table.

A benchmark is a module here with functions ``measure_NAME(flags)`` that yield rows of the table, or lines of text, and
maybe with a dataclass ``Flags``. Every figure has something beside it that is measured in turns in the same run, so
that a busy machine slows both alike: compare ratios, the times are this machine's, now.
"""

import ast
import gc
import importlib
import inspect
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy and torch read it

import numpy as np
from tyro.conf import arg

from bam_envs.core.errors import InvalidValue
from bam_envs.core.wording import did_you_mean
from bam_train.cli.flags import Positive
from bam_train.cli.program import guarded, parse
from bam_train.errors import SettingsError
from bam_train.files.atomic_file import replacing
from bam_train.trainers.base import origin

ROOT = Path(__file__).parents[2]
CHECKPOINTS = ROOT / "checkpoints"
PICK = CHECKPOINTS / "pick-ppo.zip"
HOME = (-0.27, -1.54, 1.89, -1.93, -1.57, -1.84)
"""Joints of a UR5e with the tool above the table [rad]."""
UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6}


@dataclass(frozen=True, kw_only=True)
class Flags:
    """The flags of every benchmark."""

    only: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Measure these rows alone."""
    amount: Positive = 1.0
    """Measure so much longer, or shorter if less than 1."""
    quick: bool = False
    """Measure a fiftieth, to see that everything runs; the figures are rough."""

    def times(self, number):
        """How often something is done that is done `number` times for figures."""
        return max(1, round(number * (0.02 if self.quick else self.amount)))


class Row(NamedTuple):
    """One line of the table."""

    what: str
    found: str
    goal: str = ""
    met: bool | None = None
    """None: there is nothing to meet."""

    def __str__(self):
        verdict = {None: "", True: "met", False: "MISSED"}[self.met]
        return f"{self.what:<50}   {self.found:<50}   {self.goal:<28}   {verdict}".rstrip()


def number(value):
    """Three digits, or a whole number with commas."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def table_row(*cells):
    """A line of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def made_row(*cells):
    """The same, with a last cell that says when and with which commit it was measured."""
    return table_row(*cells, f"{origin()['created'][:10]}, {str(origin()['git_commit'])[:7]}")


def rows_of_page(page, key):
    """The rows of a page of `write_table`, by what `key` makes of their cells."""
    lines = page.read_text().splitlines() if page.exists() else []
    rows = [line for line in lines if line.startswith("| ") and not line.startswith("| ---")][1:]
    return {key(*line.strip("| ").split(" | ")): line for line in rows}


def write_table(page, head, header, rows):
    """Write a page of Markdown with a table, and the computer and versions that its newest rows are of."""
    versions = ", ".join(f"{name} {version}" for name, version in origin()["versions"].items())
    table = "\n".join([table_row(*header), table_row(*["---"] * len(header)), *rows])
    with replacing(page) as path:
        path.write_text(f"{head}{table}\n\nThe newest rows: {os.cpu_count()} CPU cores, {versions}.\n")


def at_most(what, value, goal, unit="", found=None):
    """The row of a value that must not be greater than its goal; `found` is shown instead of the value."""
    return Row(what, found or f"{number(value)} {unit}".strip(), f"<= {number(goal)} {unit}", bool(value <= goal))


def at_least(what, value, goal, unit="", found=None):
    """The row of a value that must not be less than its goal; with a goal of 0 there is none."""
    found = found or f"{number(value)} {unit}".strip()
    return Row(what, found, f">= {number(goal)} {unit}", bool(value >= goal)) if goal else Row(what, found)


def percentiles(what, times, unit, p50=None, p99=None):
    """The row of times [s], with the most that p50 and p99 may be [unit]."""
    found = UNITS[unit] * np.percentile(times, [50, 99])
    goals = [(name, one, goal) for name, one, goal in zip(("p50", "p99"), found, (p50, p99), strict=True) if goal]
    text = ", ".join(f"{name} <= {goal:g}" for name, _, goal in goals)
    met = all(one <= goal for _, one, goal in goals) if goals else None
    return Row(what, f"p50 {found[0]:.3g}, p99 {found[1]:.3g} {unit}", f"{text} {unit}" if goals else "", met)


def timed(act, count, clock=time.perf_counter):
    """How long each of `count` calls took [s]."""
    times = np.empty(count)
    for k in range(count):
        begun = clock()
        act()
        times[k] = clock() - begun
    return times


def in_turns(works, rounds, clock=time.process_time):
    """Times by name [s], one a round, after one round to warm up."""
    for work in works.values():
        work()
    times = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            gc.collect()
            begun = clock()
            result = work()
            times[name].append(clock() - begun)
            del result  # freed outside the clock
    return times


def ratio(slow, fast):
    """How many times as long the first took as the second, round by round; the median."""
    return median(one / other for one, other in zip(slow, fast, strict=True))


def program(name, *arguments):
    """The command of one of our programs, such as ``train``, in this Python."""
    return [sys.executable, "-m", f"bam_train.cli.{name}", *map(str, arguments)]


class Ended(NamedTuple):
    """How a program ended; times and memory are its own and those of its children."""

    status: int
    seconds: float
    cpu: float
    text: str
    """What it printed."""


def ended(command, folder, cwd=ROOT):
    """Run a command to its end; what it prints is in ``output.txt`` in `folder` too."""
    begun = time.monotonic()
    with (folder / "output.txt").open("w+") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, cwd=cwd)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode, seconds = os.waitstatus_to_exitcode(status), time.monotonic() - begun
        output.seek(0)
        return Ended(process.returncode, seconds, used.ru_utime + used.ru_stime, output.read())


def resident():
    """Memory of this process [bytes]; on Linux."""
    return float(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


class Peer:
    """A function of a module in a process of its own, which prints ports and then serves until its input ends."""

    def __init__(self, function, *arguments):
        code = f"from {function.__module__} import {function.__name__} as serve; serve(*{arguments!r})"
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, **pipes)

    def __enter__(self):
        self.ports = [int(port) for port in self.process.stdout.readline().split()]
        if not self.ports:
            raise SettingsError(f"a server ended with status {self.process.wait()}")
        return self

    def __exit__(self, *_):
        self.process.communicate(timeout=20)


def until_the_end(*ports):
    """In a `Peer`: say where it listens, and wait for its end."""
    print(*ports, flush=True)
    sys.stdin.read()


def flags_of(module):
    """The dataclass of a module's flags, with its docstring as the text of ``--help``."""
    kind = getattr(module, "Flags", Flags)
    return type("Flags", (kind,), {"__doc__": inspect.cleandoc(module.__doc__)})


def measure(module, flags):
    """Print the rows of a module as they come; 1 if a goal is missed."""
    names = {name.removeprefix("measure_").replace("_", "-"): name for name in vars(module) if name[:8] == "measure_"}
    for name in flags.only:
        if name not in names:
            raise InvalidValue(f"--only: there is no {name!r}. {did_you_mean(name, names)}")
    missed, head = 0, str(Row("figure", "measured", "goal"))
    for name in flags.only or names:
        for row in rows_of(name, getattr(module, names[name]), flags):
            if head and isinstance(row, Row):
                print(head)
                head = ""
            missed += isinstance(row, Row) and row.met is False
            print(row, flush=True)
    return int(missed > 0)


def rows_of(name, measure, flags):
    """The rows of a function, or the one that says what is not installed."""
    try:
        yield from measure(flags)
    except ModuleNotFoundError as error:
        yield Row(name, f"needs {error.name}", f"pip install {error.name}")


def main(package):
    """Run the module that the command line names, or list all of them; returns the exit status."""
    folder = Path(importlib.import_module(package).__path__[0])
    files = [path for path in sorted(folder.glob("[!_]*.py")) if path.stem != "harness" and path.stem[:5] != "test_"]
    names = [path.stem for path in files]
    name, *arguments = sys.argv[1:] or [""]
    if name == "all":
        command = [sys.executable, "-m", package]
        return max(subprocess.run([*command, one, *arguments], check=False).returncode for one in names)
    if name not in names:
        print(f"python -m {package} NAME [OPTIONS], or all; --help after a name has its options.\n")
        for path in files:
            print(f"  {path.stem:<13}{ast.get_docstring(ast.parse(path.read_text())).splitlines()[0]}")
        return 0 if name in ("", "-h", "--help") else 2
    prog = f"python -m {package} {name}"

    def run():
        module = importlib.import_module(f"{package}.{name}")
        flags = parse(flags_of(module), prog, arguments)
        if hasattr(module, "main"):
            return module.main(flags)
        cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
        print(f"{name}: {cores} cores, load {load:.1f}, Python {sys.version.split()[0]}, NumPy {np.__version__}")
        return measure(module, flags)

    return guarded(run, prog)
