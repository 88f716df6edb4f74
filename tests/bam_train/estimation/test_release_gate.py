"""`bam-gate` in simulation: the corridor, where one policy goes right and another one left."""

import json

import numpy as np
import pytest

from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, safetensors_file, write_checkpoint
from bam_train.cli.data import run_gate as gate
from tests.bam_train.conftest import chooser


@pytest.fixture
def left(corridor_checkpoint, tmp_path):
    """A checkpoint that goes right from the third cell on, and left in the others."""
    manifest = vars(Checkpoint.open(corridor_checkpoint()).manifest).copy()
    del manifest["format"], manifest["sha256"]
    golden = {"observation": np.array([[1.0], [3.0]], np.float32), "action": np.array([0, 1])}
    members = {POLICY: chooser([[0, 1]], [2.5, 0]), GOLDEN: safetensors_file.dump(golden)}
    return write_checkpoint(tmp_path / "left.zip", manifest, members).path


@pytest.fixture
def right(corridor_checkpoint):
    return corridor_checkpoint()


def test_better(left, right, run):
    status, out, err = run(gate.main, right, left)
    lines = out.splitlines()
    assert (status, err) == (0, "")
    assert lines[0] == f"better: {right} against {left}"
    assert lines[1] == "  simulated   test/Corridor-v0: 16 pairs, seeds 2000000 to 2000015"
    assert lines[2] == "    candidate 100.0% success"
    assert lines[4].endswith(": 11 the candidate, 0 the champion") or "the candidate, 0 the champion" in lines[4]
    assert lines[5].startswith("    verdict   better: difference +")
    assert lines[6] == "  margin      2.0%: a candidate that is worse by less is not worse"


def test_worse(left, right, run):
    status, out, _ = run(gate.main, left, right, "--json")
    report = json.loads(out)
    assert (status, report["verdict"], report["data"]) == (2, "worse", None)
    found = report["simulation"]
    assert (found["wins"], found["champion"], found["metric"]) == (0, 1.0, "success")
    assert found["difference"] == -found["losses"] / found["episodes"] == found["candidate"] - 1
    assert found["interval"][1] < 0
    assert set(report["candidate"]) == {"path", "digest"}


def test_not_worse_and_undecided(right, run):
    status, out, _ = run(gate.main, right, right, "--margin", 0.2, "--json")
    report = json.loads(out)
    assert (status, report["verdict"]) == (1, "not worse")
    assert report["simulation"]["episodes"] < 200
    assert run(gate.main, right, right, "--episodes", 16)[0] == 3


def test_without_success_the_higher_return_wins(corridor_checkpoint, left, run):
    champion = corridor_checkpoint("silent.zip", env_kwargs={"says_success": False})
    status, out, _ = run(gate.main, left, champion, "--json")
    assert (status, json.loads(out)["simulation"]["metric"]) == (2, "return")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--no-simulation"], "--no-simulation leaves nothing to compare on; give --data too"),
        (["--env", "CartPole-v1"], "was trained on test/Corridor-v0, not on CartPole-v1"),
        (["--margin", "2"], "--margin"),
        (["--magin", "0.1"], "unknown option --magin, did you mean --margin?"),
    ],
)
def test_an_error_is_no_verdict(right, run, arguments, text):
    status, out, err = run(gate.main, right, right, *arguments)
    assert (status, out) == (4, "")
    assert err.startswith("bam-gate: ")
    assert text in err


WIDE = {"type": "Box", "shape": [1], "dtype": "float32", "low": 0.0, "high": 9.0}


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        (
            {"env": "CartPole-v1"},
            "was trained on test/Corridor-v0, not on CartPole-v1. {} is the champion of that one. "
            "Compare it with a champion of test/Corridor-v0",
        ),
        (
            {"observation_space": WIDE},
            "observation_space.high is 4.0, and 9.0 in the champion {}; "
            "a gate compares policies that see and do the same",
        ),
    ],
)
@pytest.mark.parametrize("named", [[], ["--env", "test/Corridor-v0"]])
def test_policies_of_two_environments(corridor_checkpoint, right, run, named, fields, text):
    champion = corridor_checkpoint("champion.zip", **fields)
    assert run(gate.main, right, champion, *named) == (4, "", f"bam-gate: {right}: {text.format(champion)}\n")


def test_a_bug_is_no_verdict(right, run, monkeypatch):
    monkeypatch.setattr(gate, "decide", lambda config: 1 / 0)
    status, _, err = run(gate.main, right, right)
    assert status == 4
    assert err.endswith("ZeroDivisionError: division by zero\n")
