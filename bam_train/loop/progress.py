"""What a TemporalAgent shows while it runs: steps, steps per second, time left; below a microsecond a step."""

import importlib
import io
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

REDRAW_SECONDS = 0.1
Advance = Callable[[int], None]


class StepsPerSecond(ProgressColumn):
    """``5,200 steps/s``, over the last seconds while it runs and over the whole run at its end."""

    def render(self, task: Task) -> Text:
        """The speed of one task, empty until it is known."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:,.0f} steps/s" if speed >= 10 else f"{speed:.2g} steps/s")


@contextmanager
def progress_display(
    progress: bool | Progress,
    n_steps: int | None,
    t: int = 0,
    description: str = "steps",
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[Advance]:
    """Shows how far a loop has come; gives a function to be called with the number of steps just done.

    A loop that ends early is shown as finished; one that an exception leaves stays where it was.

    Args:
        progress: The caller's display, which gets one more task, or True for one on stderr, drawn on a terminal and in
            a notebook only.
        n_steps: The most steps there will be; None where only a stop variable ends the loop.
        t: The time of the first step.
        description: What is written in front of the bar.
        clock: Seconds, for the time between two pictures.
    """
    shown: AbstractContextManager[Any] = nullcontext()
    if isinstance(progress, Progress):
        display, redraw = progress, _nothing
    else:
        console = Console(stderr=True)
        display = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            StepsPerSecond(),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
            auto_refresh=False,  # no thread: the loop itself redraws
            redirect_stdout=sys.stdout.isatty(),  # what is printed goes above the bar; into a file it goes as always
            disable=not (console.is_terminal or console.is_jupyter),
        )
        if console.is_jupyter:
            redraw = _notebook_line(display)
        else:
            shown, redraw = display, display.refresh
    text = f"{description} from t={t}" if t else description
    with shown, _task(display, n_steps, text, redraw, clock) as advance:
        yield advance


def _nothing() -> None:
    """Draw nothing: the caller does."""


@contextmanager
def _task(
    progress: Progress, n_steps: int | None, text: str, redraw: Callable[[], None], clock: Callable[[], float]
) -> Iterator[Advance]:
    """One task of a display, updated every REDRAW_SECONDS."""
    task, done = progress.add_task(text, total=n_steps), 0
    due = clock() + REDRAW_SECONDS

    def show(total: int | None = None) -> None:
        progress.update(task, completed=done, total=total)  # a total of None leaves it as it is
        redraw()

    def advance(steps: int) -> None:
        nonlocal done, due
        done += steps
        if clock() >= due:
            show()
            due = clock() + REDRAW_SECONDS

    redraw()
    total = None
    try:
        yield advance
        total = done
    finally:
        progress.stop_task(task)
        show(total)


def _notebook_line(display: Progress) -> Callable[[], None]:
    """One line of a notebook's output that is written over; rich itself needs ipywidgets for this."""
    show_in_notebook = importlib.import_module("IPython.display").display
    handle: Any = None

    def redraw() -> None:
        nonlocal handle
        text = io.StringIO()
        console = Console(file=text, width=100, force_terminal=False, force_jupyter=False, color_system=None)
        console.print(display.get_renderable())
        line = {"text/plain": text.getvalue().rstrip()}
        if handle is None:
            handle = show_in_notebook(line, raw=True, display_id=True)
        else:
            handle.update(line, raw=True)

    return redraw
