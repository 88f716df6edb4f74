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
    ("env_id", "randomize", "least"),
    [
        ("bam/reach-v0", False, 0.99),
        ("bam/pick-v0", False, 0.99),
        ("bam/pick-place-v0", False, 0.99),
        ("bam/reach-v0", True, 0.99),
        ("bam/pick-v0", True, 0.97),
        ("bam/pick-place-v0", True, 0.9),
    ],
)
def test_almost_every_episode_succeeds(script, env_id, randomize, least):
    """On randomized robots most do."""
    successes, lengths = script.run_episodes(env_id, 128, 0, randomize=randomize)
    assert len(lengths) == 128
    assert successes >= least * 128


def test_the_table(script, capsys, monkeypatch):
    """Without a name, of those that have a policy."""
    monkeypatch.setattr(sys, "argv", ["scripted_policy.py", "--episodes", "3"])
    assert script.main() == 0
    head, *lines = (line.split() for line in capsys.readouterr().out.splitlines())
    assert head == ["environment", "success", "episodes", "mean", "steps", "longest", "limit", "time"]
    ids = ("bam/reach-v0", "bam/pick-v0", "bam/pick-place-v0")
    assert [line[:3] for line in lines] == [[env_id, "100.00%", "3"] for env_id in ids]


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
