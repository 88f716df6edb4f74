"""A few rows of the fault matrix, in one robot cell; the script has all of them."""

import contextlib

import pytest

from bam_envs.testing.robot_cell import RobotCell, StateFault


@pytest.fixture(scope="module")
def matrix(load_script):
    return load_script("fault_matrix")


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
        (("--only", "bridge", "--only", "frozn"), "--only: no fault's name has 'frozn'. Did you mean 'network frozen"),
        (("--checkpoint", "none.zip"), "none.zip: no such file. Train one with bam-train, or check the name"),
    ],
)
def test_a_typo_is_refused(matrix, monkeypatch, capsys, flags, text):
    monkeypatch.setattr("sys.argv", ["fault_matrix.py", *flags])
    with pytest.raises(SystemExit) as caught:
        matrix.main()
    assert caught.value.code == 2
    assert f"fault_matrix.py: error: {text}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "status", "said"),
    [
        ("policy process killed", -9, ()),
        ("Ctrl-C twice", 130, ("bam-deploy: interrupted",)),
        ("joint vanishes from the message", 1, ("bam-deploy: fault: /joint_states: wrist_3_joint missing; found: ",)),
        ("bridge killed", 4, ("bam-deploy: link lost: ws://127.0.0.1:",)),
    ],
)
def test_the_robot_rests_and_the_operator_knows_why(matrix, cell, monkeypatch, name, status, said):
    monkeypatch.setattr(matrix, "BRAKING", 5.0)  # on a busy computer
    fault = next(fault for fault in matrix.FAULTS if fault.name == name)
    outcome = None
    for _ in range(3):
        with contextlib.suppress(RuntimeError):  # guards stop a deployment before its fault: the computer is too busy
            outcome = outcome or matrix.strike(fault, cell, matrix.CHECKPOINT)
    assert outcome is not None
    assert (outcome.problems, outcome.status) == ((), status)
    seen = [line for line in outcome.saw if "warning" not in line]  # of missed ticks, on a busy computer
    assert all(line.startswith(text) for line, text in zip(seen[-1:], said, strict=True)), seen
