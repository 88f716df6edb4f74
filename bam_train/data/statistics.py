"""meta/stats.json: least, greatest, mean, deviation and quantiles of each column, kept up to date file by file."""

from __future__ import annotations

from typing import Any

import numpy as np

from bam_train.data.recorded_episode import Array

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
MOST_IMAGES = 20
"""Pictures of one file that are looked at."""


def add_stats(old: dict[str, Any], episodes: list[dict[str, Array]], images: set[str]) -> dict[str, Any]:
    """The statistics `old` with those of more episodes, given as columns."""
    stats = dict(old)
    for name in {name: None for columns in episodes for name in columns}:
        parts = [columns[name] for columns in episodes if name in columns]
        if parts[0].dtype.kind not in "UO":
            stats[name] = _together(old.get(name), _stats(parts, name in images))
    return stats


def _stats(parts: list[Array], is_image: bool) -> dict[str, Any]:
    """As LeRobot has them: lists; of pictures scaled to 0 to 1, one number a channel of shape (channels, 1, 1)."""
    count = sum(map(len, parts))
    if is_image:
        pictures = [picture for part in parts for picture in part[:: max(1, len(part) * len(parts) // MOST_IMAGES)]]
        values = np.concatenate([picture.reshape(-1, picture.shape[-1]) for picture in pictures]) / 255.0
    else:
        values = np.concatenate(parts).reshape(count, -1).astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    found |= dict(zip(QUANTILES, quantiles, strict=True))
    shape = (-1, 1, 1) if is_image else (-1,)
    return {**{key: one.reshape(shape).tolist() for key, one in found.items()}, "count": [count]}


def _together(old: dict[str, Any] | None, new: dict[str, Any]) -> dict[str, Any]:
    """Both; the quantiles are weighted means, as LeRobot's own."""
    if old is None:
        return new
    a, b = ({key: np.asarray(value, np.float64) for key, value in one.items()} for one in (old, new))
    share = b["count"][0] / (a["count"][0] + b["count"][0])
    both = {key: (1 - share) * a[key] + share * b[key] for key in ("mean", *QUANTILES)}
    variance = (1 - share) * a["std"] ** 2 + share * b["std"] ** 2 + share * (1 - share) * (a["mean"] - b["mean"]) ** 2
    both |= {"min": np.minimum(a["min"], b["min"]), "max": np.maximum(a["max"], b["max"]), "std": np.sqrt(variance)}
    return {key: value.tolist() for key, value in both.items()} | {"count": [int(a["count"][0] + b["count"][0])]}
