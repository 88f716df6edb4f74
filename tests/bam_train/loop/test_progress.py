"""The progress display, drawn into text; time stands still but for what a test lets pass."""

import builtins
import io
import sys
import types

import pytest
from rich.console import Console
from rich.progress import Progress

from bam_train.loop import Agent, TemporalAgent, Workspace
from bam_train.loop.progress import StepsPerSecond, progress_display


@pytest.fixture
def clock():
    """A clock that goes on by `clock.step` seconds whenever it is read."""

    class Clock:
        now, step = 0.0, 0.0

        def __call__(self):
            self.now += self.step
            return self.now

    return Clock()


@pytest.fixture
def terminal(monkeypatch, capsys):
    """Standard error as a terminal; a function that gives what was drawn on it since the last call."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    return lambda: capsys.readouterr().err


def last_line(text):
    for code in ("\x1b[2K", "\x1b[?25h", "\x1b[?25l", "\x1b[0m", "\x1b[1A"):
        text = text.replace(code, "")
    return text.replace("\r", "\n").strip().splitlines()[-1]


def fail(error, *args, **kwargs):
    """Forty steps, then an exception."""
    with progress_display(*args, **kwargs) as advance:
        advance(40)
        raise error


def undrawn():
    """A rich.progress.Progress that is never drawn."""
    return Progress(console=Console(file=io.StringIO()), auto_refresh=False)


def test_a_display_of_the_callers_gets_a_task_and_keeps_it(clock):
    display = undrawn()
    with progress_display(display, 10, 0, "rollout", clock=clock) as advance:
        (task,) = display.tasks
        assert (task.description, task.total, task.completed) == ("rollout", 10, 0)
        for _ in range(10):
            advance(1)
        assert task.completed == 0  # no time has passed
    assert (task.completed, task.total, task.finished) == (10, 10, True)
    with progress_display(display, 5, 10, "rollout", clock=clock) as advance:
        advance(5)
    assert [one.description for one in display.tasks] == ["rollout", "rollout from t=10"]


def test_a_task_is_told_ten_times_a_second(clock):
    display, seen = undrawn(), []
    clock.step = 0.03
    with progress_display(display, 100, clock=clock) as advance:
        for _ in range(20):
            advance(1)
            seen.append(display.tasks[0].completed)
    assert seen == [0] * 3 + [4] * 4 + [8] * 4 + [12] * 4 + [16] * 4 + [20]


@pytest.mark.parametrize("n_steps", [100, None])
def test_a_loop_that_stops_early_or_has_no_known_length_is_finished(clock, n_steps):
    display = undrawn()
    with progress_display(display, n_steps, clock=clock) as advance:
        assert display.tasks[0].total == n_steps
        advance(7)
    (task,) = display.tasks
    assert (task.completed, task.total, task.finished) == (7, 7, True)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_exception_leaves_the_task_stopped_where_it_was(clock, error):
    display = undrawn()
    with pytest.raises(error):
        fail(error, display, 100, clock=clock)
    (task,) = display.tasks
    assert (task.completed, task.total, task.finished) == (40, 100, False)
    assert task.stop_time is not None


def test_a_display_of_its_own_on_a_terminal(clock, terminal):
    clock.step = 0.011
    with progress_display(True, 1000, 0, "[red]rollout[/red]", clock=clock) as advance:
        terminal()
        for _ in range(95):
            advance(1)
        drawn = terminal()
    assert 5 <= drawn.count("/1000 ") <= 10
    text = terminal()
    assert last_line(text).startswith("[red]rollout[/red] ")
    assert " 95/95 " in last_line(text)
    assert text.endswith("\x1b[?25h")  # the cursor is back


def test_speed():
    column, task = StepsPerSecond(), types.SimpleNamespace(finished_speed=None, speed=None)
    assert column.render(task).plain == ""
    task.speed = 5234.4
    assert column.render(task).plain == "5,234 steps/s"
    task.finished_speed = 0.25
    assert column.render(task).plain == "0.25 steps/s"


def test_nothing_is_drawn_into_a_file(capsys):
    with progress_display(True, 10) as advance:
        advance(10)
        print("result")
    assert capsys.readouterr() == ("result\n", "")


def test_in_a_notebook_one_output_is_written_over(clock, monkeypatch):
    outputs = []

    def display(data, raw, display_id):
        outputs.append(data["text/plain"])
        return types.SimpleNamespace(update=lambda data, raw: outputs.append(data["text/plain"]))

    ipython = types.ModuleType("IPython.display")
    ipython.display = display
    monkeypatch.setitem(sys.modules, "IPython", types.ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", ipython)
    notebook = type("ZMQInteractiveShell", (), {})  # as notebooks call theirs
    monkeypatch.setitem(vars(builtins), "get_ipython", notebook)
    clock.step = 0.06
    with progress_display(True, 4, 0, "rollout", clock=clock) as advance:
        for _ in range(4):
            advance(1)
    assert len(outputs) == 4
    assert [output.startswith("rollout ") for output in outputs] == [True] * 4
    assert [" 2/4 " in outputs[1], " 4/4 " in outputs[-1]] == [True, True]
    assert "\n" not in outputs[-1]


class Nothing(Agent):
    def forward(self, t, at=None, **kwargs):
        if t == at:
            raise ValueError("broken")


@pytest.mark.parametrize("name", [None, "eval"])
def test_a_temporal_agent_shows_its_steps(name):
    display = undrawn()
    TemporalAgent(Nothing(), name=name, progress=display)(Workspace(), t=3, n_steps=5)
    (task,) = display.tasks
    assert (task.description, task.completed, task.finished) == (f"{name or 'steps'} from t=3", 5, True)


def test_a_copy_of_a_temporal_agent_can_be_made():
    copy = TemporalAgent(Nothing(), progress=undrawn()).clone()
    copy(Workspace(), n_steps=2)
    assert TemporalAgent(Nothing(), progress=True).clone().progress is True


def test_without_a_display_rich_is_not_needed(monkeypatch):
    monkeypatch.delitem(sys.modules, "bam_train.loop.progress")
    monkeypatch.setitem(sys.modules, "rich.progress", None)
    ws = Workspace()
    TemporalAgent(Nothing())(ws, n_steps=2)
    with pytest.raises(ImportError):
        TemporalAgent(Nothing(), progress=True)(ws, n_steps=2)
