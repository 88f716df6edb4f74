"""Weights, statistics and golden actions as safetensors: a format in which nothing can be executed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from bam_train.errors import FormatError

MOST_HEADER = 2**23
"""Most bytes of a file's JSON header, which takes many times as much memory once it is read."""


def dump(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Write arrays as one safetensors file.

    Args:
        arrays: Any shapes; dtypes bool, (u)int8-64, float16-64.

    Raises:
        FormatError: An array's dtype cannot be stored.
    """
    for name, array in arrays.items():
        if np.asarray(array).dtype.kind not in "biuf":
            expected = "expected bool, an integer or a float type"
            raise FormatError(f"array {name!r}: dtype {np.asarray(array).dtype} cannot be stored; {expected}")
    data: bytes = safetensors.numpy.save({name: np.asarray(array, order="C") for name, array in arrays.items()})
    return data


def parse(data: bytes) -> dict[str, np.ndarray]:
    """Read a safetensors file; every array is a writable copy.

    Raises:
        FormatError: Not safetensors, truncated, or arrays that do not fill the file exactly.
    """
    size = int.from_bytes(data[:8], "little")
    if len(data) < 8 or size > min(MOST_HEADER, len(data) - 8):
        raise FormatError(f"not a safetensors file: {len(data)} bytes, too short for its header")
    try:
        return {name: np.array(array) for name, array in safetensors.numpy.load(data).items()}
    except KeyError as error:
        raise FormatError(f"not a safetensors file of numbers: dtype {error} is not known") from error
    except (SafetensorError, ValueError, OverflowError) as error:
        raise FormatError(f"not a safetensors file: {error}") from error
