"""What is in a data set: groups of episodes with their success, and the statistics of every number."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bam_envs.core.wording import did_you_mean
from bam_train.data.data_set import DataSet
from bam_train.errors import SettingsError
from bam_train.evaluation import wilson_interval


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
