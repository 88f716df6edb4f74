"""The progress display of a TemporalAgent: steps, steps per second, time left; costs less than a microsecond a step."""

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
    """Show the progress of a loop; yields a function to be called with the number of steps just done.

    A loop that ends early is shown as finished; one that ends with an exception keeps its last position.

    Args:
        progress: The caller's display, to which a task is added, or True for a new one on stderr, drawn only on a
            terminal and in a notebook.
        n_steps: The maximum number of steps; None where only a stop variable ends the loop.
        t: The time of the first step.
        description: The text in front of the bar.
        clock: Time in seconds, for the interval between two updates of the display.
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
            redirect_stdout=sys.stdout.isatty(),  # prints appear above the bar; a file gets them as usual
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
    """Do nothing: the caller draws its display."""


@contextmanager
def _task(
    progress: Progress, n_steps: int | None, text: str, redraw: Callable[[], None], clock: Callable[[], float]
) -> Iterator[Advance]:
    """Add a task to a display, and update it every REDRAW_SECONDS."""
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
    """Return a function that rewrites one line of a notebook's output, for which rich itself needs ipywidgets."""
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
