"""What several tests of the environments use."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers the environments

ROOT = Path(__file__).parents[2]


@pytest.fixture
def python():
    """Run code in a new Python process; what it prints."""

    def run(code, **variables):
        path = os.pathsep.join([str(ROOT), str(ROOT / "envs"), os.environ.get("PYTHONPATH", "")])
        environment = {**os.environ, "PYTHONPATH": path, **variables}
        command = [sys.executable, "-W", "error", "-c", code]
        result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
        assert result.returncode == 0, result.stderr
        return result.stdout.strip()

    return run


@pytest.fixture
def make():
    """`gymnasium.make` without its checker; closed at the end."""
    made = []

    def make_one(env_id, **options):
        made.append(gym.make(env_id, disable_env_checker=True, **options))
        return made[-1]

    yield make_one
    for env in made:
        env.close()


@pytest.fixture
def make_rows():
    """`gymnasium.make_vec`; closed at the end."""
    made = []

    def make_some(env_id, num_envs, **options):
        made.append(gym.make_vec(env_id, num_envs=num_envs, **options))
        return made[-1]

    yield make_some
    for env in made:
        env.close()


@pytest.fixture
def actions_of():
    """Actions of one row, each kept for five steps: ``actions_of(row, steps, size)``, shape (steps, size) float32."""

    def actions(row, steps, size):
        draws = np.random.default_rng(row).uniform(-1.5, 1.5, ((steps + 4) // 5, size)).clip(-1, 1)
        return np.repeat(draws, 5, axis=0)[:steps].astype(np.float32)

    return actions


@pytest.fixture
def ros_domain(monkeypatch):
    """The ROS domain of a graph that stays on loopback; skips where rclpy is not installed."""
    pytest.importorskip("rclpy", reason="needs rclpy")
    profile = str(ROOT / "tests" / "peers" / "dds_profile.xml")
    for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"):
        monkeypatch.setenv(name, profile)
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    # The one range with which the middleware adds no transport of its own to those of the profile.
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SYSTEM_DEFAULT")
    return 1 + os.getpid() % 100
