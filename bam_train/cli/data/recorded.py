"""The commands of `bam-data` that write data sets: collect, import and check."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING

from bam_train.cli.console import percent, say, tell

if TYPE_CHECKING:
    from bam_train.cli.data.data_flags import CheckConfig, CollectConfig, ImportConfig


def collect(config: CollectConfig) -> None:
    """Collect episodes in simulation."""
    from bam_train.data import collect as collecting
    from bam_train.settings import read_env_kwargs

    last = time.monotonic()

    def on_progress(done: int, episodes: int) -> None:
        nonlocal last
        if done < episodes and time.monotonic() - last > 5:
            last = time.monotonic()
            say(f"bam-data: {done} of {episodes} episodes")

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
    if config.json:
        tell(json.dumps({"place": config.place, **vars(found)}))
        return
    share = percent(found.successes / found.episodes)
    tell(f"{config.place}: {found.episodes} episodes, {found.steps} steps added; {share} of them succeeded")


def import_(config: ImportConfig) -> None:
    """Add recordings to a data set."""
    from bam_train.data import DataSet
    from bam_train.data.recordings import add_recording, info_of_recording
    from bam_train.recording.recording import Recording

    facts = {name: value for name in ("task", "group") if (value := getattr(config, name)) is not None}
    if not config.recordings:
        say("bam-data import: RECORDING is missing. Run bam-data import --help")
        raise SystemExit(2)
    for path in config.recordings:
        recording = Recording.open(path)
        for note in add_recording(recording, config.place, info_of_recording(recording, config.env), **facts):
            say(f"bam-data: note: {note}")
    data = DataSet.open(config.place)
    tell(f"{config.place}: {len(data)} episodes, {data.total_frames} steps now")


def check(config: CheckConfig) -> int:
    """Check a data set, and mend it; returns the exit status."""
    from bam_train.data.layout import Files, WriterLock
    from bam_train.data.mending import look, mend

    files = Files(config.place)
    found = look(files) if config.no_mend else None
    if found is None:
        lock = WriterLock(files)
        try:
            found = mend(files)
        finally:
            lock.release()
    status = int(config.no_mend and not found.is_whole)
    if config.json:
        tell(json.dumps({"place": config.place, **vars(found), "whole": not status}))
        return status
    for line in found.notes:
        say(f"bam-data: note: {line}")
    for line in found.problems:
        say(f"bam-data: {'not whole' if config.no_mend else 'mended'}: {line}")
    whole = "whole" if found.is_whole else "not whole" if config.no_mend else "whole again"
    tell(f"{config.place}: {whole}: {found.episodes} episodes, {found.frames} steps")
    return status
