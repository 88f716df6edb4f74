"""The table of how checkpoints do behind imperfect links."""

import json

from tests.scripts.conftest import ROOT


def test_the_table_of_one_checkpoint(run_script, tmp_path):
    checkpoint = ROOT / "checkpoints" / "mir100-navigation-ppo.zip"
    done = run_script("evaluate_links", checkpoint, "--episodes", 2, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "| checkpoint | plain | randomised | late actions | late commands | wifi | lte | bad | randomised, wifi |",
        f"| {' | '.join(['---'] * 9)} |",
        f"| mir100-navigation-ppo.zip | 100.0% | {' | '.join(['100.0% (1.000)'] * 7)} |",
    ]


def test_late_commands_are_two_periods_late(load_script):
    link = load_script("evaluate_links").columns(0.05)["late commands"]["link"]
    assert json.dumps(link) == '{"command_delay": [0.1, 0.1], "state_delay": [0.0, 0.0]}'
