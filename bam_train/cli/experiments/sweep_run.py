"""What `bam-sweep` does: the search, its status, the comparison of the best trial with the preset, and the preset."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial, TrialState

from bam_envs.core.validation import check
from bam_train.cli.console import can_draw, percent, say, tell
from bam_train.cli.experiment import signals_ask
from bam_train.cli.experiments.comparison import RunComparison
from bam_train.cli.experiments.seeds import LiveTable, PlainLines, run_all, starter
from bam_train.cli.experiments.sweep import SweepConfig
from bam_train.cli.flags import Count, Positive
from bam_train.cli.train_display import MayClose, short_path
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.experiments.run_logs import read_runs
from bam_train.experiments.seed_runs import SeedRun, run_seeds
from bam_train.experiments.seed_statistics import FEWEST
from bam_train.experiments.sweep_folder import STATES, SweepFolder
from bam_train.experiments.trial_search import Sweep, chosen, shown
from bam_train.files.atomic_file import locked, replacing, require_writable
from bam_train.files.log_lines import aligned, counted
from bam_train.settings import (
    NAMES,
    AllSettings,
    TrainSettings,
    merge,
    parse_config,
    read_assignments,
    read_config,
    toml_text,
    walk,
)
from bam_train.trainers.resolve_settings import preset_notices, read_preset, resolve
from bam_train.trainers.run_folder import RunFolder, writing

TRIALS = 20
"""Trials of a search, unless it is said."""
NEW_SEEDS = 10_000
"""First seed of a comparison with the preset: far from those of the search, so that other episodes evaluate it too."""
OWN: dict[str, Any] = {"trials": Count | None, "seeds": Count | None, "minutes": Positive | None}
"""Entries of a file that are no settings of `bam-train`."""
NOT_BETTER = 3
"""Exit status if the best trial is not shown to be better than the preset."""


def sweep(config: SweepConfig) -> int:
    """Run the program with its parsed flags; returns the exit status."""
    file = {} if config.file is None else read_config(config.file, (*OWN, "num_envs"))
    flags = {name: value for name in (*NAMES, *OWN) if (value := getattr(config, name)) is not None}
    given = merge(file, read_assignments(config.set), flags)
    trials, seeds, minutes = (check(given.pop(name, None), kind, name, SettingsError) for name, kind in OWN.items())
    address = given.pop("address", None)
    for name in ("seed", "transport"):
        if given.get(name):
            raise SettingsError(f"{name}: a search trains new runs in simulation, with seeds of its own; leave it out")
    begun = config.resume is not None
    place = (config.resume or config.runs).expanduser()
    if config.save_preset is not None and config.save_preset.suffix not in (".toml", ".json"):
        raise SettingsError(f"--save-preset: expected a .toml or .json file, found {config.save_preset}")
    searches = not config.status and config.confirm is None and config.save_preset is None
    folder = SweepFolder(place, given, seeds, begun, is_new=searches)
    if config.status:
        tell(*_status(folder))
        return 0
    if searches:
        return _search(folder, trials or folder.study.user_attrs.get("trials", TRIALS), minutes, address, config.track)
    best = folder.best
    if best is None:
        raise SettingsError(f"{folder.path}: no trial is done yet; bam-sweep --resume {folder.path} goes on")
    status = 0 if config.confirm is None else _confirm(folder, best, config.confirm, address, config.track)
    if config.save_preset is not None:
        _save(folder, best, require_writable(config.save_preset))
    return status


# The search


def _search(folder: SweepFolder, trials: int, minutes: float | None, address: str | None, track: str | None) -> int:
    """Train trials until there are enough, the time is over, or a signal comes; print the status."""
    with writing(folder.journal):
        folder.study.set_user_attr("trials", trials)
    end = float("inf") if minutes is None else time.monotonic() + 60 * minutes
    search = Sweep(folder, trials, say)
    what = f"{counted(trials, 'trial')} of {counted(folder.seeds, 'seed')}"
    with _runs(folder, address, track, what) as (start, jobs, stopped):
        display = LiveTable(search.runs) if can_draw() else PlainLines([])
        with contextlib.closing(search), display as table:

            def show() -> None:
                search.look()
                table.update()

            over = lambda: stopped() or time.monotonic() > end  # noqa: E731
            run_seeds(search.following, start, jobs, over, show)
        ended = len(folder.trials()) - len(folder.trials(TrialState.RUNNING))
        if stopped() or ended < trials:
            why = "" if stopped() or minutes is None else f"{minutes:g} minutes are over: "
            say(f"{why}{ended} of {trials} trials have ended; the same command goes on with the others")
            if stopped():
                return 0
    tell(*_status(folder))
    if folder.best is None:
        failed = [folder.outcome(one.number).get("why") for one in folder.trials(TrialState.FAIL)]
        why = f"the last one failed: {failed[-1]}" if failed else "give more --minutes, or fewer --steps"
        raise TrainingFailed(f"{folder.path}: no trial is done; {why}")
    return 0


@contextlib.contextmanager
def _runs(folder: SweepFolder, address: str | None, track: str | None, what: str) -> Iterator[Any]:
    """What starts runs, how many at once, and whether a signal has come; says what is done."""
    base = folder.space.base
    with (
        contextlib.redirect_stderr(MayClose(sys.stderr)),
        starter(base, address, folder.path.parent, track) as (start, jobs, where),
        signals_ask() as stopped,
    ):
        say(f"{base.algo} on {base.env}: {what} in {folder.path}, {counted(jobs, 'run')} at once{where}")
        for notice in preset_notices(base, folder.asked):
            say(notice)
        yield start, jobs, stopped


# The status


def _status(folder: SweepFolder) -> list[str]:
    """The best trial, the importance of each setting, and all trials, as lines."""
    base, best = folder.space.base, folder.best
    counts = {state: len(folder.trials(state)) for state in STATES}
    said = ", ".join(f"{number} {STATES[state]}" for state, number in counts.items() if number)
    seeds = counted(folder.seeds, "seed")
    lines = [f"{base.algo} on {base.env}, {seeds} a trial, in {folder.path}: {said or 'no trial'}"]
    if best is None:
        return [*lines, "no trial is done yet"]
    scores = ", ".join(f"{one:.4g}" for one in folder.outcome(best.number).get("scores", ()))
    lines += [f"best: trial {best.number}, score {best.value:.4g} ({scores})", f"  {_confirmed(folder, best)[1]}", ""]
    shares, preset = folder.importance(), dict(walk(base.to_mapping()))
    rows = [["setting", "importance", "best", _base_name(base)]]
    for one in folder.space.dimensions:
        value = preset.get(one.name)
        plain = json.dumps(value) if one.choices else value
        rows.append([one.title, percent(shares.get(one.name)), shown(best.params[one.name]), shown(plain)])
    lines += [*aligned(rows), ""]
    table = [["trial", "state", "score", *(one.title for one in folder.space.dimensions), "why"]]
    order = [*STATES]
    for trial in sorted(folder.trials(), key=lambda one: (order.index(one.state), -(one.value or 0.0), one.number)):
        outcome = folder.outcome(trial.number)
        score = outcome.get("score")
        values = [shown(trial.params.get(one.name)) for one in folder.space.dimensions]
        row = [str(trial.number), STATES[trial.state], "-" if score is None else f"{score:.4g}", *values]
        table.append([*row, outcome.get("why", "")])
    return [*lines, *aligned(table)]


def _base_name(base: TrainSettings) -> str:
    return "preset" if read_preset(base.env, base.algo, base.trainer) else "defaults"


# The comparison with the preset


def _confirm(folder: SweepFolder, best: FrozenTrial, number: int, address: str | None, track: str | None) -> int:
    """Train the best trial and the preset on new seeds, and compare them; returns the exit status."""
    base, name = folder.space.base, _base_name(folder.space.base)
    rows = {name: base, f"trial-{best.number}": folder.space.settings(best.params)}
    if len({json.dumps(one.to_mapping(), sort_keys=True) for one in rows.values()}) == 1:
        raise SettingsError(f"trial {best.number}, the best one, has the settings of the {name}: try more --trials")
    place = RunFolder(folder.path, "confirm", lambda path: True).path
    what = f"trial {best.number} and the {name} on {number} new seeds"
    with (
        _runs(folder, address, track, what) as (start, jobs, stopped),
        locked(place) as lock,
    ):
        every = [
            SeedRun.there(RunFolder(place, row, lambda path: True).path, settings, seed, lock, f" of {row}")
            for seed in range(NEW_SEEDS, NEW_SEEDS + number)
            for row, settings in rows.items()
        ]
        run_all(every, start, jobs, stopped)
        missing = [run for run in every if run.state != "done"]
        if stopped():
            say(f"{len(every) - len(missing)} of {len(every)} runs are done; the same command goes on with the others")
            return 0
    if missing:
        text = f"seed {missing[0].name}: {missing[0].why}. The same command trains it again"
        raise TrainingFailed(f"{len(missing)} of {len(every)} runs have failed: {text}")
    found, line = _confirmed(folder, best)
    if found is None:
        return 0
    tell(*found.text("text").split("\n"), "", line)
    return NOT_BETTER if found.failures("not-better") else 0


def _confirmed(folder: SweepFolder, best: FrozenTrial) -> tuple[RunComparison | None, str]:
    """The comparison of a trial with the preset on new seeds, if it was done; and what it says in one line."""
    name, place = _base_name(folder.space.base), folder.path / "confirm"
    places = [place / name, place / f"trial-{best.number}"]
    done = [sum(bool(run.outcome) for run in read_runs(one)) if one.is_dir() else 0 for one in places]
    if min(done) < FEWEST:
        return None, f"not confirmed: --confirm 10 compares it with the {name} on new seeds"
    found = RunComparison(places, "score")
    seeds, _, less, better = found.table()[-1][1:5]
    verdict = f"not shown to be better than the {name}" if found.failures("not-better") else f"better than the {name}"
    return found, f"trial {best.number} is {verdict}: {less} in score on {seeds} new seeds, P(better) {better}"


# The preset


def _save(folder: SweepFolder, best: FrozenTrial, path: Path) -> None:
    """Write the settings of a trial, with what is known about it as comments."""
    settings, usual = folder.space.settings(best.params), AllSettings("", "").to_mapping()
    table = {name: value for name, value in settings.to_mapping().items() if value != usual[name]}
    notes = [f"trial {best.number} of {folder.path}: score {best.value:.4g}, {', '.join(chosen(folder, best.params))}"]
    notes.append(_confirmed(folder, best)[1])
    text = json.dumps(table, indent=2) + "\n"
    if path.suffix == ".toml":
        lines = [f"{name} = {toml_text(value)}" for name, value in walk(table) if value is not None]
        text = "\n".join([*(f"# {note}" for note in notes), *lines, ""])
        if resolve(parse_config(path.name, text)) != settings:
            raise SettingsError(f"{path}: a setting does not fit into TOML, which has no null; give a .json file")
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    tell(f"{short_path(path)}: {notes[0]}", notes[1], f"bam-train --config {path} trains with it")
