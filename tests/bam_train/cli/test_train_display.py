"""What a run looks like, on a terminal and elsewhere."""

from __future__ import annotations

import io
import sys

import pytest

from bam_train.cli.train_display import LiveDisplay, PlainDisplay
from bam_train.evaluation import EvaluationReport
from bam_train.trainers.base import Progress, Statistics


def statistics(success):
    return Statistics(episodes=9, return_mean=1.23456, length_mean=20.0, success_rate=success, metrics={})


def progress(steps):
    return Progress(steps, 300_000, lambda: statistics(0.5))


REPORT = EvaluationReport("bam/pick-v0", 100, 0, 97, 0.97, (0.915, 0.99), 38.5, 1.0, 1.0, 2.0, 37.2, 1.0)


def test_plain_lines_about_once_a_second(capsys):
    now = [10.0]
    with PlainDisplay("ppo on bam/pick-v0", clock=lambda: now[0]) as display:
        for _ in range(5):
            display.training(progress(12_288), statistics(0.5), 5164.3, 55.7)
            now[0] += 0.6
    expected = "12.29k of 300k steps  5,164 steps/s  success 50 %  return 1.235  at most 55.7 s of training left"
    assert capsys.readouterr() == ("", "\n".join(["ppo on bam/pick-v0", expected, expected, expected, ""]))


@pytest.mark.parametrize(
    ("left", "text"), [(-0.6, "at most 0.0 s of training left"), (None, "training left: not known yet")]
)
def test_without_success_and_past_the_end(capsys, left, text):
    PlainDisplay("").training(progress(303_104), statistics(None), 5000.0, left)
    assert capsys.readouterr().err == f"303.1k steps  5,000 steps/s  return 1.235  {text}\n"


@pytest.mark.parametrize(("best", "end"), [(True, ", the best so far"), (False, "")])
def test_evaluations(capsys, best, end):
    PlainDisplay("").evaluated(151_552, REPORT, best)
    line = "evaluation at 151.6k steps: success 97 %, return 38.5, 37 steps an episode (100 episodes)"
    assert capsys.readouterr().err == f"{line}{end}\n"


class Terminal(io.StringIO):
    """Standard error of a person."""

    def isatty(self):
        return True


def test_a_terminal_gets_a_panel(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "90")
    with LiveDisplay("ppo on bam/pick-v0, seed 0") as display:
        display.training(progress(12_288), statistics(0.5), 5164.3, 55.7)
        display.evaluated(12_288, REPORT, best=True)
    shown = stream.getvalue()
    title = "ppo on bam/pick-v0, seed 0"
    for words in (title, "12.29k of 300k steps", "5,164 steps/s", "50 %", "training left, at most", "55.7 s", "97 %"):
        assert words in shown
    assert "[dim]" not in shown
