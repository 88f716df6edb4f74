"""The benchmark runs and says what it measured; the figures are for a quiet machine to judge."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def bench(*arguments):
    path = os.pathsep.join([str(ROOT), str(ROOT / "envs"), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(ROOT / "scripts" / "bench_envs.py"), *arguments]
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)


def test_it_measures_all_four():
    result = bench("--env", "bam/pick", "--rows", "8", "--rounds", "2", "--steps", "5")
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert lines[1].startswith("bam/pick-v0, medians of 2 rounds")
    assert [line.split("  ")[0] for line in lines[2:]] == [
        "gym.make_vec, 8 rows",
        "bare mujoco.rollout, same model, states, controls",
        "share of the bare physics",
        "gym.make, one",
    ]
    assert all(line.endswith(("met", "missed")) for line in (lines[2], lines[4], lines[5]))


def test_all_in_one_go_with_their_own_rows():
    result = bench("--rounds", "1", "--steps", "2")
    assert result.returncode == 0, result.stderr
    lines = [line for line in result.stdout.splitlines() if line.startswith(("bam/", "gym.make_vec"))]
    assert [line.partition(",")[0] for line in lines[::2]] == [
        "bam/pick-v0",
        "bam/mir100-navigation-v0",
        "bam/mir100-avoidance-v0",
        "bam/ur-reach-v0",
    ]
    targets = [line.split()[-2] for line in lines[1::2]]
    assert targets == ["15,000", "300,000", "20,000", "30,000"]
    assert [line.split()[1] for line in lines[1::2]][:3] == ["64", "4096", "256"]


def test_only_ours():
    result = bench("--env", "CartPole")
    assert result.returncode == 2
    assert "--env must be one of bam/reach-v0, bam/pick-v0, bam/pick-place-v0, " in result.stderr
    assert "not CartPole-v1" in result.stderr
