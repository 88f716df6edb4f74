"""The script that runs every training command of the pages: which ones these are, and what it says of a run."""

import shlex

import pytest


@pytest.fixture(scope="module")
def script(load_script):
    return load_script("check_commands")


def test_the_commands_are_those_that_train_here_each_once(script, capsys):
    assert script.main(script.Flags(list=True)) == 0
    found = capsys.readouterr().out.splitlines()
    assert "bam-train --trainer rllib --env bam/pick --algo ppo --num-env-runners 2" in found
    assert "bam-train --env bam/pick --algo ppo --until-success 0.95" in found  # without its --seed and --out
    assert {f"python scripts/{name}.py" for name in script.SCRIPTS} <= set(found)
    assert len({tuple(sorted(shlex.split(line))) for line in found}) == len(found)
    assert not any(flag in line for line in found for flag in (*script.ELSEWHERE, "--seed", "--out"))


@pytest.mark.parametrize(
    ("status", "success", "reward", "threshold", "learnt"),
    [
        (0, 0.9, None, None, "yes"),
        (0, 0.895, 500.0, 475.0, "NO"),
        (0, None, 475.0, 475.0, "yes"),
        (0, None, 474.0, 475.0, "NO"),
        (0, None, -200.0, None, "?"),
        (1, None, None, None, "FAILED"),
    ],
)
def test_what_learning_is(script, status, success, reward, threshold, learnt):
    result = script.Result(status, 61.4, 204800, success, reward, threshold)
    assert result.learnt == learnt
    line = script.row(("bam-train", "--env", "bam/pick"), 2, result)
    assert line.startswith("| `bam-train --env bam/pick` | 2 | 204,800 | 61 s | ")
    assert line.endswith(f" | {learnt} |")
