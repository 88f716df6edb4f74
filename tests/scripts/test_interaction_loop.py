"""The script solves CartPole; the notebook is the script, executed."""

import os
import re
import runpy
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
SCRIPT = SCRIPTS / "interaction_loop.py"


def run(*arguments):
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "MPLBACKEND": "agg"},
    )


@pytest.fixture(scope="module")
def make_notebook():
    pytest.importorskip("nbformat")
    return SimpleNamespace(**runpy.run_path(str(SCRIPTS.parent / "docs" / "hooks" / "make_notebook.py")))


def test_it_solves_cartpole():
    done = run(SCRIPT)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "Workspace:"
    assert "\taction: time_size = 10, batch_size = 1" in lines
    assert "obs torch.Size([10, 1, 4]) action torch.Size([10, 1])" in lines
    assert "'rewrad' is not in the workspace, did you mean 'reward'? It has 'action', 'done', 'obs', 'reward'." in lines
    last = re.fullmatch(r"epoch \d+: ([\d.]+) over 100 episodes: solved", lines[-1])
    assert last, lines[-1]
    assert float(last[1]) >= 475


def test_ctrl_c_is_one_line():
    """Once it has begun to train."""
    with subprocess.Popen(
        [sys.executable, "-u", str(SCRIPT)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "MPLBACKEND": "agg"},
    ) as process:
        try:
            for line in process.stdout:
                if line.startswith("epoch "):
                    break
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert errors == "interaction_loop: stopped by Ctrl-C\n"
    assert process.returncode in (130, -signal.SIGINT)


@pytest.mark.parametrize("script", [SCRIPT, SCRIPTS / "tour.py"])
def test_the_notebook_is_the_script_executed(make_notebook, script):
    assert make_notebook.is_current(script, script.with_suffix(".ipynb")), "run: python docs/hooks/make_notebook.py"


def test_only_imports_differ_from_bbrl():
    """Apart from its imports, nothing in the script is of bam_train."""
    code = re.sub(r"^from bam_train\.loop import (\(.*?\)|.*?)$", "", SCRIPT.read_text(), flags=re.M | re.S)
    assert [line for line in code.splitlines() if "bam_train" in line] == []


def test_cells(make_notebook):
    script = '"""Doc."""\n\n# %% script only\nimport a\n\n# %% [markdown]\n# # Head\n#\n# text\n'
    script += "\n# %%\nb = 1\n\n\n# %%\nc = 2\n"
    assert make_notebook.cells_of(script) == [("markdown", "# Head\n\ntext"), ("code", "b = 1"), ("code", "c = 2")]


def test_a_changed_script_is_found(make_notebook, tmp_path):
    script = tmp_path / "a.py"
    script.write_text(SCRIPT.read_text().replace("n_steps=10", "n_steps=11"))
    assert not make_notebook.is_current(script, SCRIPT.with_suffix(".ipynb"))
