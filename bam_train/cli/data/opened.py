"""The commands of `bam-data` that read data sets: export, info, merge, split, filter, stats, plot and show."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import count, duration, number, percent, tell

if TYPE_CHECKING:
    from bam_train.cli.data import data_flags as flags
    from bam_train.data import DataSet


def export_data(config: flags.ExportDataConfig) -> None:
    """Write a data set in another format."""
    from bam_train.data.export import export
    from bam_train.data.selection import choose

    data = _open(config.place)
    chosen = choose(data, config.where)
    opened = export(data, config.to, config.out, chosen)
    tell(f"{config.out}: {_episodes(len(chosen))} as {config.to}", f"  open it with  {opened}")


def show_info(config: flags.InfoConfig) -> None:
    """Say what a data set is of."""
    from bam_train.data.views.summary import groups

    data = _open(config.place)
    info, found = data.info, groups(data) if len(data) else []
    facts = [data.facts(i) for i in range(len(data))]
    dates = sorted(str(one["date"]) for one in facts if "date" in one)
    policies = dict(Counter(str(one["policy"]) for one in facts if "policy" in one).most_common())
    if config.json:
        whole = {"place": config.place, "digest": data.digest, **info.to_json(), **(found[0] if found else {})}
        tell(json.dumps({**whole, "columns": data.features, "policies": policies, "tasks": data.tasks, "dates": dates}))
        return
    lines = [
        ("of", f"{info.env}{f' {json.dumps(info.env_kwargs)}' if info.env_kwargs else ''}"),
        ("robot", info.robot or "none"),
        ("rate", f"{1 / info.period:g} Hz"),
        ("observation", str(info.observation_space)),
        ("action", str(info.action_space)),
        ("columns", ", ".join(data.features)),
        ("tasks", "; ".join(data.tasks)),
        ("policies", ", ".join(f"{name[:12]} ({times})" for name, times in policies.items()) or "not known"),
        ("recorded", " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "not known"),
        ("digest", data.digest),
    ]
    steps = data.total_frames
    tell(f"{config.place}: {_episodes(len(data))}, {count(steps)} steps, {duration(steps * info.period)} of the task")
    for row in found:
        tell(f"  {'success':<12}{_success(row)}; mean return {number(row['mean_return'])}")
    tell(*(f"  {name:<12}{text}" for name, text in lines))


def merge_data(config: flags.MergeConfig) -> None:
    """Merge data sets."""
    from bam_train.data.selection import merge
    from bam_train.errors import SettingsError

    if not config.places:
        raise SettingsError("PLACE is missing. Name the data sets to merge")
    _tell_added(config.out, *merge([_open(place) for place in config.places], config.out))


def split_data(config: flags.SplitConfig) -> None:
    """Split a data set."""
    from bam_train.data.selection import copy_episodes, split
    from bam_train.errors import SettingsError

    if config.out == config.rest:
        raise SettingsError(f"--rest: expected another place than --out, found {config.rest}")
    data = _open(config.place)
    for place, part in zip((config.out, config.rest), split(data, config.share, config.by), strict=True):
        _tell_added(place, *copy_episodes(data, part, place))


def filter_data(config: flags.FilterConfig) -> None:
    """Copy some episodes."""
    from bam_train.data.selection import choose, copy_episodes

    data = _open(config.place)
    chosen = choose(data, config.where)
    _tell_added(config.out, *copy_episodes(data, chosen, config.out))


def show_stats(config: flags.StatsConfig) -> None:
    """Print tables of groups and numbers."""
    from bam_train.data.views.summary import groups, numbers
    from bam_train.files.log_lines import aligned

    data = _open(config.place)
    by_group, each = groups(data, config.by), numbers(data)
    if config.json:
        tell(json.dumps({"place": config.place, "groups": by_group, "numbers": each}))
        return
    table = [[config.by or "", "episodes", "steps", "success (95 %)", "mean return", "deviation", "mean length"]]
    for row in by_group:
        values = [number(row[key]) for key in ("mean_return", "std_return", "mean_length")]
        table.append([row["group"][:40], str(row["episodes"]), str(row["steps"]), _success(row), *values])
    tell(*aligned(table), "")
    keys = ("min", "q01", "q50", "q99", "max", "mean", "std")
    rows = [[one["column"], one["name"], one["unit"], *(number(one[key]) for key in keys)] for one in each]
    tell(*aligned([["column", "name", "unit", *keys], *rows]))


def plot_data(config: flags.PlotConfig) -> None:
    """Draw a data set."""
    from bam_train.data.views.figures import plot
    from bam_train.files.pictures import require_picture_path

    path = require_picture_path(config.out)
    against = None if config.against is None else _open(config.against)
    drawn = plot(_open(config.place), path, config.kind, against, config.episodes)
    tell(f"{path}: {', '.join(drawn)}")


def show_episode(config: flags.ShowConfig) -> None:
    """Make a film of an episode."""
    from bam_train.data.views.film import frames
    from bam_train.errors import SettingsError
    from bam_train.files.video import open_video, require_video_path

    path = require_video_path(config.out)
    data = _open(config.place)
    if not -len(data) <= config.episode < len(data):
        raise SettingsError(f"--episode: {config.place} has {len(data)} episodes, and there is no {config.episode}")
    pictures = 0
    with open_video(path, 1 / data.info.period) as add:
        for frame in frames(data, config.episode, config.camera):
            add(frame)
            pictures += 1
    facts = data.facts(config.episode)
    end = {True: "success", False: "failure", None: "success not known"}[facts["success"]]
    tell(f"{path}: episode {config.episode % len(data)}, {pictures} pictures, return {facts['return']:.4g}, {end}")


def _open(place: str) -> DataSet:
    from bam_train.data import DataSet

    return DataSet.open(place)


def _episodes(how_many: int) -> str:
    return f"{how_many} episode{'' if how_many == 1 else 's'}"


def _tell_added(place: str, added: int, left_out: int) -> None:
    more = f"; {left_out} left out, which are in it already" if left_out else ""
    tell(f"{place}: {_episodes(added)} added{more}")


def _success(row: dict[str, Any]) -> str:
    if row["success"] is None:
        return "not known"
    low, high = row["success_interval"]
    return f"{percent(row['success'])} ({100 * low:.1f} to {100 * high:.1f})"
