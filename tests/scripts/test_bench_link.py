"""The benchmark runs and says what it measured; the figures are for a quiet machine to judge."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def bench(*arguments):
    path = os.pathsep.join([str(ROOT), str(ROOT / "envs"), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(ROOT / "scripts" / "bench_link.py"), *arguments]
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize(
    ("row", "first", "verdicts"),
    [
        ("link", "bare roslibpy topic pair", 2),
        ("gymapi", "GymAPI step, state", 1),
        ("tcp", "TCP step, state", 1),
        ("tcp-image", "TCP step, 84 x 84 x 3 image", 1),
        ("camera", "100 Hz control alone", 1),
        ("subscribers", "20 subscribers to 100 Hz joint states", 1),
    ],
)
def test_each_row(row, first, verdicts):
    result = bench("--only", row, "--rounds", "1", "--count", "20", "--seconds", "0.5")
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert lines[0].startswith(first)
    assert sum(line.endswith((": met", ": missed")) for line in lines) == verdicts
