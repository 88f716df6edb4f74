"""The tasks are feasible: hand-written policies solve them."""

import importlib.util
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "scripted_policy.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("scripted_policy", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("env_id", "episodes"), [("bam/reach-v0", 500), ("bam/pick-v0", 1000), ("bam/pick-place-v0", 500)]
)
def test_almost_every_episode_succeeds(script, env_id, episodes):
    successes, lengths = script.run_episodes(env_id, episodes, 0, randomize=False)
    assert len(lengths) == episodes
    assert successes >= 0.99 * episodes


RANDOMIZED = [("bam/reach-v0", 0.99), ("bam/pick-v0", 0.98), ("bam/pick-place-v0", 0.9)]


@pytest.mark.parametrize(("env_id", "least"), RANDOMIZED)
def test_most_do_on_randomized_robots(script, env_id, least):
    successes, _ = script.run_episodes(env_id, 100, 0, randomize=True)
    assert successes >= least * 100


def test_the_table(script, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["scripted_policy.py", "--env", "bam/reach", "--episodes", "3"])
    assert script.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["environment", "success", "episodes", "mean", "steps", "longest", "limit", "time"]
    assert lines[1].split()[:3] == ["bam/reach-v0", "100.00%", "3"]


def test_without_a_name_those_that_have_a_policy(script, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["scripted_policy.py", "--episodes", "1"])
    assert script.main() == 0
    rows = capsys.readouterr().out.splitlines()[1:]
    assert [row.split()[0] for row in rows] == ["bam/reach-v0", "bam/pick-v0", "bam/pick-place-v0"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--env", "bam/pik"], "Unknown environment 'bam/pik'. Did you mean 'bam/pick-v0'?"),
        (["--env", "CartPole"], "Unknown scripted policy 'CartPole-v1'."),
        (["--env", "bam/ur-reach"], "bam/ur-reach-v0 has no scripted policy. These have one: bam/reach-v0, bam/pick"),
        (["--episodes", "0"], "--episodes must be at least 1, not 0"),
    ],
)
def test_bad_arguments(script, capsys, monkeypatch, arguments, text):
    monkeypatch.setattr(sys, "argv", ["scripted_policy.py", *arguments])
    with pytest.raises(SystemExit) as caught:
        script.main()
    assert caught.value.code == 2
    assert text in capsys.readouterr().err
