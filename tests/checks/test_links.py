"""The table of how checkpoints do behind imperfect links."""

import json

from tests.benchmarks.harness import CHECKPOINTS
from tests.checks import links


def test_the_table_of_one_checkpoint(capsys):
    checkpoint = CHECKPOINTS / "mir100-navigation-ppo.zip"
    assert links.main(links.Flags(checkpoints=(checkpoint,), episodes=2)) == 0
    assert capsys.readouterr().out.splitlines() == [
        "| checkpoint | plain | randomised | late actions | late commands | wifi | lte | bad | randomised, wifi |",
        f"| {' | '.join(['---'] * 9)} |",
        f"| mir100-navigation-ppo.zip | 100.0% | {' | '.join(['100.0% (1.000)'] * 7)} |",
    ]


def test_late_commands_are_two_periods_late():
    link = links.columns(0.05)["late commands"]["link"]
    assert json.dumps(link) == '{"command_delay": [0.1, 0.1], "state_delay": [0.0, 0.0]}'
