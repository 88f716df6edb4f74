"""Compare rows of runs: a table, the rule of ``--fail-if``, and a report of one HTML file.

What counts of a run is its last evaluation: not its best, which is high by chance where evaluations are many.
"""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.wording import did_you_mean
from bam_train.cli.console import count, duration, number, percent
from bam_train.errors import OutputError, SettingsError
from bam_train.experiments import seed_statistics as statistics
from bam_train.experiments.run_logs import RunLog, read_runs
from bam_train.experiments.seed_statistics import FEWEST, METHOD, Interval, estimate
from bam_train.files.atomic_file import replacing
from bam_train.files.log_lines import aligned, counted
from bam_train.settings import differences

Array = NDArray[Any]
Metric = Literal["success", "return", "score"]
GOALS = {"success": "until_success", "return": "stop_reward"}
"""Metric to the setting that is its level, unless another one is given."""
ALIKE = ("seed", "threads", "address", "device")
"""Settings in which runs of one row may differ."""
INTERVALS = ("score", "difference", "better", "steps", "seconds")
"""Fields of `RowResult` that are intervals."""
RULES = ("worse", "maybe-worse", "not-better")
"""Of ``--fail-if``; see `RunComparison.failures`."""
_FORMS: dict[str, Callable[[float | None], str]] = {"success": percent, "return": number, "score": number}
_POSITIVE = (0.0, math.inf)
NO_EVALUATION = "no evaluation is in its log; wait for the first one, or leave this run out"
POINTS = 100
"""Points of a drawn curve."""


@dataclass(frozen=True)
class Row:
    """The runs of one folder."""

    name: str
    runs: list[RunLog]

    @cached_property
    def seeds(self) -> list[int] | None:
        """Seed of each run; None if they are not all known."""
        seeds = [run.seed for run in self.runs]
        return None if None in seeds else [seed for seed in seeds if seed is not None]

    def final(self, metric: Metric) -> Array:
        """The last value of each run. Shape: (n,)."""
        return np.array([run.curves[metric].values[-1] for run in self.runs])

    def within(self, metric: str) -> tuple[float, float]:
        """Lowest and highest value of an episode of the runs, beyond which no interval goes."""
        low, high = zip(*(run.curves[metric].within for run in self.runs if metric in run.curves), strict=True)
        return min(low), max(high)


@dataclass(frozen=True)
class RowResult:
    """What a row has reached, and how it compares with the first row."""

    row: str
    seeds: int
    score: Interval
    difference: Interval | None
    better: Interval | None
    """Probability of improvement over the first row."""
    matched: bool
    """Whether runs of equal seeds were compared."""
    reached: int | None
    """Runs that reached the level."""
    steps: Interval | None
    seconds: Interval | None


class RunComparison:
    """Rows of runs of one environment.

    Args:
        places: A folder for each row; see `read_runs`.
        metric: By default success, if all runs know it, else return.
        level: Value of the metric to which steps and time are counted; by default the goal of the runs.

    Raises:
        SettingsError: A folder has no run, two have different environments, or a run does not have the metric.
    """

    def __init__(self, places: Sequence[Path], metric: Metric | None = None, level: float | None = None) -> None:
        names = [place.name for place in places]
        self.rows = [
            Row(place.name if names.count(place.name) == 1 else str(place), read_runs(place)) for place in places
        ]
        self.env = _one_environment(self.rows)
        runs = [run for row in self.rows for run in row.runs]
        self.metric: Metric = metric or ("success" if all("success" in run.curves for run in runs) else "return")
        if lacking := next((run for run in runs if self.metric not in run.curves), None):
            why = f"{self.metric} is not in its log; compare its {' or '.join(lacking.curves)} with --metric"
            raise SettingsError(f"{lacking.place}: {why if lacking.curves else NO_EVALUATION}")
        goals = {run.settings.get(GOALS.get(self.metric, "")) for run in runs}
        self.level: float | None = level if level is not None else goals.pop() if len(goals) == 1 else None
        self.found = [self._compare(row) for row in self.rows]

    def _compare(self, row: Row) -> RowResult:
        values, reached, steps, seconds = row.final(self.metric), None, None, None
        if self.level is not None:
            at = [run.curves[self.metric].reaches(self.level) for run in row.runs]
            reached, steps = sum(math.isfinite(one) for one, _ in at), estimate([one for one, _ in at], _POSITIVE)
            times = [time for _, time in at if time is not None]
            seconds = estimate(times, _POSITIVE) if len(times) == len(at) else None
        first, less, better, matched = self.rows[0], None, None, False
        if row is not first:
            ours, theirs, matched = _matched(row, first, self.metric)
            less, better = statistics.difference(ours, theirs, matched), statistics.improvement(ours, theirs, matched)
        score = estimate(values, row.within(self.metric))
        return RowResult(row.name, len(values), score, less, better, matched, reached, steps, seconds)

    @property
    def notes(self) -> list[str]:
        """The method, hardware and commit, and what a reader must know, a line each."""
        lines = [f"interval: {METHOD}; of P(better) Wilson's"]
        matched = [found.row for found in self.found if found.matched]
        if matched:
            lines.append(f"pairs: of equal seeds ({', '.join(matched)})")
        lines += _origins(self.rows)
        for row in self.rows:
            if len(row.runs) < FEWEST:
                lines.append(f"warning: {row.name} has fewer than {FEWEST} seeds: no interval, and no conclusion")
            if unfinished := [run.place.name for run in row.runs if run.settings and not run.outcome]:
                lines.append(f"warning: {row.name}: not done, or of an older version: {', '.join(unfinished)}")
            others = (name for run in row.runs[1:] for name in _differing(row.runs[0].settings, run.settings))
            if names := list(dict.fromkeys(others)):
                lines.append(f"warning: the runs of {row.name} differ in {', '.join(names)}")
        return lines

    def settings(self) -> list[list[str]]:
        """The settings that differ between rows: a header, and a line of values for each."""
        first = [row.runs[0].settings for row in self.rows]
        names = dict.fromkeys(name for one in first[1:] for name in _differing(first[0], one)) if all(first) else ()
        table = [[name, *(_at(one, name) for one in first)] for name in names]
        return [["setting", *(row.name for row in self.rows)], *table] if table else []

    def table(self) -> list[list[str]]:
        """The comparison as text: a header, and a row for each folder."""
        form = _FORMS[self.metric]
        head = ["row", "seeds", f"{self.metric} (IQM)"]
        if len(self.rows) > 1:
            head += [f"difference from {self.rows[0].name}", "P(better)"]
        if self.level is not None:
            head += [f"reach {form(self.level)}", "steps to it", "time to it"]
        rows = []
        for found in self.found:
            row = [found.row, str(found.seeds), _shown(found.score, form)]
            if len(self.rows) > 1:
                row += [_shown(found.difference, _signed(form)), _shown(found.better, percent)]
            if self.level is not None:
                row += [
                    f"{found.reached} of {found.seeds}",
                    _shown(found.steps, count),
                    _shown(found.seconds, duration),
                ]
            rows.append(row)
        return [head, *rows]

    def text(self, form: str) -> str:
        """The comparison as ``text``, ``md``, ``csv`` or ``json``."""
        if form == "json":
            what = {"env": self.env, "metric": self.metric, "level": self.level, "notes": self.notes}
            return json.dumps({**what, "rows": [_flat(found) for found in self.found]}, allow_nan=False)
        if form == "csv":
            file = io.StringIO()
            writer = csv.DictWriter(file, list(_flat(self.found[0])), lineterminator="\n")
            writer.writeheader()
            writer.writerows(map(_flat, self.found))
            return file.getvalue() + "\n".join(f"# {line}" for line in self.notes)
        title, table = f"{self.metric} of the last evaluation on {self.env or 'one environment'}", self.table()
        if form == "md":
            rule = ["---"] * len(table[0])
            lines = [f"| {' | '.join(row)} |" for row in (table[0], rule, *table[1:])]
            return "\n".join([f"{title}:", "", *lines, "", *(f"- {line}" for line in self.notes)])
        settings = self.settings()
        return "\n".join([title, "", *aligned(table), "", *self.notes, *(["", *aligned(settings)] if settings else [])])

    def report(self, path: Path) -> None:
        """Write one HTML file with the table, pictures and the settings that differ in it; missing folders are made.

        Raises:
            OutputError: It cannot be written.
        """
        parts = [_html_table(self.table()), *(f"<p>{html.escape(line)}</p>" for line in self.notes)]
        for title, image in self._pictures():
            data = base64.b64encode(image).decode()
            parts.append(
                f'<h2>{html.escape(title)}</h2><img alt="{html.escape(title)}" src="data:image/png;base64,{data}">'
            )
        if settings := self.settings():
            parts += ["<h2>Settings that differ</h2>", _html_table(settings)]
        title = html.escape(f"{self.metric} on {self.env or 'one environment'}")
        head = (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
        )
        try:
            with replacing(path) as temporary:
                temporary.write_text(
                    f"{head}</head><body><h1>{title}</h1>{''.join(parts)}</body></html>", encoding="utf-8"
                )
        except OSError as error:
            raise OutputError(
                f"{path}: cannot be written: {error.strerror or error}. Choose another --report"
            ) from error

    def _pictures(self) -> list[tuple[str, bytes]]:
        curves = [[run.curves[self.metric] for run in row.runs] for row in self.rows]
        pictures = [("Learning curves", self._draw("steps", [[one.steps for one in row] for row in curves]))]
        times = [[one.seconds for one in row if one.seconds is not None] for row in curves]
        if sum(map(len, times)) == sum(map(len, curves)):
            pictures.append(("Learning curves over time", self._draw("time [s]", times)))
        finals = [row.final(self.metric) for row in self.rows]
        low, high = (0.0, 1.0) if self.metric == "success" else (min(map(np.min, finals)), max(map(np.max, finals)))
        levels = np.linspace(low, high, POINTS)
        lines = [(levels, statistics.profile(values, levels), None, None) for values in finals]
        drawn = self._plot(lines, f"{self.metric} τ", "share of runs above τ")
        return [*pictures, ("Performance profile", drawn)]

    def _draw(self, axis: str, places: list[list[Array]]) -> bytes:
        """Interquartile means of the runs of each row, with bands, over steps or seconds."""
        lines = []
        for row, each in zip(self.rows, places, strict=True):
            done = all(run.outcome for run in row.runs)  # what a run that has ended had reached, it would keep
            end = (max if done else min)(float(one[-1]) for one in each)
            grid = np.linspace(min(end, max(float(one[0]) for one in each)), end, POINTS)
            values = [run.curves[self.metric].values for run in row.runs]
            curves = np.array([np.interp(grid, *pair) for pair in zip(each, values, strict=True)])
            lines.append((grid, *statistics.bands(curves, row.within(self.metric))))
        return self._plot(lines, axis, f"{self.metric} (interquartile mean, 95 % interval)")

    def _plot(self, lines: Iterable[tuple[Any, ...]], across: str, up: str) -> bytes:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8, 4), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        for row, (grid, middle, low, high) in zip(self.rows, lines, strict=True):
            (line,) = axes.plot(grid, middle, label=f"{row.name} ({counted(len(row.runs), 'seed')})")
            if low is not None:
                axes.fill_between(grid, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
        axes.set_xlabel(across)
        axes.set_ylabel(up, fontsize="small")
        axes.grid(alpha=0.3)
        axes.legend()
        content = io.BytesIO()
        figure.savefig(content, dpi=100, format="png")
        return content.getvalue()

    def failures(self, rule: str) -> list[str]:
        """Which rows break a rule: ``worse``, ``maybe-worse`` or ``not-better``, and ``:MARGIN`` (of the metric).

        A row is worse than the first one if all of the interval of their difference is below minus the margin; maybe
        worse, unless all of it is above that; not better, unless all of it is above the margin.

        Raises:
            SettingsError: It is no rule, or a row has no interval.
        """
        kind, _, least = rule.partition(":")
        if kind not in RULES:
            raise SettingsError(f"--fail-if: there is no rule {kind!r}. {did_you_mean(kind, RULES)}")
        if re.fullmatch(rf"{kind}(:\d+(\.\d+)?)?", rule) is None:
            raise SettingsError(f"--fail-if: expected a margin as in {kind}:0.05, found {rule!r}")
        if len(self.rows) < 2:
            raise SettingsError("--fail-if compares with the first FOLDER; give another one too")
        margin, lines = float(least or 0), []
        for found in self.found[1:]:
            less = found.difference
            if less is None or less.low is None or less.high is None:
                raise SettingsError(
                    f"--fail-if needs {FEWEST} seeds in each row, in {found.row} and {self.rows[0].name}"
                )
            broken = {
                "worse": less.high < -margin,
                "maybe-worse": less.low <= -margin,
                "not-better": less.low <= margin,
            }
            if broken[kind]:
                form = _signed(_FORMS[self.metric])
                lines.append(f"{found.row} is {kind.replace('-', ' ')}: {_shown(less, form)} than {self.rows[0].name}")
        return lines


def summary_lines(group: Path) -> list[str]:
    """The outcome of the seeds in one folder, as lines: a row a seed, and the means with their intervals."""
    row = Row(group.name, read_runs(group))
    table = [["seed", "steps", "time", "success", "return"]]
    for run in row.runs:
        shown = [_FORMS[metric](_last(run, metric)) for metric in GOALS]
        steps, seconds = (run.outcome.get(name) for name in ("steps", "seconds"))
        table.append([str(run.seed), "-" if steps is None else count(steps), duration(seconds), *shown])
    lines = aligned(table)
    for metric in GOALS:
        known = [value for run in row.runs if (value := _last(run, metric)) is not None]
        if known:
            score = _shown(estimate(known, row.within(metric)), _FORMS[metric])
            lines.append(f"{metric} of {counted(len(known), 'seed')}: interquartile mean {score}")
    few = f"warning: fewer than {FEWEST} seeds: no interval, and no conclusion"
    return [*lines, few if len(row.runs) < FEWEST else f"interval: {METHOD}", *_origins([row])]


def _last(run: RunLog, metric: str) -> float | None:
    return float(run.curves[metric].values[-1]) if metric in run.curves else None


def _one_environment(rows: Sequence[Row]) -> str | None:
    """The environment of all runs, as far as they know it; refuses several."""
    places: dict[str, str] = {}
    for row in rows:
        for run in row.runs:
            if run.env is not None:
                places.setdefault(run.env, row.name)
    if len(places) > 1:
        found = ", ".join(f"{env} ({name})" for env, name in places.items())
        raise SettingsError(f"runs of different environments cannot be compared: {found}. Leave one of them out")
    return next(iter(places), None)


def _matched(row: Row, first: Row, metric: Metric) -> tuple[Array, Array, bool]:
    """The last values of both rows; of the seeds that both have, in the same order, if these are enough."""
    ours, theirs = row.final(metric), first.final(metric)
    if row.seeds is None or first.seeds is None:
        return ours, theirs, False
    both = sorted({*row.seeds} & {*first.seeds})
    if len(both) < FEWEST:
        return ours, theirs, False
    places = [[one.index(seed) for seed in both] for one in (row.seeds, first.seeds)]
    return ours[places[0]], theirs[places[1]], True


def _differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Names of the settings in which two runs differ."""
    rows = [*differences(one, other), *differences(other, one)]
    return list(dict.fromkeys(name for name, _, _ in rows if name not in ALIKE))


def _at(settings: Mapping[str, Any], name: str) -> str:
    """A setting, whose name may have dots, as JSON; a dash if it is not there."""
    found: Any = settings
    for part in name.split("."):
        if not isinstance(found, Mapping) or part not in found:
            return "-"
        found = found[part]
    return json.dumps(found)


def _origins(rows: Sequence[Row]) -> list[str]:
    """On what and with what the runs were made: one line of each if they agree, else one of each row."""
    lines = []
    facts: dict[str, Callable[[RunLog], str | None]] = {
        "hardware": lambda run: run.outcome.get("hardware"),
        "commit": lambda run: run.commit and run.commit[:12],
    }
    for title, fact in facts.items():
        said = {row.name: dict.fromkeys(text for run in row.runs if (text := fact(run))) for row in rows}
        known = {name: "; ".join(texts) or "not known" for name, texts in said.items()}
        if len({*known.values()}) == 1:
            lines.append(f"{title}: {known[rows[0].name]}")
        else:
            lines += [f"{title} of {name}: {text}" for name, text in known.items()]
    return lines


def _shown(found: Interval | None, form: Callable[[float], str]) -> str:
    """An estimate and its interval as text."""
    if found is None:
        return "-"
    value, *ends = (
        form(one) if math.isfinite(one) else "never" for one in (found.value, found.low, found.high) if one is not None
    )
    return f"{value} ({ends[0]} to {ends[1]})" if ends else value


def _signed(form: Callable[[float], str]) -> Callable[[float], str]:
    return lambda value: f"{'+' if value >= 0 else '-'}{form(abs(value))}"


def _flat(found: RowResult) -> dict[str, Any]:
    """The numbers of a row under names such as ``score_low``; None for infinity, and what is not known."""
    flat: dict[str, Any] = {}
    for name, value in vars(found).items():
        if name in INTERVALS:
            ends = (None, None, None) if value is None else (value.value, value.low, value.high)
            for end, number in zip(("", "_low", "_high"), ends, strict=True):
                flat[f"{name}{end}"] = None if number is None or not math.isfinite(number) else number
        else:
            flat[name] = value
    return flat


def _html_table(rows: list[list[str]]) -> str:
    cells = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


_STYLE = """
body {font: 15px sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em}
table {border-collapse: collapse}
td {border-bottom: 1px solid #ccc; padding: 0.3em 0.8em 0.3em 0}
tr:first-child {font-weight: bold}
img {max-width: 100%}
"""
