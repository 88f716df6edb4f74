"""Agents for the local environments: they learn, and each draws its picture."""

import sys

import numpy as np
import pytest

from bam_train.checkpoint import Checkpoint
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy


@pytest.fixture
def play(load_script, tmp_path, monkeypatch, capsys):
    """A function: what a script prints, run in this process in an empty folder; its picture must be there."""

    def play(name, *arguments, picture):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        assert load_script(name).main() == 0
        assert (tmp_path / picture).read_bytes()[:4] == b"\x89PNG"
        return capsys.readouterr().out

    return play


def numbers(line):
    return [float(word.rstrip("%,;")) for word in line.split() if word.rstrip("%,;").replace(".", "").isdigit()]


def test_bandit_agents_find_the_best_arm(play, load_script):
    lines = play("bandit_agents", "--runs", 50, "--steps", 300, "--arms", 5, picture="bandit-agents.png").splitlines()
    assert [line.partition(":")[0] for line in lines] == ["epsilon-greedy", "UCB", "Thompson"]
    assert all(numbers(line)[1] > least for line, least in zip(lines, (0.75, 0.85, 0.95), strict=True))
    script = load_script("bandit_agents")
    rewards = script.play(script.thompson, "bam/context-bandit-v0", 20, 400, 0, n_state=3)
    assert rewards.shape == (400,)
    assert rewards[:20].mean() < 0.6 < 0.9 < rewards[-20:].mean()


def test_simple_agents(play):
    lines = play("simple_agents", "--steps", 60, picture="simple-agents.png").splitlines()
    rates = {line.partition(":")[0]: numbers(line)[0] for line in lines}
    assert list(rates) == ["constant", "random", "scripted"]
    assert rates["constant"] < 0.1
    assert rates["random"] < 0.1
    assert 0.27 < rates["scripted"] < 0.33
    given = ("--env", "bam/digits", "--agents", "random", "--steps", 30)
    (line,) = play("simple_agents", *given, picture="simple-agents.png").splitlines()
    assert 0.05 < numbers(line)[0] < 0.15


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--env", "bam/pick"], "--env: bam/pick-v0 is no local environment; bam-envs lists them"),
        (["--env", "bam/digits", "--agents", "scripted"], "scripted is for bam/grid-world, not for bam/digits-v0"),
        (["--env", "bam/gridworld"], "Unknown environment 'bam/gridworld'. Did you mean 'bam/grid-world-v0'?"),
    ],
)
def test_what_simple_agents_refuse(load_script, monkeypatch, capsys, arguments, text):
    monkeypatch.setattr(sys, "argv", ["simple_agents", *arguments])
    with pytest.raises(SystemExit):
        load_script("simple_agents").main()
    assert text in capsys.readouterr().err


def test_tabular_q_walks_the_shortest_way(play):
    said = play("tabular_q", "--size", 3, "--steps", 1500, picture="tabular-q.png")
    _, walked, shortest = numbers(said)
    assert walked == shortest


def test_linucb_reads_digits_that_it_has_not_seen(play):
    learnt, tested = numbers(play("linucb_digits", "--steps", 300, picture="linucb-digits.png"))
    assert learnt > 80
    assert tested > 90


@pytest.mark.training
def test_a_q_for_each_pixel(play, tmp_path):
    play("pixel_q", "--steps", 50, "--num-envs", 16, "--checkpoint", "grasp.zip", picture="pixel-q.png")
    policy = FrozenPolicy.from_checkpoint(Checkpoint.open(tmp_path / "grasp.zip"))
    report = evaluate(policy, "bam/grasp-xy-v0", {}, episodes=50, seed=1)
    assert report.success_rate >= 0.9
    assert np.isfinite(report.return_mean)
