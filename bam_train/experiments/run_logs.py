"""Read what runs have logged: our run folders, TensorBoard files, stable-baselines3's Monitor files, rl-zoo3's logs."""

from __future__ import annotations

import csv
import json
import math
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_train.checkpoint import Checkpoint
from bam_train.errors import CheckpointError, SettingsError
from bam_train.trainers.run_folder import read_object, read_records

Array = NDArray[Any]
SUCCESS_TAGS = ("eval/success_rate", "rollout/success_rate")
RETURN_TAGS = (
    *("eval/return_mean", "eval/mean_reward", "rollout/ep_rew_mean"),
    "ray/tune/evaluation/env_runners/episode_return_mean",
    *("ray/tune/env_runners/episode_return_mean", "ray/tune/env_runners/episode_reward_mean"),
    "ray/tune/episode_reward_mean",
)
"""Names in TensorBoard files, the first that is there counts: ours, stable-baselines3's, RLlib's new and old ones."""
STEP_TAGS = ("ray/tune/num_env_steps_sampled_lifetime", "ray/tune/timesteps_total")
"""RLlib's steps, where its files count iterations."""
WINDOW = 100
"""Training episodes that a mean is over, where a log has each episode."""


@dataclass(frozen=True)
class Curve:
    """A metric over a run."""

    steps: Array
    """Steps trained. Shape: (k,), rising."""
    values: Array
    """Shape: (k,)."""
    seconds: Array | None = None
    """Time since the start of the run [s]. Shape: (k,)."""
    within: tuple[float, float] = (-math.inf, math.inf)
    """Lowest and highest value of an episode, as far as they are known."""

    def at(self, steps: float) -> float:
        """The newest value at these steps; NaN before the first one."""
        place = int(np.searchsorted(self.steps, steps, side="right"))
        return float(self.values[place - 1]) if place else np.nan

    def reaches(self, level: float) -> tuple[float, float | None]:
        """Steps and seconds at which the metric is at `level` first; infinity if it never is."""
        places = np.flatnonzero(self.values >= level)
        if not len(places):
            return np.inf, None if self.seconds is None else np.inf
        first = places[0]
        return float(self.steps[first]), None if self.seconds is None else float(self.seconds[first])


@dataclass(frozen=True)
class RunLog:
    """One run."""

    place: Path
    curves: Mapping[str, Curve]
    """``success`` and ``return``, as far as they are known, of evaluations if there were any; `score` of a done run."""
    env: str | None = None
    seed: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    outcome: Mapping[str, Any] = field(default_factory=dict)
    """Empty unless the run is done, and ours."""
    commit: str | None = None
    """Of the source tree that it was made with."""


def read_runs(place: Path) -> list[RunLog]:
    """The runs in a folder: itself, or each folder in it; of rl-zoo3 also ``ALGO/ENV`` for ``ALGO/ENV_1``, ….

    Raises:
        SettingsError: There is none, two have the same seed, or a file cannot be read.
    """
    folders = [place]
    if not place.exists():
        folders = [one for one in place.parent.glob(f"{place.name}_*") if one.is_dir()]
    elif place.is_dir() and not _has_log(place):
        folders = [one for one in place.iterdir() if one.is_dir()]
    runs = [_read(one) for one in sorted(folders, key=_natural) if one.is_dir() and _has_log(one)]
    if not runs:
        kinds = "a run folder of bam-train, TensorBoard files, *.monitor.csv or evaluations.npz"
        why = "no run is in it" if place.exists() else "no such folder"
        raise SettingsError(f"{place}: {why}; expected {kinds}, in it or in the folders in it")
    seeds = [run.seed for run in runs if run.seed is not None]
    if twice := [run for run in runs if run.seed is not None and seeds.count(run.seed) > 1]:
        names = " and ".join(run.place.name for run in twice[:2])
        raise SettingsError(f"{place}: {names} have the same seed {twice[0].seed}; compare one of them")
    return runs


def _natural(path: Path) -> list[Any]:
    """Sort key by which seed-10 comes after seed-9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _logs(folder: Path) -> Iterator[tuple[Any, list[Path]]]:
    """How to read a folder, and the files, for each kind of log."""
    yield _own, list(folder.glob("progress.jsonl"))
    yield _zoo, list(folder.glob("evaluations.npz"))
    yield _monitors, sorted(folder.glob("*monitor.csv"))
    yield _events, sorted(folder.glob("events.out.tfevents.*"))


def _has_log(folder: Path) -> bool:
    return any(files for _, files in _logs(folder))


def _read(folder: Path) -> RunLog:
    reader, files = next((reader, files) for reader, files in _logs(folder) if files)
    try:
        run: RunLog = reader(folder, files)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        why = f"a row has no {error}" if isinstance(error, KeyError) else error
        raise SettingsError(f"{files[0]}: cannot be read: {why}. Remove it, or leave its run out") from error
    return run


def _curve(rows: list[tuple[Any, Any, Any]], within: tuple[float, float] = Curve.within) -> Curve:
    steps, seconds, values = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    return Curve(steps, values, None if np.isnan(seconds).any() else seconds, within)


def _own(folder: Path, files: list[Path]) -> RunLog:
    curves = curves_of([record for record in read_records(files[0]) if record["kind"] == "evaluation"])
    settings = read_object(folder / "config.json") or {}
    outcome = read_object(folder / "outcome.json") or {}
    if (scored := score(curves, settings, outcome)) is not None:
        curves["score"] = scored
    commit = outcome.get("git_commit") or _commit(folder / "last.zip")
    return RunLog(folder, curves, settings.get("env"), settings.get("seed"), settings, outcome, commit)


def curves_of(evaluations: Sequence[Mapping[str, Any]]) -> dict[str, Curve]:
    """The curves of a run of ours, of the records of its evaluations."""
    curves = {}
    for metric, name in (("success", "success_rate"), ("return", "return_mean")):
        rows = [(one["steps"], one["seconds"], one[name]) for one in evaluations if one.get(name) is not None]
        if rows:
            curves[metric] = _curve(rows, (0.0, 1.0) if metric == "success" else _extremes(evaluations))
    return curves


def _extremes(evaluations: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """The lowest and the highest return of an episode; infinite if an evaluation does not say."""
    low, high = (
        [float(one[name]) for one in evaluations if one.get(name) is not None] for name in ("return_min", "return_max")
    )
    known = len(low) == len(high) == len(evaluations)
    return (min(low), max(high)) if known else Curve.within


def counts(curves: Mapping[str, Curve], settings: Mapping[str, Any]) -> Curve | None:
    """The curve by which a run is chosen: the return if that is its goal, else success if it is known."""
    by_return = settings.get("stop_reward") is not None and settings.get("until_success") is None
    return curves.get("return" if by_return or "success" not in curves else "success")


def score(curves: Mapping[str, Curve], settings: Mapping[str, Any], outcome: Mapping[str, Any]) -> Curve | None:
    """The curve that `counts`, whose last value is higher if the run has ended at its goal.

    All runs that do are about as good, so the share of the steps that they saved, times the goal, is added.
    """
    curve = counts(curves, settings)
    if curve is None or not outcome:
        return None
    goal = settings.get({"success": "until_success", "reward": "stop_reward"}.get(str(outcome.get("reason")), ""))
    saved = 0.0 if goal is None else abs(goal) * (1 - min(1.0, outcome["steps"] / settings["steps"]))
    return Curve(curve.steps, np.append(curve.values[:-1], curve.values[-1] + saved), curve.seconds)


def _commit(path: Path) -> str | None:
    """The commit of a checkpoint, for a run that is not done."""
    try:
        return Checkpoint.open(path, members=False).manifest.git_commit
    except CheckpointError:
        return None


def _zoo(folder: Path, files: list[Path]) -> RunLog:
    """rl-zoo3's folder ``ENV_1``, with the arguments of the run in ``ENV_1/ENV/args.yml``; or an EvalCallback's."""
    with np.load(files[0], allow_pickle=False) as found:
        steps = found["timesteps"].astype(float)
        kept = {"return": found["results"], **({"success": found["successes"]} if "successes" in found else {})}
        curves = {name: Curve(steps, one.mean(axis=1), None, (one.min(), one.max())) for name, one in kept.items()}
    match = re.fullmatch(r"(.+)_\d+", folder.name)
    arguments = folder / match[1] / "args.yml" if match else folder
    text = arguments.read_text(encoding="utf-8") if arguments.is_file() else ""
    seed = re.search(r"^- - seed\n\s+- (\d+)$", text, re.MULTILINE)
    return RunLog(folder, curves, match[1] if match else None, int(seed[1]) if seed else None)


def _monitors(folder: Path, files: list[Path]) -> RunLog:
    """Means over training episodes, of all environments in the order in which the episodes ended."""
    env, rows, starts = None, [], []
    for path in files:
        with path.open(newline="", encoding="utf-8") as file:
            head = json.loads(file.readline().removeprefix("#"))
            env = head.get("env_id") or env
            starts.append(float(head["t_start"]))
            rows += [(starts[-1] + float(row["t"]), row) for row in csv.DictReader(file)]
    rows.sort(key=lambda row: row[0])
    if not rows:
        raise ValueError("no episode is in it")
    steps = np.cumsum([float(row["l"]) for _, row in rows])
    seconds = np.array([at for at, _ in rows]) - min(starts)
    curves = {}
    for metric, name in (("return", "r"), ("success", "is_success")):
        if name in rows[0][1]:
            each = [float({"True": 1, "False": 0}.get(row[name], row[name])) for _, row in rows]
            curves[metric] = Curve(steps, _running_mean(np.array(each)), seconds, (min(each), max(each)))
    return RunLog(folder, curves, env)


def _events(folder: Path, files: list[Path]) -> RunLog:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    tags = events.Tags()["scalars"]
    iterations = next((tag for tag in STEP_TAGS if tag in tags), None)
    counted = {} if iterations is None else {event.step: event.value for event in events.Scalars(iterations)}
    curves = {}
    for metric, names in (("success", SUCCESS_TAGS), ("return", RETURN_TAGS)):
        tag = next((name for name in names if name in tags), None)
        if tag is not None:
            start, scalars = events.FirstEventTimestamp(), events.Scalars(tag)
            rows = [(counted.get(one.step, one.step), one.wall_time - start, one.value) for one in scalars]
            if known := [row for row in rows if np.isfinite(row[2])]:
                curves[metric] = _curve(known, {"success": (0.0, 1.0)}.get(metric, Curve.within))
    return RunLog(folder, curves)


def _running_mean(values: Array) -> Array:
    """The mean over the last `WINDOW` values, or all so far."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - WINDOW)
    mean: Array = (sums[ends] - sums[starts]) / (ends - starts)
    return mean
