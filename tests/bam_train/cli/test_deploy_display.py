import io
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

from bam_envs.core.timing import Pacer
from bam_train.cli.deploy_display import LiveDeployment, PlainDeployment, live_display, numbers_of
from bam_train.deploy.journal import Journal


class Panel:
    """Counts redraws."""

    def __init__(self):
        self.updates, self.console = 0, Console(file=io.StringIO())

    def update(self, panel, refresh):
        self.updates += 1


class Slack:
    """A pacer with so much time left."""

    period, rate, lateness, missed = None, 10.0, None, 0

    def __init__(self, slack):
        self.slack = slack


@pytest.mark.parametrize(
    ("success", "end", "length", "line"),
    [
        (True, "terminated", 47, "success after 47 steps, return 12.31"),
        (False, "truncated", 100, "no success after 100 steps, return 12.31"),
        (None, "truncated", 1, "truncated after 1 step, return 12.31"),
    ],
)
def test_plain_display_writes_a_line_an_episode(success, end, length, line):
    journal, lines, pacer = Journal(5), [], Pacer(None)
    display, record = PlainDeployment(journal, lines.append), journal.begin(8)
    display.ticked(record, 1, pacer)
    assert lines == []
    record.total, record.length, record.success, record.end = 12.3123, length, success, end
    display.ended(record)
    assert lines == [f"episode 1/5 (seed 8): {line}"]


@pytest.mark.parametrize(
    ("typed", "answer", "asked"),
    [
        (["yes\n"], True, 1),
        (["y\n", " NO \n"], False, 2),
        (["\n", "\n", "\n"], None, 3),
        (["\x04"] * 3, None, 3),
        (["y\nyes\n", "no\n"], False, 2),
    ],
    ids=["yes", "no", "neither", "end of input", "two lines"],
)
@pytest.mark.parametrize("panel", [False, True])
def test_who_stands_beside_the_robot_is_asked_and_answers_after_the_question(
    corridor, person, typed, answer, asked, panel
):
    screen = io.StringIO()
    shown = person(screen, typed, ahead="no\nyes\nye")
    journal = Journal(1 + panel)
    display, record = PlainDeployment(journal, shown.write), journal.begin(8)
    if panel:
        console = Console(file=shown, width=150)
        display = LiveDeployment(SimpleNamespace(console=console), gym.make(corridor), "t", journal)
    assert display.judge(record) is answer
    question = "Did it do its task in the episode with seed 8? Type yes or no"
    question += "; the next episode begins then:" if panel else ":"
    assert screen.getvalue().count(question) == asked


def test_a_warning_is_written_once():
    journal, lines = Journal(1), []
    display, record = PlainDeployment(journal, lines.append), journal.begin(0)
    journal.warn(["late ticks (G15): 6 of the last 100 commands were late"])
    display.ticked(record, 1, Pacer(None))
    journal.warn(["late ticks (G15): 7 of the last 100 commands were late"])
    display.ticked(record, 1, Pacer(None))
    assert lines == ["warning: late ticks (G15): 6 of the last 100 commands were late"]
    assert display.has_written("late ticks (G15): 7 of the last 100 commands were late")
    assert not display.has_written("link quality (G16): only 93 of the last 100 ticks")


def test_redraws_are_rare_and_only_when_there_is_time(corridor):
    times = iter([0.0, 0.05, 0.1, 0.3, 0.31, 0.4])
    panel, journal = Panel(), Journal(1)
    display = LiveDeployment(panel, gym.make(corridor), "title", journal, now=lambda: next(times))
    record = journal.begin(0)
    drawn = []
    for slack in (0.04, 0.04, 0.04, 0.005, 0.04, 0.04):
        display.ticked(record, 1, Slack(slack))
        drawn.append(panel.updates)
    assert drawn == [1, 1, 2, 2, 3, 3]


def test_numbers_of_an_action_and_of_a_robot():
    env = gym.make("bam/pick-v0")
    action = np.array([0.5, 0.0, -1.0, 0.0, 1.0], np.float32)
    assert numbers_of(env, action) == {"action": "dx +0.500 dy +0.000 dz -1.000 dyaw +0.000 grip +1.000"}
    env.reset(seed=0)
    rows = numbers_of(env, action)
    signals = ["joint position", "joint velocity", "gripper width", "object position", "object quaternion"]
    assert list(rows) == ["action", *signals]
    assert rows["joint velocity"].endswith(" rad/s")
    assert len(rows["joint position"].split()) == 7
    assert len(rows["object quaternion"].split()) == 4
    env.close()


@pytest.mark.parametrize(("action", "text"), [(np.int64(3), "3"), (np.array([1, 0]), "1 0"), (np.zeros(100), None)])
def test_choices_and_long_actions_of_an_environment_that_describes_nothing(action, text):
    env = gym.make("CartPole-v1")
    env.reset(seed=0)
    assert numbers_of(env, action) == {"action": text or " ".join(["+0.000"] * 16)}


def test_panel_fits_a_screen_and_says_it_all():
    env, journal, screen = gym.make("bam/pick-v0"), Journal(2), io.StringIO()
    env.reset(seed=0)
    console = Console(file=screen, force_terminal=True, width=100, height=24, color_system=None)
    pacer = Pacer(0.05, now=lambda: 0.0, sleep=lambda seconds: None)
    pacer.start()
    pacer.wait()
    with live_display(console, env, "pick.zip on bam/pick-v0", journal) as display:
        record = journal.begin(4)
        journal.step(0.25, False)
        display.ticked(record, np.zeros(5, np.float32), pacer)
    env.close()
    lines = [line.rstrip() for line in screen.getvalue().replace("\x1b[2K", "").splitlines()]
    assert any(line.endswith("pick.zip on bam/pick-v0") for line in lines)
    assert any(line.startswith("episode") and line.endswith("1 of 2, 0 succeeded") for line in lines)
    assert any(line.startswith("step") and line.endswith("1, return 0.25") for line in lines)
    assert any(line.startswith("loop") and line.endswith("no rate yet of 20") for line in lines)
    assert any("p50 0.00 ms, p99 0.00 ms, max 0.00 ms, no deadline missed" in line for line in lines)
    assert not any(line.strip() == "..." for line in lines)


def test_panel_shows_every_number_of_an_action_on_a_narrow_screen():
    env, screen = gym.make("bam/ur-reach-v0"), io.StringIO()
    env.reset(seed=0)
    console = Console(file=screen, force_terminal=True, width=80, height=24, color_system=None)
    journal = Journal(1)
    with live_display(console, env, "ur-reach.zip", journal) as display:
        display.ticked(journal.begin(0), np.arange(1, 6, dtype=np.float32) / 8, Pacer(None))
    env.close()
    assert [number in screen.getvalue() for number in ("+0.125", "+0.250", "+0.375", "+0.500", "+0.625")] == [True] * 5
