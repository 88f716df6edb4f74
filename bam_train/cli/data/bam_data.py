"""`bam-data COMMAND`: collect, check and turn data sets into other formats."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import count, duration, number, percent, progress, say, tell
from bam_train.cli.program import Command, run_commands
from bam_train.files.log_lines import counted

if TYPE_CHECKING:
    from bam_train.cli.data import data_flags as flags
    from bam_train.data import DataSet

_HERE, _FLAGS = "bam_train.cli.data.bam_data", "bam_train.cli.data.data_flags"
COMMANDS = {
    "collect": Command("run a policy in simulation and record it", f"{_FLAGS}:CollectConfig", f"{_HERE}:collect"),
    "import": Command("add episodes of recordings or Parquet rows", f"{_FLAGS}:ImportConfig", f"{_HERE}:import_"),
    "check": Command("say what is whole, and mend the rest", f"{_FLAGS}:CheckConfig", f"{_HERE}:check"),
    "info": Command("what it is of, and how much is in it", f"{_FLAGS}:InfoConfig", f"{_HERE}:show_info"),
    "stats": Command("success by groups, and the size of every number", f"{_FLAGS}:StatsConfig", f"{_HERE}:show_stats"),
    "export": Command("write it for another library", f"{_FLAGS}:ExportDataConfig", f"{_HERE}:export_data"),
    "merge": Command("add the episodes of several to one", f"{_FLAGS}:MergeConfig", f"{_HERE}:merge_data"),
    "split": Command("split it in two, for training and for testing", f"{_FLAGS}:SplitConfig", f"{_HERE}:split_data"),
    "filter": Command("copy the episodes for which something holds", f"{_FLAGS}:FilterConfig", f"{_HERE}:filter_data"),
    "plot": Command("draw episodes, distributions, success and failures", f"{_FLAGS}:PlotConfig", f"{_HERE}:plot_data"),
    "show": Command("play an episode as a film", f"{_FLAGS}:ShowConfig", f"{_HERE}:show_episode"),
}
WHAT = "Record, check and convert data sets: episodes for learning."


def collect(config: flags.CollectConfig) -> None:
    """Collect episodes in simulation."""
    from bam_train.data import collect as collecting
    from bam_train.signals import Terminated

    kept, say_done = 0, progress("bam-data", "episode", config.episodes)

    def on_progress(done: int, episodes: int) -> None:
        nonlocal kept
        kept = done
        say_done(done)

    try:
        found = collecting.collect(
            config.place,
            config.policy,
            **config.played(),
            noise=config.noise,
            random=config.random,
            facts={} if config.task is None else {"task": config.task},
            on_progress=on_progress,
        )
    except KeyboardInterrupt as stop:
        seed = config.seed + max(config.episodes, config.num_envs or 0)  # which no environment had
        text = (
            f"interrupted. Kept in {config.place}: {counted(kept, 'whole episode')} of {config.episodes}, those "
            f"that ended first; for the others, run it again with --episodes {config.episodes - kept} --seed {seed}"
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
    added = f"{counted(found.episodes, 'episode')}, {counted(found.steps, 'step')} added"
    tell(f"{config.place}: {added}; {percent(found.successes / found.episodes)} of them succeeded")


def import_(config: flags.ImportConfig) -> None:
    """Add recordings or Parquet rows to a data set."""
    from bam_train.data import DataSet, recordings, rosbags
    from bam_train.errors import BadDataSet, SettingsError
    from bam_train.files.place import Place
    from bam_train.recording.recording import Recording
    from bam_train.settings import read_env_kwargs

    options: dict[str, Any] = {
        name: value for name in ("task", "group") if (value := getattr(config, name)) is not None
    }
    options["again"] = config.again
    _require(config.recordings, "import: RECORDING")
    env_kwargs = read_env_kwargs(config.set)
    for path in config.recordings:
        if rosbags.is_bag(path):
            info = rosbags.info_of_bag(env_kwargs)
            episodes = rosbags.episodes_of_bag(path, info, config.profile)
        elif recordings.is_rows(path):
            if os.path.abspath(Place(path).path) == os.path.abspath(Place(config.place).path):
                raise SettingsError(f"{config.place}: has the Parquet rows; give another PLACE for the data set")
            info = recordings.info_of_rows(path, config.env, env_kwargs)
            episodes = recordings.episodes_of_rows(path, info)
        else:
            recording = Recording.open(path)
            if env_kwargs:
                raise SettingsError(f"--set: {path} says the arguments of its environment; leave --set out")
            info = recordings.info_of_recording(recording, config.env)
            episodes = recordings.episodes_of(recording, info)
        found, notes = recordings.add_episodes(path, episodes, config.place, info, **options)
        if not found:
            why = "".join(f"; {note.removeprefix(f'{path}: ')}" for note in notes)
            raise BadDataSet(f"{path}: has no whole episode{why}. Leave it out")
        for note in notes:
            say(f"bam-data: note: {note}")
    data = DataSet.open(config.place)
    tell(f"{config.place}: {counted(len(data), 'episode')}, {counted(data.total_frames, 'step')} now")


def check(config: flags.CheckConfig) -> int:
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
    tell(f"{config.place}: {whole[status]}: {counted(found.episodes, 'episode')}, {counted(found.frames, 'step')}")
    return status


def export_data(config: flags.ExportDataConfig) -> None:
    """Write a data set in another format."""
    from bam_train.data.export import export
    from bam_train.data.selection import choose

    data = _open(config.place)
    chosen = choose(data, config.where)
    opened = export(data, config.to, config.out, chosen)
    tell(f"{config.out}: {counted(len(chosen), 'episode')} as {config.to}", f"  open it with  {opened}")


def show_info(config: flags.InfoConfig) -> None:
    """Say what a data set is of."""
    from bam_train.cli.data.views import groups

    data = _open(config.place)
    info, found = data.info, groups(data) if len(data) else []
    facts = [data.facts(i) for i in range(len(data))]
    dates = sorted(str(one["date"]) for one in facts if "date" in one)
    policies = dict(Counter(str(one["policy"]) for one in facts if "policy" in one).most_common())
    lost = dict(Counter(str(one["lost"]) for one in facts if "lost" in one))
    if config.json:
        whole = {"place": config.place, "digest": data.digest, **info.to_json(), **(found[0] if found else {})}
        whole |= {"columns": data.features, "policies": policies, "tasks": data.tasks, "dates": dates, "lost": lost}
        tell(json.dumps(whole))
        return
    spaces = {"observation": info.observation_space, "action": info.action_space}
    lines = [
        ("of", f"{info.env}{f' {json.dumps(info.env_kwargs)}' if info.env_kwargs else ''}"),
        ("robot", info.robot or "none"),
        ("rate", f"{1 / info.period:g} Hz"),
        *((name, " ".join(str(space).split())) for name, space in spaces.items()),
        ("columns", ", ".join(data.features)),
        ("tasks", "; ".join(data.tasks)),
        ("policies", ", ".join(f"{name[:12]} ({times})" for name, times in policies.items()) or "not known"),
        ("recorded", " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "not known"),
        *(("lost", f"{what} of {counted(n, 'episode')}, given up with --accept-loss") for what, n in lost.items()),
        ("digest", data.digest),
    ]
    steps, episodes = data.total_frames, counted(len(data), "episode")
    tell(f"{config.place}: {episodes}, {count(steps)} steps, {duration(steps * info.period)} of the task")
    for row in found:
        tell(f"  {'success':<12}{_success(row)}; mean return {number(row['mean_return'])}")
    tell(*(f"  {name:<12}{text}" for name, text in lines))


def merge_data(config: flags.MergeConfig) -> None:
    """Merge data sets."""
    from bam_train.data.selection import merge

    _require(config.places, "merge: PLACE")
    _tell_added(config.out, *merge([_open(place) for place in config.places], config.out))


def split_data(config: flags.SplitConfig) -> None:
    """Split a data set."""
    from bam_train.data.selection import split
    from bam_train.errors import SettingsError

    if config.out == config.rest:
        raise SettingsError(f"--rest: expected another place than --out, found {config.rest}")
    data = _open(config.place)
    _copy(data, dict(zip((config.out, config.rest), split(data, config.share, config.by), strict=True)))


def filter_data(config: flags.FilterConfig) -> None:
    """Copy some episodes."""
    from bam_train.data.selection import choose

    data = _open(config.place)
    _copy(data, {config.out: choose(data, config.where)})


def show_stats(config: flags.StatsConfig) -> None:
    """Print tables of groups and numbers."""
    from bam_train.cli.data.views import groups, numbers
    from bam_train.files.log_lines import aligned

    data = _open(config.place)
    by_group, each = groups(data, config.by), numbers(data)
    if config.json:
        tell(json.dumps({"place": config.place, "groups": by_group, "numbers": each}))
        return
    table = [
        [config.by or "", "episodes", "steps", "success (95 %)", "mean return", "deviation", "mean length [steps]"]
    ]
    for row in by_group:
        values = [number(row[key]) for key in ("mean_return", "std_return", "mean_length")]
        table.append([row["group"][:40], str(row["episodes"]), str(row["steps"]), _success(row), *values])
    tell(*aligned(table), "")
    keys = ("min", "q01", "q50", "q99", "max", "mean", "std")
    rows = [[one["column"], one["name"], one["unit"], *(number(one[key]) for key in keys)] for one in each]
    tell(*aligned([["column", "name", "unit", *keys], *rows]))
    if any(one["unit"] == "scaled" for one in each):
        tell("", f"scaled: the task has divided it, so that it is about -1 to 1; see bam-envs {data.info.env}")


def plot_data(config: flags.PlotConfig) -> None:
    """Draw a data set."""
    from bam_train.cli.data.views import plot
    from bam_train.files.pictures import require_picture_path

    path = require_picture_path(config.out)
    against = None if config.against is None else _open(config.against)
    data = _open(config.place)
    _require_episodes(data, "--episodes", config.episodes)
    drawn = plot(data, path, config.kind, against, config.episodes)
    tell(f"{path}: {', '.join(drawn)}")


def show_episode(config: flags.ShowConfig) -> None:
    """Make a film of an episode."""
    from bam_train.cli.data.views import frames
    from bam_train.files.pictures import open_video, require_video_path

    path = require_video_path(config.out)
    data = _open(config.place)
    _require_episodes(data, "--episode", [config.episode])
    facts, rate = data.facts(config.episode), 1 / data.info.period
    pictures = facts["length"] + 1
    with open_video(path, rate, progress("bam-data", "picture", pictures)) as add:
        for frame in frames(data, config.episode, config.camera):
            add(frame)
    end = {True: "success", False: "failure", None: "success not known"}[facts["success"]]
    end += f"; lost: {facts['lost']}" if "lost" in facts else ""
    drawn = f"episode {config.episode % len(data)}, {counted(pictures, 'picture')}"
    tell(f"{path}: {drawn}, return {facts['return']:.4g}, {end}")


def _require(given: Sequence[object], what: str) -> None:
    """End with status 2 unless something is given in the place of `what`, such as ``merge: PLACE``."""
    if not given:
        say(f"bam-data {what} is missing. Run bam-data {what.partition(':')[0]} --help")
        raise SystemExit(2)


def _require_episodes(data: DataSet, flag: str, indices: Sequence[int]) -> None:
    from bam_train.errors import SettingsError

    for index in indices:
        if not -len(data) <= index < len(data):
            raise SettingsError(f"{flag}: {data.place} has {counted(len(data), 'episode')}, and there is no {index}")


def _open(place: str) -> DataSet:
    from bam_train.data import DataSet

    return DataSet.open(place)


def _copy(data: DataSet, parts: dict[str, Sequence[int]]) -> None:
    """Add the episodes of these indices to the data set at each place; say what else was in it."""
    from bam_train.data.selection import copy_episodes

    for (place, chosen), added in zip(parts.items(), copy_episodes(data, parts), strict=True):
        _tell_added(place, *added)
        others = len({*_open(place).digests} - {data.digests[i] for i in chosen})
        if others:
            text = f"{place} has {counted(others, 'episode')} from before that this call does not choose"
            say(f"bam-data: note: {text}; if another choice made it, write into a new place")


def _tell_added(place: str, added: int, left_out: int) -> None:
    more = f"; {left_out} left out, which are in it already" if left_out else ""
    tell(f"{place}: {counted(added, 'episode')} added{more}")


def _success(row: dict[str, Any]) -> str:
    if row["success"] is None:
        return "not known"
    low, high = row["success_interval"]
    return f"{percent(row['success'])} ({percent(low)} to {percent(high)})"


main = partial(run_commands, "bam-data", WHAT, COMMANDS)

if __name__ == "__main__":
    main()
