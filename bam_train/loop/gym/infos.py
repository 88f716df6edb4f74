"""Chosen entries of the environments' infos as variables: the value and whether an environment gave one.

As in Gymnasium's vector environments, entry k is the variable ``info/k`` beside the mask ``info/_k``. A variable begins
with the first value that any environment gives, since its dtype and shape are not known earlier; from then on it is
written at every time, zero where the mask is False.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_train.errors import ValueMismatch
from bam_train.loop.arrays import kind_name

Array = NDArray[Any]


class InfoRecorder:
    """Takes the entries named `keys` out of infos.

    Args:
        keys: Which.
        rows: How many environments.
        for_torch: Floats become float32, else they become float64.
    """

    def __init__(self, keys: Sequence[str], rows: int, for_torch: bool) -> None:
        self.keys, self._rows = tuple(keys), rows
        self._floats = np.dtype(np.float32 if for_torch else np.float64)
        self._known: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}

    def of_rows(self, infos: Sequence[Mapping[str, Any]]) -> dict[str, Array]:
        """From one info for each environment."""
        found: dict[str, Array] = {}
        for key in self.keys:
            mask = np.array([key in info for info in infos])
            given = [(k, info[key]) for k, info in enumerate(infos) if mask[k]]
            if given:
                self._learn(key, np.asarray(given[0][1]))
            if key in self._known:
                self._write(found, key, mask, given)
        return found

    def of_vector(self, infos: Mapping[str, Any]) -> dict[str, Array]:
        """From the infos of a vector environment."""
        found: dict[str, Array] = {}
        for key in self.keys:
            mask = np.zeros(self._rows, dtype=bool)
            if key in infos:
                mask[:] = infos.get(f"_{key}", True)
                values = np.asarray(infos[key])
                self._learn(key, values[0])
            if key in self._known:
                self._write(found, key, mask, [(mask, values[mask])] if mask.any() else [])
        return found

    def replaced(self, new: dict[str, Array], old: Mapping[str, Array], rows: Array) -> None:
        """In `new`, take these rows (n,) bool from `old`; where `old` has nothing, nothing was given."""
        for name, array in old.items():
            if name.startswith("info/") and name not in new:
                new[name] = np.zeros_like(array)
        for name, array in new.items():
            array[rows] = old[name][rows] if name in old else 0

    def _learn(self, key: str, value: Any) -> None:
        array = np.asarray(value)
        kinds = {"b": np.dtype(bool), "i": np.dtype(np.int64), "u": np.dtype(np.int64), "f": self._floats}
        if array.dtype.kind not in kinds:
            raise ValueMismatch(f"info {key!r}: expected a number or an array of them, found a {kind_name(value)}.")
        self._known.setdefault(key, (kinds[array.dtype.kind], array.shape))

    def _write(self, found: dict[str, Array], key: str, mask: Array, given: Sequence[tuple[Any, Any]]) -> None:
        dtype, shape = self._known[key]
        found[f"info/{key}"] = values = np.zeros((self._rows, *shape), dtype)
        found[f"info/_{key}"] = mask
        for rows, value in given:
            if np.shape(value)[np.ndim(rows) :] != shape:
                raise ValueMismatch(f"info {key!r}: expected shape {shape}, found {np.shape(value)[np.ndim(rows) :]}.")
            values[rows] = value
