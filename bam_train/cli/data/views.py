"""What a person sees of a data set: tables of its groups and numbers, the film of an episode, and drawings."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bam_envs.core.spaces import leaves_by_path, part_at
from bam_envs.core.wording import did_you_mean
from bam_train.data.data_set import DataSet
from bam_train.data.data_set_writer import require_same
from bam_train.data.recorded_episode import Array, Episode, Leaf
from bam_train.environments import make_env, must_be_named
from bam_train.errors import SettingsError
from bam_train.evaluation import wilson_interval
from bam_train.files.pictures import Frame, new_figure, picture, require_picture_path, save_figure
from bam_train.recording.recorder import number_names

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

KINDS = ("episodes", "numbers", "success", "table")
MOST_NUMBERS, MOST_SAMPLES, MOST_EPISODES = 48, 300, 6
_WINDOW = 20
"""Episodes of the running success."""
_SAME = 1e-4
"""Largest difference of an observation that is played again from the recorded one."""


def groups(data: DataSet, by: str | None = None) -> list[dict[str, Any]]:
    """A row for each value of the fact `by`, or one for all episodes.

    Keys: group, episodes, steps, successes (None if unknown), success and its 95 % interval, mean and deviation of the
    returns, mean length.
    """
    rows = [data.facts(index) for index in range(len(data))]
    if by is not None and rows and not any(by in row for row in rows):
        known = {name for row in rows for name in row}
        raise SettingsError(f"--by: no episode of {data.place} has {by!r}. {did_you_mean(by, known)}")
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        found["all" if by is None else str(row.get(by, "-"))].append(row)
    return [_group(name, members) for name, members in found.items()]


def _group(name: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    known = [row["success"] for row in rows if row["success"] is not None]
    lengths, returns = [row["length"] for row in rows], [row["return"] for row in rows]
    return {
        "group": name,
        "episodes": len(rows),
        "steps": sum(lengths),
        "successes": sum(known) if known else None,
        "success": float(np.mean(known)) if known else None,
        "success_interval": list(wilson_interval(sum(known), len(known))) if known else None,
        "mean_return": float(np.mean(returns)),
        "std_return": float(np.std(returns)),
        "mean_length": float(np.mean(lengths)),
    }


def numbers(data: DataSet) -> list[dict[str, Any]]:
    """A row for each number of a step: column, name, unit, min, q01, q50, q99, max, mean and std.

    A number that is scaled (`Label.scale`) has no unit any more, and its row says so.
    """
    stats = data.stats()
    units = {
        column: [_unit(one) for one in data.info.contract.get(kind) or ()]
        for column, kind in (("observation.state", "observation"), ("action", "action"), ("command", "command"))
    }
    rows = []
    for column, found in stats.items():
        names = data.features[column]["names"] or []
        flat = {key: np.ravel(values) for key, values in found.items()}
        for i in range(len(flat["mean"])):
            name = str(names[i]) if len(names) == len(flat["mean"]) else str(i) if len(flat["mean"]) > 1 else ""
            unit = units.get(column, [])[i] if len(units.get(column, [])) == len(flat["mean"]) else ""
            values = {key: float(flat[key][i]) for key in ("min", "q01", "q50", "q99", "max", "mean", "std")}
            rows.append({"column": column, "name": name, "unit": unit, **values})
    return rows


def _unit(row: Mapping[str, Any]) -> str:
    """The unit of the numbers of a column as they are recorded, by its row in the contract."""
    return str(row.get("unit") or "") if row.get("scale", "1") == "1" else "scaled"


def frames(data: DataSet, index: int, camera: str | None = None) -> Iterator[Frame]:
    """The pictures of an episode, RGB. Shape of each: (height, width, 3).

    Raises:
        SettingsError: There are no pictures, and the episode cannot be played again: its seed is not known, its
            environment is not this one's, or it goes another way.
    """
    episode = data[index]
    cameras = {leaf.column.removeprefix("observation.images."): leaf for leaf in _cameras(data)}
    if camera is not None and not cameras:
        raise SettingsError(f"--camera: {data.place} has no recorded pictures; leave it out")
    if camera is not None and camera not in cameras:
        raise SettingsError(f"--camera: {data.place} has no {camera!r}. {did_you_mean(camera, cameras)}")
    if cameras:
        leaf = cameras[camera or next(iter(cameras))]
        for pixels in leaf.of(episode.observations):
            yield np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[:, :, :3]
        return
    yield from _played(data, index, episode)


def _cameras(data: DataSet) -> list[Leaf]:
    return [leaf for leaf in data.info.observation_leaves if leaf.is_image]


def _played(data: DataSet, index: int, episode: Episode) -> Iterator[Frame]:
    what = f"{data.place}: episode {index} has no pictures"
    if "seed" not in episode.facts:
        raise SettingsError(f"{what}, and its seed is not known; show one with a seed, or record pictures")
    if must_be_named(data.info.env):
        raise SettingsError(f"{what}, and {data.info.env} is in a module that is not installed as trusted")
    env = make_env(data.info.env, data.info.env_kwargs, render_mode="rgb_array")
    try:
        observation, _ = env.reset(seed=int(episode.facts["seed"]))
        for step in range(len(episode) + 1):
            if not _is_same(observation, episode.observations, step):
                raise SettingsError(
                    f"{what}, and played again it differs from step {step} on; its environment was another one"
                )
            yield picture(env)
            if step < len(episode):
                observation, *_ = env.step(episode.actions[step])
    finally:
        env.close()  # type: ignore[no-untyped-call]


def _is_same(found: object, recorded: object, step: int) -> bool:
    pairs = [(part_at(found, path), array[step]) for path, array in leaves_by_path(recorded)]
    return all(np.allclose(one, other, rtol=_SAME, atol=_SAME, equal_nan=True) for one, other in pairs)


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
