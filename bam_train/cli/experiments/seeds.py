"""`bam-train --seeds`: one run a seed, one display, one summary."""

from __future__ import annotations

import contextlib
import filecmp
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from bam_train.cli.console import can_draw, count, duration, make_console, number, percent, rich_text, say
from bam_train.cli.experiment import signals_ask
from bam_train.cli.experiments.comparison import summary_lines
from bam_train.cli.flags import TrainConfig
from bam_train.cli.train_display import REASONS, MayClose, short_path
from bam_train.errors import SettingsError
from bam_train.experiments.seed_runs import (
    ClusterSeed,
    SeedProcess,
    SeedRun,
    at_once,
    group_folder,
    needs,
    read_seeds,
    run_seeds,
)
from bam_train.files.atomic_file import replacing
from bam_train.files.log_lines import counted
from bam_train.files.place import with_addresses
from bam_train.settings import RLlibSettings, TrainSettings, read_assignments
from bam_train.trainers.base import cores
from bam_train.trainers.best_checkpoint import choose_output
from bam_train.trainers.resolve_settings import preset_notices, resolve
from bam_train.trainers.run_folder import Copies, RunFolder, read_object, require_room
from bam_train.trainers.trackers import read_trackers
from bam_train.trainers.training_run import rank

Start = Callable[[SeedRun], SeedProcess | ClusterSeed]


def train_seeds(config: TrainConfig, text: str, given: Mapping[str, Any]) -> int:
    """Train one run a seed and print the summary; returns the exit status."""
    seeds = read_seeds(text)
    refused = [name for name in ("resume", "learner", "record") if getattr(config, name) is not None]
    refused += ["transport"] * bool(given.get("transport"))
    refused += ["seed"] * (config.seed is not None or "seed" in read_assignments(config.set))
    if refused:
        raise SettingsError(f"--seeds trains new runs in simulation, one a seed; leave --{refused[0]} out")
    runs = config.runs.expanduser()
    if with_addresses(f"{runs}/") != f"{runs}/":
        raise SettingsError("--seeds needs --runs on this computer, where a later call goes on; see --copy-to")
    settings = resolve({name: value for name, value in given.items() if name != "address"}, say)
    require_room(runs)
    choose_output(settings, config.out, True, None)  # refuses what cannot be written
    copies = None if config.copy_to is None else Copies(config.copy_to)
    with (
        contextlib.redirect_stderr(MayClose(sys.stderr)),
        starter(settings, given.get("address"), runs, config.track) as (start, jobs, where),
        group_folder(runs, settings) as (group, lock),
    ):
        every = [SeedRun.there(group.path, settings, seed, lock) for seed in seeds]
        say(f"{settings.algo} on {settings.env}, {counted(len(seeds), 'seed')} in {group.path}, {jobs} at once{where}")
        for notice in preset_notices(settings, given):
            say(notice)
        with signals_ask() as stopped:
            run_all(every, start, jobs, stopped)
            done = [run for run in every if run.state == "done"]
            if stopped() and len(done) < len(every):
                say(f"{len(done)} of {len(every)} seeds are done; the same command goes on with the others")
            elif done:
                _summarise(config, settings, group, copies)
        return _status(every)


def run_all(every: list[SeedRun], start: Start, jobs: int, stopped: Callable[[], bool]) -> None:
    """Train the runs that wait, and show all of them."""
    waiting = (run for run in every if run.state == "waiting")
    with (LiveTable if can_draw() else PlainLines)(every) as show:
        run_seeds(lambda: next(waiting, None), start, jobs, stopped, show.update)


@contextlib.contextmanager
def starter(
    settings: TrainSettings, address: str | None, runs: Path, track: str | None
) -> Iterator[tuple[Start, int, str]]:
    """What starts a run, which trackers call by its place in `runs`; how many run at once; and where in words."""
    needed = needs(settings)
    if track is not None:
        read_trackers(track)

    def asked(run: SeedRun) -> dict[str, Any]:
        tracked_as = run.folder.path.relative_to(runs).as_posix()
        return run.settings.to_mapping() | ({} if track is None else {"track": track, "tracked_as": tracked_as})

    if address is None:
        jobs = max(1, cores() // needed["CPU"])
        yield lambda run: SeedProcess(asked(run), run.folder.path, lock=run.lock), jobs, ""
        return
    from bam_train.trainers.rllib import ray_cluster

    joined = RLlibSettings(env=settings.env, algo="ppo", trainer="rllib", num_gpus=0, address=address)
    with ray_cluster.cluster(joined):
        import ray

        jobs = at_once(needed, [node["Resources"] for node in ray.nodes() if node["Alive"]])
        if not jobs:
            wanted = " and ".join(f"{number} {name}s" for name, number in needed.items() if number)
            raise SettingsError(f"a run needs {wanted} on one computer, and no node of the cluster has as many")
        yield (
            lambda run: ClusterSeed(asked(run), run.folder.path, *needed.values()),
            jobs,
            f" on the cluster at {address}",
        )


def _status(every: list[SeedRun]) -> int:
    """Say which seeds failed or learnt nothing, and why; the exit status."""
    status = 0
    for run in every:
        shortfall = (run.folder.outcome or {}).get("shortfall")
        if run.state == "failed":
            say(f"bam-train: seed {run.name}: {run.why}")
            status = 1
        elif shortfall:
            say(f"bam-train: seed {run.name}: nothing was learnt in {run.steps:,} steps: {shortfall}")
            status = status or 3
    return status


# Display


_WORDS = {
    "state": "{}",
    "steps": "{} steps",
    "success": "success {}",
    "return": "return {}",
    "training left": "{} of training left",
}
"""The cells of `_cells` in a plain line."""


def _cells(run: SeedRun) -> dict[str, str]:
    """What is shown of a seed; a dash for what is not known."""
    why = REASONS.get(run.why, run.why) if run.state == "done" else run.why
    more = f" of {count(run.settings.steps)}" if run.state == "training" else ""
    return {
        "seed": run.name,
        "state": f"{run.state}: {why}" if why else run.state,
        "steps": f"{count(run.steps)}{more}" if run.steps else "-",
        "success": percent(run.success),
        "return": number(run.returns),
        "training left": "-" if run.left is None else f"at most {duration(run.left)}",
    }


class PlainLines:
    """A line for each change of a seed's state and each of its evaluations."""

    def __init__(self, runs: list[SeedRun]) -> None:
        self._runs = runs
        self._shown = {run.name: ("waiting", run.evaluations) for run in runs}

    def __enter__(self) -> PlainLines:
        self.update()
        return self

    def __exit__(self, *_: object) -> None:
        return

    def update(self) -> None:
        """Print what is new."""
        for run in self._runs:
            if self._shown[run.name] != (run.state, run.evaluations):
                self._shown[run.name] = run.state, run.evaluations
                cells = _cells(run)
                known = [form.format(cells[name]) for name, form in _WORDS.items() if cells[name] != "-"]
                say(f"seed {run.name}: {', '.join(known)}")


class LiveTable(PlainLines):
    """A table that changes in place."""

    def __init__(self, runs: list[SeedRun]) -> None:
        super().__init__(runs)
        from rich.live import Live

        self._live = Live(console=make_console(), refresh_per_second=4, transient=True)

    def __enter__(self) -> LiveTable:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def update(self) -> None:
        """Draw the table."""
        from rich.table import Table

        table = Table("seed", *_WORDS, box=None, padding=(0, 2, 0, 0))
        for run in self._runs:
            table.add_row(*map(rich_text, _cells(run).values()))
        self._live.update(table)


# Outcome


def _summarise(config: TrainConfig, settings: TrainSettings, group: RunFolder, copies: Copies | None) -> None:
    """Print a row a seed and the means over seeds, also those of earlier calls, and copy the best checkpoint."""
    say()
    for line in summary_lines(group.path):
        say(line)
    outcomes = {path.parent: read_object(path) or {} for path in group.path.glob("seed-*/outcome.json")}
    scores = {folder: outcome["best"] for folder, outcome in outcomes.items() if outcome.get("best")}
    best = max(scores, key=lambda folder: rank(scores[folder]), default=None)
    if best is not None:
        path = _keep(config, settings, group, best)
        say(f"  best of all   {short_path(path)} ({best.name})")
        if copies is not None:
            copies.copy(path)
    say(f"  runs          {short_path(group.path)}/: in the folder of each seed best.zip, log.txt and what a run has")


def _keep(config: TrainConfig, settings: TrainSettings, group: RunFolder, best: Path) -> Path:
    """Copy the best checkpoint to where checkpoints are; over a copy of an earlier call, unless it was changed."""
    earlier, out = group.outcome or {}, config.out
    kept = Path(str(earlier.get("checkpoint")))
    is_own = kept.is_file() and any(filecmp.cmp(kept, one, shallow=False) for one in group.path.glob("seed-*/best.zip"))
    if is_own and (out is None or out.expanduser().resolve() == kept):
        out = kept
    output = choose_output(settings, out, config.force or (is_own and out == kept), None)
    for notice in output.notices:
        say(notice)
    group.write_outcome({"checkpoint": str(output.path.resolve()), "seed": best.name})
    with replacing(output.path) as temporary:
        shutil.copyfile(best / "best.zip", temporary)
    return output.path
