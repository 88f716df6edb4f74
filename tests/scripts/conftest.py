"""What tests of the experiment scripts share: running one as a user does, and a policy that one has trained."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

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
def trained(run_script, tmp_path_factory):
    """A folder in which a MiR100 was trained for one iteration and explored for two episodes; and what was said."""
    folder = tmp_path_factory.mktemp("trained")
    options = ("--run", "PPO", "--stop-iters", 1, "--explore-during-inference", "--num-episodes-during-inference", 2)
    done = run_script("training_inference_mir", *options, folder=folder)
    assert done.returncode == 0, done.stderr
    return folder, done
