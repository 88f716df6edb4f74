"""The progress display, drawn into text; time stands still but for what a test lets pass."""

import io
import sys
import types

import pytest
from rich.console import Console
from rich.progress import Progress

from bam_train.loop import Agent, TemporalAgent, Workspace, progress
from bam_train.loop.progress import progress_display


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on by `clock.step` seconds whenever it is read."""

    class Clock:
        now, step = 0.0, 0.0

        def __call__(self):
            self.now += self.step
            return self.now

    fake = Clock()
    monkeypatch.setattr(progress.time, "perf_counter", fake)
    return fake


@pytest.fixture
def terminal(monkeypatch):
    """Standard error as a terminal; its text."""
    text = io.StringIO()
    made = []

    def console(**kwargs):
        assert kwargs == {"stderr": True}
        made.append(Console(file=text, force_terminal=True, force_jupyter=False, width=100, color_system=None))
        return made[-1]

    monkeypatch.setattr(progress, "Console", console)
    return text


def last_line(text):
    return text.getvalue().replace("\r", "\n").replace("\x1b[2K", "").replace("\x1b[?25h", "").strip().splitlines()[-1]


def fail(error, *args):
    """Forty steps, then an exception."""
    with progress_display(*args) as advance:
        advance(40)
        raise error


class Undrawn:
    """A rich.progress.Progress that is never drawn."""

    def __new__(cls):
        return Progress(console=Console(file=io.StringIO()), auto_refresh=False)


def test_a_display_of_the_callers_gets_a_task_and_keeps_it(clock):
    display = Undrawn()
    with progress_display(display, 10, 0, "rollout") as advance:
        (task,) = display.tasks
        assert (task.description, task.total, task.completed) == ("rollout", 10, 0)
        for _ in range(10):
            advance(1)
        assert task.completed == 0  # no time has passed
    assert (task.completed, task.total, task.finished) == (10, 10, True)
    with progress_display(display, 5, 10, "rollout") as advance:
        advance(5)
    assert [one.description for one in display.tasks] == ["rollout", "rollout from t=10"]


def test_a_task_is_told_ten_times_a_second(clock):
    display, seen = Undrawn(), []
    clock.step = 0.03
    with progress_display(display, 100) as advance:
        for _ in range(20):
            advance(1)
            seen.append(display.tasks[0].completed)
    assert seen == [0] * 3 + [4] * 4 + [8] * 4 + [12] * 4 + [16] * 4 + [20]
    assert display.tasks[0].completed == 20


def test_a_loop_that_stops_early_is_finished(clock):
    display = Undrawn()
    with progress_display(display, 100) as advance:
        advance(7)
    (task,) = display.tasks
    assert (task.completed, task.total, task.finished) == (7, 7, True)


def test_a_loop_without_a_known_length(clock):
    display = Undrawn()
    with progress_display(display, None) as advance:
        assert display.tasks[0].total is None
        advance(3)
    (task,) = display.tasks
    assert (task.completed, task.total, task.finished) == (3, 3, True)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_exception_leaves_the_task_stopped_where_it_was(clock, error):
    display = Undrawn()
    with pytest.raises(error):
        fail(error, display, 100)
    (task,) = display.tasks
    assert (task.completed, task.total, task.finished) == (40, 100, False)
    assert task.stop_time is not None


def test_a_display_of_its_own_on_a_terminal(clock, terminal):
    with progress_display(True, 1000, 0, "rollout") as advance:
        for _ in range(1000):
            advance(1)
    line = last_line(terminal)
    assert line.startswith("rollout ")
    assert " 1000/1000 " in line
    assert terminal.getvalue().endswith("\n\x1b[?25h")  # the cursor is back


def test_a_display_of_its_own_is_drawn_ten_times_a_second(clock, terminal):
    clock.step = 0.011
    with progress_display(True, 1000) as advance:
        before = terminal.getvalue().count("\r")
        for _ in range(95):
            advance(1)
        assert terminal.getvalue().count("\r") - before <= 10
    assert " 95/95 " in last_line(terminal)


def test_speed(clock, terminal):
    column = progress.StepsPerSecond()

    class Task:
        finished_speed, speed = None, None

    assert column.render(Task).plain == ""
    Task.speed = 5234.4
    assert column.render(Task).plain == "5,234 steps/s"
    Task.finished_speed = 0.25
    assert column.render(Task).plain == "0.25 steps/s"


def test_a_display_of_its_own_ends_with_the_exception(clock, terminal):
    with pytest.raises(ValueError):  # noqa: PT011 - raised here
        fail(ValueError, True, 1000, 5, "rollout")
    assert last_line(terminal).startswith("rollout from t=5 ")
    assert " 40/1000 " in last_line(terminal)
    assert terminal.getvalue().endswith("\n\x1b[?25h")


def test_text_in_brackets_is_text(clock, terminal):
    with progress_display(True, 1, 0, "[red]x[/red]") as advance:
        advance(1)
    assert last_line(terminal).startswith("[red]x[/red] ")


def test_nothing_is_drawn_into_a_file(capsys):
    with progress_display(True, 10) as advance:
        advance(10)
    assert capsys.readouterr() == ("", "")


def test_what_is_printed_into_a_file_stays_there(clock, terminal, capsys):
    with progress_display(True, 10) as advance:
        advance(5)
        print("result")
    assert capsys.readouterr().out == "result\n"
    assert "result" not in terminal.getvalue()


def test_in_a_notebook_one_output_is_written_over(clock, monkeypatch):
    outputs = []

    class Handle:
        def update(self, data, raw):
            outputs.append(data["text/plain"])

    def display(data, raw, display_id):
        assert raw
        assert display_id
        outputs.append(data["text/plain"])
        return Handle()

    ipython = types.ModuleType("IPython.display")
    ipython.display = display
    monkeypatch.setitem(sys.modules, "IPython", types.ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", ipython)
    monkeypatch.setattr(progress, "Console", lambda **kwargs: Console(**{"force_jupyter": True, **kwargs}))
    clock.step = 0.06
    with progress_display(True, 4, 0, "rollout") as advance:
        for _ in range(4):
            advance(1)
    assert len(outputs) == 4
    assert [output.startswith("rollout ") for output in outputs] == [True] * 4
    assert [" 2/4 " in outputs[1], " 4/4 " in outputs[-1]] == [True, True]
    assert "\n" not in outputs[-1]


class Nothing(Agent):
    def forward(self, t, **kwargs):
        pass


@pytest.mark.parametrize("name", [None, "eval"])
def test_a_temporal_agent_shows_its_steps(name):
    display = Undrawn()
    TemporalAgent(Nothing(), name=name, progress=display)(Workspace(), t=3, n_steps=5)
    (task,) = display.tasks
    assert (task.description, task.completed, task.finished) == (f"{name or 'steps'} from t=3", 5, True)


def test_a_temporal_agent_that_fails_stops_its_task():
    class Broken(Agent):
        def forward(self, t, **kwargs):
            if t == 2:
                raise ValueError("broken")

    display = Undrawn()
    with pytest.raises(ValueError, match="broken"):
        TemporalAgent(Broken(), progress=display)(Workspace(), n_steps=5)
    (task,) = display.tasks
    assert (task.completed, task.finished) == (2, False)
    assert task.stop_time is not None


def test_a_copy_of_a_temporal_agent_can_be_made():
    display = Undrawn()
    copy = TemporalAgent(Nothing(), progress=display).clone()
    copy(Workspace(), n_steps=2)
    assert TemporalAgent(Nothing(), progress=True).clone().progress is True


def test_without_a_display_rich_is_not_needed(monkeypatch):
    monkeypatch.delitem(sys.modules, "bam_train.loop.progress")
    monkeypatch.setitem(sys.modules, "rich.progress", None)
    ws = Workspace()
    TemporalAgent(Nothing())(ws, n_steps=2)
    with pytest.raises(ImportError):
        TemporalAgent(Nothing(), progress=True)(ws, n_steps=2)
