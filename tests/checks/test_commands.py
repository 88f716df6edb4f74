"""The script that runs every training command of the pages: which ones these are, and what it says of a run."""

import shlex

import pytest

from tests.checks import commands as script


def test_the_commands_are_those_that_train_here_each_once(capsys):
    assert script.main(script.Flags(list=True)) == 0
    found = [line.partition(" seeds  ")[2] for line in capsys.readouterr().out.splitlines()]
    assert "bam-train --trainer rllib --env bam/pick --algo ppo --num-env-runners 2" in found
    assert "bam-train --env bam/pick-place --algo ppo" in found  # without its --out
    assert {f"python scripts/{name}.py" for name in script.SCRIPTS} <= set(found)
    assert len({tuple(sorted(shlex.split(line))) for line in found}) == len(found)
    assert not {*script.ELSEWHERE, *script.SAME} & {word for line in found for word in shlex.split(line)}


def test_a_flag_goes_with_its_value_but_force_has_none():
    words = ["bam-train", "--force", "--env", "bam/pick", "--out", "a.zip", "--algo", "ppo"]
    assert script.without(words, *script.SAME) == ("bam-train", "--env", "bam/pick", "--algo", "ppo")


def test_a_run_is_logged_in_the_place_of_its_earlier_row(tmp_path, monkeypatch, capsys):
    """And a row of a command that no page has any more is removed."""
    results = [(0, 0.5), (0, 0.95), (3, None)]
    monkeypatch.setattr(
        script, "run", lambda *_: script.Result(results[0][0], 61.4, 70.0, 204800, results.pop(0)[1], None, None)
    )
    log, command = tmp_path / "commands.md", "bam-train --env bam/grid-world --algo ppo"
    gone = "| `bam-train --env gone` | 0 | 1 | 1 s | 1 s | 90.0% | - | yes | 2020-01-01, abc |"
    log.write_text(f"{gone}\n")
    flags = {"only": "grid-world", "folder": tmp_path, "log": log}
    assert script.main(script.Flags(seeds=(1,), **flags)) == 1
    assert script.main(script.Flags(seeds=(1,), **flags)) == 0
    assert script.main(script.Flags(seeds=(0, 1), missing=True, **flags)) == 1
    rows = [line for line in log.read_text().splitlines() if line.startswith("| `")]
    assert [line.rpartition(" | ")[0] for line in rows] == [
        f"| `{command}` | 0 | 204,800 | 61 s | 70 s | - | - | NO",
        f"| `{command}` | 1 | 204,800 | 61 s | 70 s | 95.0% | - | yes",
    ]
    capsys.readouterr()
    script.main(script.Flags(list=True, **flags))
    assert capsys.readouterr().out == f"2 seeds  {command}\n"


def test_every_row_of_the_committed_log_has_learnt():
    rows = script.read_log(script.LOG).values()
    assert rows
    assert {line.split(" | ")[-2] for line in rows} == {"yes"}


@pytest.mark.parametrize(
    ("status", "success", "reward", "threshold", "learnt"),
    [
        (0, 0.9, None, None, "yes"),
        (0, 0.895, 500.0, 475.0, "NO"),
        (0, None, 475.0, 475.0, "yes"),
        (0, None, 474.0, 475.0, "NO"),
        (0, None, -200.0, None, "?"),
        (1, None, None, None, "FAILED"),
        (3, None, None, None, "NO"),  # bam-train says so itself
    ],
)
def test_what_learning_is(status, success, reward, threshold, learnt):
    result = script.Result(status, 61.4, 70.0, 204800, success, reward, threshold)
    assert result.learnt == learnt
    line = script.row(("bam-train", "--env", "bam/pick"), 2, result)
    assert line.startswith("| `bam-train --env bam/pick` | 2 | 204,800 | 61 s | 70 s | ")
    assert f" | {learnt} | 20" in line
