"""What tests of the experiment scripts share: running one as a user does, and a policy that one has trained."""

import contextlib
import importlib.util
import io
import os
import runpy
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest

from bam_train.cli.program import guarded
from tests.one_ray import shared_ray_fixture  # noqa: F401

ROOT = Path(__file__).parents[2]
PATHS = [str(ROOT), str(ROOT / "envs")]


@pytest.fixture(scope="session")
def environment():
    """Variables for scripts; ours is what they import."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([*PATHS, os.environ.get("PYTHONPATH", "")])}


@pytest.fixture(scope="session")
def run_script(environment):
    """``run_script(name, *arguments, folder=…)`` in a process of its own, where `first` is imported from before all."""

    def run(name, *arguments, folder, first=None, **variables):
        command = [sys.executable, str(ROOT / "scripts" / f"{name}.py"), *map(str, arguments)]
        paths = {} if first is None else {"PYTHONPATH": os.pathsep.join([str(first), environment["PYTHONPATH"]])}
        return subprocess.run(
            command,
            cwd=folder,
            env={**environment, **paths, **variables},
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )

    return run


@pytest.fixture(scope="session")
def load_script():
    """``load_script(name)`` is a script as a module."""

    def load(name):
        spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture
def run(script, capsys, monkeypatch, tmp_path):
    """Runs the main function of the file's `script` in `tmp_path`; its status, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def run_it(*arguments):
        monkeypatch.setattr(sys, "argv", [Path(script.__file__).name, *map(str, arguments)])
        try:
            status = guarded(script.main, Path(script.__file__).stem)
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()

    return run_it


@pytest.fixture(scope="session")
def run_here(shared_ray):
    """As `run_script`, in this process, which has imported much of what scripts import and runs Ray already."""

    def run(name, *arguments, folder):
        shared_ray.start()
        script, out, err, status = ROOT / "scripts" / f"{name}.py", io.StringIO(), io.StringIO(), 0
        with (
            contextlib.chdir(folder),
            mock.patch.object(sys, "argv", [str(script), *map(str, arguments)]),
            mock.patch.object(sys, "path", [str(script.parent), *sys.path]),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            try:
                runpy.run_path(str(script), run_name="__main__")
            except SystemExit as end:
                status = end.code or 0
        return subprocess.CompletedProcess(script, status, out.getvalue(), err.getvalue())

    return run


@pytest.fixture(scope="session")
def trained(run_here, tmp_path_factory):
    """A folder in which a MiR100 was trained for one iteration and explored for two episodes; and what was said."""
    folder = tmp_path_factory.mktemp("trained")
    options = ("--run", "PPO", "--stop-iters", 1, "--explore-during-inference", "--num-episodes-during-inference", 2)
    done = run_here("training_inference_mir", *options, folder=folder)
    assert done.returncode == 0, done.stderr
    return folder, done
