"""robo-gym's own environment classes, run where they are installed."""

import json
import os
import subprocess

import pytest

from bam_train.cli.flags import TrainConfig
from bam_train.cli.train import train
from tests.peers.conftest import PEERS

PYTHON = str(PEERS / "robo_gym" / "bin" / "python")
OPTIONS = ("-p", "no:cacheprovider", "--noconftest", "-rs")
"""There is no hypothesis, which our conftest.py needs, beside robo-gym."""
ENV = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "PYTHON"))}


@pytest.fixture(scope="session", autouse=True)
def robo_gym(peers):
    if not (PEERS / "robo_gym").exists():
        pytest.fail("no robo-gym among the peers: run tests/peers/install_peers")


def run(*command, root, limit=900.0):
    """Standard output of a program that does well."""
    env = ENV | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*map(str, command)], cwd=root, env=env, capture_output=True, text=True, check=False, timeout=limit
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_parity(request):
    """Observation, reward and end of ours with parity=True are those of robo-gym's classes."""
    tests = ["tests/bam_envs/robo_gym/test_parity.py", "tests/bam_envs/robo_gym/test_rs_state.py"]
    output = run(PYTHON, "-m", "pytest", *OPTIONS, *tests, root=request.config.rootpath)
    assert "skipped" not in output, output


IDS = ("NoObstacleNavigationMir100Sim-v0", "EndEffectorPositioningURSim-v0")


@pytest.fixture(scope="module")
def played(pytestconfig, tmp_path_factory):
    """Two episodes of each id with a checkpoint that was trained with parity=True, there and here."""
    pytest.importorskip("stable_baselines3")
    folder = tmp_path_factory.mktemp("policies")
    small = ("n_steps=64", "batch_size=64", "n_epochs=1", "num_envs=2", "env_kwargs.parity=true")
    for env_id in IDS:
        settings = {"env": env_id, "algo": "ppo", "steps": 256, "eval_episodes": 1, "set": small}
        train(TrainConfig(**settings, out=folder / f"{env_id}.zip", runs=folder / "runs"))
    return json.loads(run(PYTHON, "-m", "tests.peers.robo_gym_policy", folder, 2, *IDS, root=pytestconfig.rootpath))


@pytest.mark.slow
@pytest.mark.parametrize("env_id", IDS)
def test_a_policy_of_ours_in_robo_gym(env_id, played):
    """A checkpoint does there what it does here."""
    assert len(played[env_id]) == 2
    for episode in played[env_id]:
        ours, theirs = episode["ours"], episode["theirs"]
        assert (ours["status"], ours["steps"]) == (theirs["status"], theirs["steps"])
        assert ours["return"] == pytest.approx(theirs["return"], abs=1e-2)  # wire states are float32
