"""The benchmark runs and says what it measured; the figures are for a quiet machine to judge."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def missing(folder, *names):
    """Packages that cannot be imported, as if they were not installed."""
    for name in names:
        error = f'ModuleNotFoundError("No module named {name!r}", name={name!r})'
        (folder / f"{name}.py").write_text(f"raise {error}\n")
    return folder


def bench(*arguments, before=()):
    path = os.pathsep.join([*map(str, before), str(ROOT), str(ROOT / "envs"), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(ROOT / "scripts" / "bench_loop.py"), *arguments]
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)


def table(result):
    """The lines below the table's head."""
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert " cores, load " in lines[0]
    assert lines[1].split() == ["CPU", "time,", "medians", "ours", "other", "ratio", "target"]
    return lines[2:]


def test_help_has_examples():
    result = bench("--help")
    assert result.returncode == 0
    assert "pip install bbrl==1.0.1" in result.stdout
    assert "  python scripts/bench_loop.py --quick" in result.stdout


def test_an_unknown_row():
    result = bench("--only", "notebok")
    assert result.returncode == 2
    assert "argument --only: invalid choice: 'notebok'" in result.stderr


def test_without_bbrl_our_own_figure_is_there_and_how_to_compare_it(tmp_path):
    pytest.importorskip("torch")
    (line,) = table(bench("--quick", "--only", "notebook", before=[missing(tmp_path, "bbrl")]))
    pattern = r"notebook's agents, 10,000 steps +\d+\.\d us/step +pip install bbrl==1\.0\.1 +>= 2x"
    assert re.fullmatch(pattern, line)


def test_without_torch_it_says_what_is_missing(tmp_path):
    (line,) = table(bench("--quick", "--only", "notebook", before=[missing(tmp_path, "torch")]))
    assert line.split("  ", 1)[0] == "notebook"
    assert line.endswith(" needs torch       pip install torch")


def test_the_deployment_needs_neither_torch_nor_bbrl(tmp_path):
    for name in ("bbrl", "torch"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('imported')\n")
    result = bench("--quick", "--only", "deployment", before=[tmp_path])
    lines = table(result)
    assert result.stdout.splitlines()[0].endswith("without torch")
    starts = [re.split("  +", line.strip())[0] for line in lines]
    assert starts == [
        "deployment, 50,000 ticks, one episode",
        "what the loop adds to a tick",
        "deployment, 50,000 ticks, episodes of 50",
        "what the loop adds to a tick",
    ]
    assert all(line.endswith("< 5 MB  met") for line in lines[::2])
