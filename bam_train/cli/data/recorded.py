"""The commands of `bam-data` that write data sets: collect, import and check."""

from __future__ import annotations

import json
import os
import time
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import percent, say, tell

if TYPE_CHECKING:
    from bam_train.cli.data.data_flags import CheckConfig, CollectConfig, ImportConfig


def collect(config: CollectConfig) -> None:
    """Collect episodes in simulation."""
    from bam_train.data import collect as collecting
    from bam_train.settings import read_env_kwargs
    from bam_train.signals import Terminated

    last, kept = time.monotonic(), 0

    def on_progress(done: int, episodes: int) -> None:
        nonlocal last, kept
        kept = done
        if done < episodes and time.monotonic() - last > 5:
            last = time.monotonic()
            say(f"bam-data: {done} of {episodes} episodes")

    try:
        found = collecting.collect(
            config.place,
            config.policy,
            config.env,
            read_env_kwargs(config.set),
            episodes=config.episodes,
            seed=config.seed,
            noise=config.noise,
            random=config.random,
            num_envs=config.num_envs,
            facts={} if config.task is None else {"task": config.task},
            on_progress=on_progress,
        )
    except KeyboardInterrupt as stop:
        seed = config.seed + max(config.episodes, config.num_envs or 0)  # which no environment had
        text = (
            f"interrupted: {kept} whole episodes of {config.episodes} are in {config.place}; for the others, run it "
            f"again with --episodes {config.episodes - kept} --seed {seed}"
        )
        if isinstance(stop, Terminated):
            say(f"bam-data: {text}")
            raise
        raise KeyboardInterrupt(text) from stop
    if config.json:
        tell(json.dumps({"place": config.place, **vars(found)}))
        return
    if found.repeated:
        say(f"bam-data: note: {found.repeated} of them were in {config.place} already: another --seed gives others")
    share = percent(found.successes / found.episodes)
    tell(f"{config.place}: {found.episodes} episodes, {found.steps} steps added; {share} of them succeeded")


def import_(config: ImportConfig) -> None:
    """Add recordings or Parquet rows to a data set."""
    from bam_train.data import DataSet, recordings
    from bam_train.errors import SettingsError
    from bam_train.files.place import Place
    from bam_train.recording.recording import Recording
    from bam_train.settings import read_env_kwargs

    options: dict[str, Any] = {
        name: value for name in ("task", "group") if (value := getattr(config, name)) is not None
    }
    options["again"] = config.again
    if not config.recordings:
        say("bam-data import: RECORDING is missing. Run bam-data import --help")
        raise SystemExit(2)
    env_kwargs = read_env_kwargs(config.set)
    for path in config.recordings:
        if recordings.is_rows(path):
            if os.path.abspath(Place(path).path) == os.path.abspath(Place(config.place).path):
                raise SettingsError(f"{config.place}: has the Parquet rows; give another PLACE for the data set")
            info = recordings.info_of_rows(path, config.env, env_kwargs)
            episodes = recordings.episodes_of_rows(path, info)
            notes = recordings.add_episodes(path, episodes, config.place, info, **options)
        elif env_kwargs:
            raise SettingsError(f"--set: {path} says the arguments of its environment; leave --set out")
        else:
            recording = Recording.open(path)
            info = recordings.info_of_recording(recording, config.env)
            notes = recordings.add_recording(recording, config.place, info, **options)
        for note in notes:
            say(f"bam-data: note: {note}")
    data = DataSet.open(config.place)
    tell(f"{config.place}: {len(data)} episodes, {data.total_frames} steps now")


def check(config: CheckConfig) -> int:
    """Check a data set, and mend it; returns the exit status."""
    from bam_train.data.layout import Files, WriterLock
    from bam_train.data.mending import look, mend

    files = Files(config.place)
    files.require()
    if config.no_mend:
        found = look(files)
    else:
        lock = WriterLock(files)
        try:
            found = mend(files, accept_loss=config.accept_loss)
        finally:
            lock.release()
    is_mended = not config.no_mend and (config.accept_loss or not found.lost)
    status = 0 if found.is_whole or (is_mended and not found.lost) else 3 if is_mended else 1
    if config.json:
        tell(json.dumps({"place": config.place, **vars(found), "whole": status == 0}))
        return status
    copies = (
        "had none of some files; it has them now" if is_mended else "has none of some files; bam-data check makes them"
    )
    said = {
        "note": [*([] if found.has_copies else [f"copies/ {copies}"]), *found.notes],
        "mended" if is_mended else "not whole": found.problems,
        "lost": found.lost,
        "set aside": [f"{config.place}/{name}" for name in found.set_aside],
    }
    for what, lines in said.items():
        for line in lines:
            say(f"bam-data: {what}: {line}")
    if found.lost and not (is_mended or config.no_mend):
        say(f"bam-data: nothing was changed. To give up what is lost: bam-data check {config.place} --accept-loss")
    whole = {0: "whole" if found.is_whole else "whole again", 1: "not whole", 3: "whole again, without what is lost"}
    tell(f"{config.place}: {whole[status]}: {found.episodes} episodes, {found.frames} steps")
    return status
