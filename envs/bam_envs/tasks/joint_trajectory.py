"""A recorded joint trajectory: segments of waypoints 1/20 s apart, in a JSON file of robo-gym's form.

``{"trajectory": [[[base, shoulder, elbow, wrist 1, wrist 2, wrist 3], ...], ...]}``: segments, waypoints, joints [rad].
"""

from __future__ import annotations

import json
import stat
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import Rows

Array = NDArray[np.float64]
RECORDED = "ur_track.json"
"""The trajectory that is shipped; ``scripts/make_ur_track.py`` makes it."""
_MOST_BYTES = 2**24
"""Size of a file at most: which file it is may come from a stranger's checkpoint."""


@dataclass(frozen=True)
class JointTrajectory:
    """Segments of waypoints; after the last segment comes the first."""

    waypoints: Array
    """Joint positions [rad]; short segments are filled up with their last waypoint. Shape: (segments, longest, 6)."""
    lengths: Rows
    """Waypoints of each segment. Shape: (segments,)."""

    def at(self, segment: Rows, step: Rows) -> tuple[Array, NDArray[np.bool_]]:
        """The waypoint of each row, and whether it waits at the end of its segment. Shapes: (n,) -> (n, 6), (n,)."""
        end = step >= self.lengths[segment]
        return self.waypoints[segment, np.minimum(step, self.lengths[segment] - 1)], end


def load_trajectory(file: str | Path | None, limits: Array) -> JointTrajectory:
    """The trajectory in `file`, or the shipped one.

    Args:
        file: A JSON file of robo-gym's form.
        limits: Lowest and highest joint positions [rad]. Shape: (2, 6).

    Raises:
        InvalidValue: There is no such file, or no trajectory of six joints inside their limits in it.
    """
    if not isinstance(file, (str, Path, type(None))):
        raise InvalidValue(f"The trajectory must be the path of a JSON file, not {file!r}.")
    segments = _shipped() if file is None else _read(Path(file).expanduser())
    for number, segment in enumerate(segments):
        outside = (segment < limits[0]) | (segment > limits[1])
        if outside.any():
            step, joint = np.argwhere(outside)[0]
            raise InvalidValue(
                f"Segment {number} of the trajectory has joint {joint} at {segment[step, joint]:g} rad in waypoint "
                f"{step}; expected {limits[0, joint]:g} to {limits[1, joint]:g}."
            )
    longest = max(len(segment) for segment in segments)
    filled = [np.pad(one, ((0, longest - len(one)), (0, 0)), mode="edge") for one in segments]
    return JointTrajectory(np.stack(filled), np.array([len(one) for one in segments], dtype=np.int64))


@lru_cache(maxsize=1)
def _shipped() -> list[Array]:
    text = (resources.files("bam_envs.tasks") / "data" / RECORDED).read_text(encoding="utf-8")
    return _segments(json.loads(text), RECORDED)


def _read(file: Path) -> list[Array]:
    try:
        text = _bounded(file)
    except OSError as error:
        raise InvalidValue(f"The trajectory {file} cannot be read: {error.strerror}.") from error
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidValue(f"The trajectory {file} is not JSON: {error}.") from error
    return _segments(content, str(file))


def _bounded(file: Path) -> bytes:
    found = file.stat()
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):  # reading a folder fails by itself
        raise InvalidValue(f"The trajectory {file} is no plain file; expected one in JSON.")
    if found.st_size > _MOST_BYTES:
        raise InvalidValue(f"The trajectory {file} has {found.st_size} bytes, expected at most {_MOST_BYTES}.")
    return file.read_bytes()


def _segments(content: Any, name: str) -> list[Array]:
    segments = content.get("trajectory") if isinstance(content, dict) else None
    if not isinstance(segments, list) or not segments:
        raise InvalidValue(f'The trajectory {name} has no list of segments under the key "trajectory".')
    return [
        _segment(waypoints, f"Segment {number} of the trajectory {name}") for number, waypoints in enumerate(segments)
    ]


def _segment(waypoints: Any, what: str) -> Array:
    try:
        array = np.array(waypoints, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidValue(f"{what} is not a list of waypoints of six numbers each.") from error
    if array.ndim != 2 or array.shape[1] != 6 or len(array) == 0:
        raise InvalidValue(f"{what} must have shape (waypoints, 6), not {array.shape}.")
    if not np.isfinite(array).all():
        raise InvalidValue(f"{what} must be finite numbers.")
    return array
