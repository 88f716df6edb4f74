"""Draw a data set: episodes side by side, distributions of its numbers, success over time, failures on the table."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bam_train.data.data_set import DataSet
from bam_train.data.data_set_writer import require_same
from bam_train.data.recorded_episode import Array, Episode
from bam_train.errors import SettingsError
from bam_train.files.pictures import new_figure, require_picture_path, save_figure
from bam_train.recording.recorder import number_names

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

KINDS = ("episodes", "numbers", "success", "table")
MOST_NUMBERS, MOST_SAMPLES, MOST_EPISODES = 48, 300, 6
_WINDOW = 20
"""Episodes of the running success."""


def plot(
    data: DataSet, path: Path, kinds: Sequence[str] = (), against: DataSet | None = None, episodes: Sequence[int] = ()
) -> list[str]:
    """Draw `data` into an image file; returns the kinds that were drawn.

    Raises:
        SettingsError: The data set lacks what a kind shows, or this is no kind of picture.
        BadDataSet: `against` is of another environment, or has other names or units.
        MissingExtra: matplotlib is not installed.
    """
    require_picture_path(path)
    if not len(data):
        raise SettingsError(f"{data.place}: has no episodes to draw; record some first")
    if against is not None:
        remedy = "compare data sets of one environment"
        require_same(against.place, against.info, data.info, data.place, remedy)
    is_known = any(data.facts(i)["success"] is not None for i in range(len(data)))
    lacking = {} if is_known else {"success": "it is not known whether its episodes succeeded"}
    if _table_places(data, [data[0]]) is None:
        lacking["table"] = "its observations have no object_x and object_y"
    for kind in kinds:
        if kind in lacking:
            raise SettingsError(f"--kind {kind}: {data.place}: {lacking[kind]}; leave it out")
    drawn = [kind for kind in KINDS if (kind in kinds if kinds else kind not in lacking)]
    samples = list(data.episodes(_spread(len(data))))
    heights = [_HEIGHTS[kind](data) for kind in drawn]
    figure = new_figure("bam-data plot", 12, sum(heights))
    parts = figure.subfigures(len(drawn), 1, height_ratios=heights, squeeze=False)[:, 0]
    for part, kind in zip(parts, drawn, strict=True):
        if kind == "episodes":
            _episodes(part, data, episodes or _some_of_each_end(data))
        elif kind == "numbers":
            _numbers(part, data, samples, against)
        elif kind == "success":
            _success(part, data)
        else:
            _table(part, data)
    save_figure(figure, path)
    return drawn


def _columns_of(data: DataSet) -> int:
    return min(MOST_NUMBERS, len(_named(data, [data[0]])))


_HEIGHTS = {
    "episodes": lambda data: 5.0,
    "numbers": lambda data: 1.6 * -(-_columns_of(data) // 6) + 0.4,
    "success": lambda data: 3.0,
    "table": lambda data: 4.5,
}


def _spread(count: int) -> list[int]:
    return [int(one) for one in np.unique(np.linspace(0, count - 1, min(count, MOST_SAMPLES)).astype(int))]


def _some_of_each_end(data: DataSet) -> list[int]:
    """Episodes of all three kinds of success, as many of each as there are, at most `MOST_EPISODES`."""
    ends: dict[Any, list[int]] = {}
    for index in range(len(data)):
        ends.setdefault(data.facts(index)["success"], []).append(index)
    most = max(1, MOST_EPISODES // len(ends))
    return sorted(index for members in ends.values() for index in members[:most])


def _named(data: DataSet, episodes: Sequence[Episode]) -> dict[str, Array]:
    """Each number of observations and actions that is no picture, by name. Shape: (steps,)."""
    found: dict[str, Array] = {}
    for kind, every in (("observation", data.info.observation_leaves), ("action", data.info.action_leaves)):
        leaves = [leaf for leaf in every if not leaf.is_image]
        parts = []
        for one in episodes:
            values = one.observations if kind == "observation" else one.actions
            parts.append(np.concatenate([leaf.of(values)[: len(one)].reshape(len(one), -1) for leaf in leaves], axis=1))
        table = np.concatenate(parts).astype(np.float64) if leaves else np.zeros((0, 0))
        labels = number_names({kind: table}, [str(one.get("name")) for one in data.info.contract.get(kind) or ()])
        found |= {
            f"{'' if kind == 'observation' else 'action: '}{label}": table[:, i] for i, label in enumerate(labels)
        }
    return found


def _episodes(part: SubFigure, data: DataSet, indices: Sequence[int]) -> None:
    """Actions above, the sum of the rewards below, a column an episode."""
    axes = part.subplots(2, len(indices), sharex="col", sharey="row", squeeze=False)
    for column, (index, one) in enumerate(zip(indices, data.episodes(indices), strict=True)):
        time = data.info.period * np.arange(len(one))
        names = {name: values for name, values in _named(data, [one]).items() if name.startswith("action: ")}
        for name, values in list(names.items())[:8]:
            axes[0, column].plot(time, values, linewidth=0.9, label=name.removeprefix("action: "))
        axes[1, column].plot(time, np.cumsum(one.rewards), color="black", linewidth=1)
        end = {True: "success", False: "failure", None: "success unknown"}[one.success]
        axes[0, column].set_title(f"episode {index}: {end}", fontsize="small")
        axes[1, column].set_xlabel("time [s]", fontsize="small")
    axes[0, 0].set_ylabel("action, scaled as in the space", fontsize="small")
    axes[1, 0].set_ylabel("sum of rewards", fontsize="small")
    axes[0, -1].legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize="x-small")


def _numbers(part: SubFigure, data: DataSet, samples: list[Episode], against: DataSet | None) -> None:
    """A histogram of each number, with that of the other data set as a line."""
    ours = _named(data, samples)
    theirs = {} if against is None else _named(against, list(against.episodes(_spread(len(against)))))
    shown = list(ours)[:MOST_NUMBERS]
    axes = part.subplots(-(-len(shown) // 6), 6, squeeze=False).reshape(-1)
    for panel in axes[len(shown) :]:
        panel.set_visible(False)
    for panel, name in zip(axes, shown, strict=False):
        both = np.concatenate([values[np.isfinite(values)] for values in (ours[name], theirs.get(name, ours[name]))])
        edges = np.histogram_bin_edges(both, 40)
        panel.hist(ours[name], edges, density=True, color="tab:blue", alpha=0.6, label=data.place)
        if against is not None:
            panel.hist(theirs[name], edges, density=True, histtype="step", color="black", label=against.place)
        panel.set_title(name, fontsize="x-small", pad=2)
        panel.tick_params(labelsize="xx-small")
        panel.set_yticks([])
    more = "" if len(shown) == len(ours) else f" (the first {len(shown)} of {len(ours)})"
    part.suptitle(f"observations and actions{more}, each scaled as in its space", fontsize="small")
    if against is not None:
        part.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize="x-small")


def _success(part: SubFigure, data: DataSet) -> None:
    """Each episode as a point, in the order of recording, and the mean of the last ones."""
    facts = [data.facts(i) for i in range(len(data))]
    known = [(i, float(one["success"])) for i, one in enumerate(facts) if one["success"] is not None]
    index, value = (np.array(column) for column in zip(*known, strict=True))
    total = np.concatenate([[0.0], np.cumsum(value)])
    last = np.arange(1, len(value) + 1)
    first = np.maximum(last - _WINDOW, 0)
    panel = part.subplots()
    panel.scatter(index, value, s=6, c=np.where(value > 0, "tab:green", "tab:red"))
    panel.plot(index, (total[last] - total[first]) / (last - first), color="black", label=f"mean of {_WINDOW}")
    panel.set(ylim=(-0.05, 1.05), xlabel="episode, as recorded", ylabel="success")
    panel.legend(fontsize="x-small")


def _table_places(data: DataSet, episodes: Sequence[Episode]) -> Array | None:
    """Where the object lies at first, forward and to the left [m]; None if that is not observed. Shape: (n, 2)."""
    given = list(data.info.contract.get("observation") or [])
    names = [one.get("name") for one in given]
    if not {"object_x", "object_y"} <= set(names) or isinstance(episodes[0].observations, dict):
        return None
    columns = []
    for name in ("object_x", "object_y"):
        place = names.index(name)
        first = np.array([one.observations[0].reshape(-1)[place] for one in episodes], np.float64)
        scale = re.fullmatch(r"\(?\w+(?: - ([\d.]+)\))? / ([\d.]+)", str(given[place].get("scale")))
        columns.append(first if scale is None else first * float(scale[2]) + float(scale[1] or 0))
    return np.stack(columns, axis=1)


def _table(part: SubFigure, data: DataSet) -> None:
    """Where the object lay at first, by success, seen from above."""
    episodes = list(data.episodes())
    places = _table_places(data, episodes)
    panel = part.subplots()
    if places is None:
        return
    for success, colour, label in ((True, "tab:green", "success"), (False, "tab:red", "failure")):
        chosen = places[[one.success is success for one in episodes]]
        panel.scatter(-chosen[:, 1], chosen[:, 0], s=14, c=colour, alpha=0.7, label=f"{label} ({len(chosen)})")
    panel.set(xlabel="to the right [m]", ylabel="forward [m]", title="where the object lay at first")
    panel.set_aspect("equal", adjustable="datalim")
    panel.legend(fontsize="x-small", loc="center left", bbox_to_anchor=(1, 0.5))
