"""A few rows of the fault matrix, in one robot cell; the script has all of them."""

import sys

import numpy as np
import pytest

from tests.benchmarks import harness
from tests.checks import faults
from tests.checks.robot_cell import CellLog, RobotCell, StateFault


@pytest.fixture(scope="module")
def whole_cell():
    with RobotCell("bam/reach-v0") as cell:
        yield cell


@pytest.fixture
def cell(whole_cell):
    yield whole_cell
    whole_cell.publish_wrongly(StateFault.NONE)


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (("--only", "bridge", "frozn"), "--only: no fault's name has 'frozn'. Did you mean 'network frozen"),
        (("--checkpoint", "none.zip"), "none.zip: no such file. Train one with bam-train, or check the name"),
    ],
)
def test_a_typo_is_refused(monkeypatch, capsys, flags, text):
    monkeypatch.setattr(sys, "argv", ["checks", "faults", *flags])
    assert harness.main("tests.checks") == 1
    assert capsys.readouterr().err.startswith(f"python -m tests.checks faults: {text}")


@pytest.mark.parametrize(
    ("name", "status", "said"),
    [
        ("policy process killed", -9, ()),
        ("Ctrl-C twice", 130, ("bam-deploy: interrupted",)),
        ("joint vanishes from the message", 1, ("bam-deploy: fault: /joint_states: wrist_3_joint missing; found: ",)),
        ("bridge killed", 4, ("bam-deploy: link lost: ws://127.0.0.1:",)),
    ],
)
def test_the_robot_rests_and_the_operator_knows_why(cell, name, status, said):
    fault = next(fault for fault in faults.FAULTS if fault.name == name)
    outcome = faults.tried(fault, cell, faults.CHECKPOINT)
    assert (outcome.problems, outcome.status) == ((), status)
    seen = [line for line in outcome.saw if "warning" not in line]  # of missed ticks, on a busy computer
    assert all(line.startswith(text) for line, text in zip(seen[-1:], said, strict=True)), seen


@pytest.mark.parametrize(
    ("moving", "problems"),
    [
        (8, ()),
        (30, ("it moved 0.30 s after the last command",)),
        (50, ("it moved 0.50 s after the last command", "it still moves 0.50 s after the last command")),
    ],
)
def test_the_time_of_a_robot_that_a_busy_computer_holds_up_stands_still(moving, problems):
    ticks = np.arange(101)
    times = 0.01 * ticks + (ticks > 55) * 2.0  # its process stands still for two seconds
    speeds = 0.5 * (ticks <= 50 + moving)
    log = CellLog(times, np.minimum(ticks, 50), ticks > 50, np.zeros((101, 6)), speeds, False, 0.01)
    assert tuple(faults.problems_of(log, 0.0, 0.5, None, watchdog=-0.1)) == problems
