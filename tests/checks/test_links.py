"""The table of how checkpoints do behind imperfect links."""

from tests.benchmarks.harness import CHECKPOINTS
from tests.checks import links


def test_the_table_of_one_checkpoint(capsys):
    checkpoint = CHECKPOINTS / "mir100-navigation-ppo.zip"
    assert links.main(links.Flags(checkpoints=(checkpoint,), episodes=2)) == 0
    assert capsys.readouterr().out.splitlines() == [
        "| checkpoint | no delay | wifi | lte | bad |",
        "| --- | --- | --- | --- | --- |",
        "| mir100-navigation-ppo.zip | 100.0% (0.0%) | 100.0% (0.0%) | 100.0% (0.0%) | 100.0% (0.0%) |",
    ]
