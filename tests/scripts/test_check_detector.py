"""A small part of what the script measures."""

from pathlib import Path

import pytest

CHECKPOINT = Path(__file__).parents[2] / "checkpoints" / "pick-ppo.zip"


@pytest.fixture(scope="module")
def script(load_script):
    return load_script("check_detector")


def test_episodes_of_training_are_usual_and_a_frozen_encoder_is_not(script, run):
    status, out, err = run(CHECKPOINT, "--ticks", 640, "--steps", 640, "--only", "elbow")
    lines = out.splitlines()
    assert (status, err) == (0, "")
    assert lines[0].startswith("no shift: ")
    assert int(lines[0].split(" ticks: ")[1].split()[0]) <= 2  # false alarms: one in 72,000 ticks is expected
    shift, episodes, failed, flagged, *_ = (cell.strip() for cell in lines[4].strip("|").split("|"))
    assert (shift, failed, flagged) == ("elbow's encoder frozen", episodes, episodes)
    assert lines[-1] == "1 of 1 shifts: at least 90 % of the failed episodes flagged before they end"
