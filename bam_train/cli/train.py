"""`bam-train`: train a policy, keep the best as one checkpoint.zip."""

from __future__ import annotations

import atexit
import contextlib
import gc
import json
import os
import pkgutil
import shutil
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import can_draw, count, say, say_in_handler, tell
from bam_train.cli.program import guarded, run_program
from bam_train.signals import at_end_of_parent, before_quitting, handled

if TYPE_CHECKING:
    from bam_train.checkpoint import Checkpoint
    from bam_train.cli.flags import TrainConfig
    from bam_train.settings import TrainSettings
    from bam_train.trainers.run_folder import RunFolder
    from bam_train.trainers.training_run import TrainingRun

_STARTED = time.monotonic()
_KEPT: list[contextlib.ExitStack] = []


def train(config: TrainConfig) -> int:
    """Run the program with its parsed flags; returns the exit status."""
    from bam_envs.core.location import addresses
    from bam_train.checkpoint import Checkpoint
    from bam_train.errors import SettingsError
    from bam_train.settings import NAMES, merge, read_assignments, read_config
    from bam_train.trainers.resolve_settings import preset_notices, resolve, resolve_resumed

    if config.resume is not None and not config.resume.expanduser().exists():
        raise SettingsError(f"--resume {config.resume}: no such file. Check the name; a run keeps runs/NAME/last.zip")
    checkpoint = None if config.resume is None else Checkpoint.open(config.resume)
    file = {} if config.config is None else read_config(config.config)
    flags = {name: getattr(config, name) for name in NAMES if getattr(config, name) is not None}
    if "transport" in flags:
        flags["transport"] = list(addresses(flags["transport"]))
    given = merge(file, read_assignments(config.set), flags)
    if config.seeds is not None and not config.print_config:
        return int(pkgutil.resolve_name("bam_train.cli.experiments.seeds:train_seeds")(config, config.seeds, given))
    if config.learner is not None:
        if config.track is not None:
            raise SettingsError("--track shows runs in simulation or from data; leave it out with --learner")
        return _learn(config, config.learner, given, checkpoint)
    settings = resolve(given, say) if checkpoint is None else resolve_resumed(given, checkpoint, say)
    if config.print_config:
        tell(*json.dumps(settings.to_mapping(), indent=2).split("\n"))
        return 0
    return _train(config, settings, checkpoint, [] if checkpoint else preset_notices(settings, given))


def _train(
    config: TrainConfig,
    settings: TrainSettings,
    checkpoint: Checkpoint | None,
    notices: list[str],
    folder: RunFolder | None = None,
    tracked_as: str = "",
) -> int:
    """Train with complete settings, and print `notices` and the outcome; returns the exit status.

    A run that continues from a checkpoint goes on in its `folder`, if that is given; otherwise a run has a new one.
    Trackers call it `tracked_as`, by default as its folder.
    """
    from bam_train.cli.train_display import LiveDisplay, MayClose, PlainDisplay, say_next, summarise
    from bam_train.environments import is_batched
    from bam_train.errors import OutputError, SettingsError, TrainingFailed
    from bam_train.settings import file_stem
    from bam_train.trainers import load_trainer
    from bam_train.trainers.base import hardware, origin
    from bam_train.trainers.best_checkpoint import choose_output
    from bam_train.trainers.run_folder import Copies, RunFolder, require_room
    from bam_train.trainers.trackers import Trackers, read_trackers
    from bam_train.trainers.training_run import TrainingRun

    arm = settings.env_kwargs.get("robot_model")
    robot = f" with {arm['name']}" if isinstance(arm, Mapping) else ""
    runs, title = config.runs.expanduser(), f"{settings.algo} on {settings.env}{robot}, seed {settings.seed}"
    if checkpoint is not None:
        title += f", going on from {checkpoint.path} at {count(checkpoint.manifest.steps)} steps"
    require_room(runs)
    if config.track is not None:
        read_trackers(config.track)
    if config.record is not None:
        if settings.trainer != "sb3":
            raise SettingsError(f"--record is for --trainer sb3, found {settings.trainer}; use bam-data collect")
        if not (is_batched(settings.env) or settings.transport):
            raise SettingsError(f"--record: {settings.env} is not of bam_envs; use bam-data collect, or RecordDataset")
    output = choose_output(settings, config.out, config.force, checkpoint)
    kind = load_trainer(settings.trainer)
    copies = None if config.copy_to is None else Copies(config.copy_to)
    trainer = kind.create(settings) if checkpoint is None else kind.load(checkpoint, settings)
    came: list[int] = []
    trackers: Trackers | None = None
    with contextlib.redirect_stderr(MayClose(sys.stderr)), contextlib.ExitStack() as handlers:
        try:
            settings = trainer.settings  # as the trainer completed them
            if config.record is not None:
                trainer.record(config.record)  # type: ignore[attr-defined]
            if folder is None:
                folder = RunFolder(runs, file_stem(settings.env, settings.algo, settings.trainer, settings.env_kwargs))
            display = (LiveDisplay if can_draw() else PlainDisplay)(title)
            if config.track is not None:
                trackers = Trackers(config.track, tracked_as or folder.path.name, folder, settings, display.note)
                notices = [*notices, *trackers.notices]
            folder.write_config(settings.to_mapping())
            trainer.log_to(folder.tensorboard)
            run = TrainingRun(trainer, folder, output.path, display, output.best, copies=copies)
            handlers.enter_context(handled(_stop_on_signals(run, came)))
            with display:
                for notice in [*notices, *output.notices, *trainer.notices]:
                    display.note(notice)
                outcome = run.run()
            summarise(settings, outcome, folder, time.monotonic() - _STARTED)
            if outcome.shortfall is None:
                run.add_detector()  # a tenth of a short run's time, so that nobody waits for the outcome
            if outcome.reason != "stopped" and outcome.failure is None:
                made = {"reason": outcome.reason, "steps": outcome.steps, "seconds": run.seconds, "best": outcome.best}
                try:
                    folder.write_outcome({**made, "shortfall": outcome.shortfall, "hardware": hardware(), **origin()})
                except OutputError as error:
                    outcome = replace(outcome, failure=error)
            if trackers is not None:
                trackers.finish([outcome.checkpoint, folder.curve], whole=True)
        finally:
            if trackers is not None:
                trackers.finish([], whole=False)
            trainer.close()
        say_next(settings, outcome)
        if came:
            _KEPT.append(handlers.pop_all())  # otherwise its collection would restore the earlier handlers
    if outcome.failure is not None:
        raise outcome.failure
    if outcome.shortfall is not None:
        remedy = f"Try --seed {settings.seed + 1}, more --steps or other settings (docs/training.md); do not deploy it"
        raise TrainingFailed(
            f"nothing was learnt in {outcome.steps:,} steps: {outcome.shortfall}. {remedy}", exit_status=3
        )
    return 128 + came[0] if came else 0


def _learn(config: TrainConfig, url: str, given: dict[str, Any], checkpoint: Checkpoint | None) -> int:
    """Learn from a live agent; returns the exit status."""
    from bam_train.cli.experiment import signals_ask
    from bam_train.trainers.learning.live_session import learn

    with signals_ask() as stopped:
        learn(
            url,
            given,
            checkpoint,
            out=config.out,
            runs=config.runs.expanduser(),
            force=config.force,
            push_every=config.push_every,
            tell=say,
            stopped=stopped,
        )
    return 0


def _stop_on_signals(run: TrainingRun, came: list[int]) -> Callable[[int], None]:
    """Handler of signals: the first one stops `run` after its update, the second ends the process."""

    def stop(number: int) -> None:
        if came:  # end the process at once: an exception might be caught, or wait for threads
            kept = f"the last checkpoint on the disk is {run.last}" if run.last else "no checkpoint had been saved yet"
            say_in_handler(f"bam-train: quit at once; {kept}")
            run.folder.remove_unfinished()
            before_quitting()
            os._exit(128 + number)
        came.append(number)
        doing = "all is saved; ending" if run.done else "finishing the update and saving"
        run.stop()
        again = "Ctrl-C again" if number == signal.SIGINT else "another signal"
        say_in_handler(f"{doing}; {again} quits at once")

    return stop


def train_seed() -> None:
    """A process of ``--seeds``: train in the folder of the first argument, which may hold a part of the run.

    The first line of standard input has its settings, and ``track`` and ``tracked_as`` if it is tracked; the end of
    standard input is the end of the run.
    """
    sys.path.append(os.getcwd())
    atexit.register(gc.freeze)
    path, values = Path(sys.argv[1]), json.loads(sys.stdin.readline())
    at_end_of_parent(lambda: os.kill(os.getpid(), signal.SIGTERM))

    def run() -> int:
        from bam_train.checkpoint import Checkpoint
        from bam_train.cli.flags import TrainConfig
        from bam_train.settings import TrainSettings
        from bam_train.trainers.run_folder import RunFolder

        folder = RunFolder(path.parent, path.name, lambda path: True)
        checkpoint = Checkpoint.open(folder.last) if folder.last.exists() else None
        if checkpoint is None:
            for name in ("progress.jsonl", "tracked.json"):
                (path / name).unlink(missing_ok=True)
            shutil.rmtree(folder.tensorboard, ignore_errors=True)
        track, tracked_as = values.pop("track", None), values.pop("tracked_as", "")
        config = TrainConfig(out=path / "best.zip", force=True, runs=path.parent, track=track)
        return _train(config, TrainSettings.from_mapping(values), checkpoint, [], folder, tracked_as)

    sys.exit(guarded(run, "bam-train"))


main = partial(run_program, "bam-train", "bam_train.cli.flags:TrainConfig", lambda config, _: train(config))

if __name__ == "__main__":
    main()
