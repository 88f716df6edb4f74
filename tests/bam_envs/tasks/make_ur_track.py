"""Make the joint trajectory that bam/ur-track-v0 follows: from place to place and back, at 20 Hz.

Wrist 1 of a UR5 whose flange points down goes around three places in three segments: up from one, over, and down to the
next. The joints run along a cubic spline through the poses on the way, from rest to rest (minimum jerk in the spline's
parameter).

    python -m tests.bam_envs.tasks.make_ur_track >envs/bam_envs/tasks/data/ur_track.json
"""

import json
import math

import numpy as np
from numpy.typing import NDArray

from bam_envs.robots.splines import splines_through

WAYPOINTS = (162, 137, 213)
"""Of each segment."""
RATE = 20.0
"""Waypoints a second [Hz]."""
PLACES = ((-0.75, 0.46), (0.15, 0.50), (0.90, 0.44))
"""Angle of the base joint [rad] at each place, and how far wrist 1 is from the shoulder's axis [m]."""
LOW, HIGH = 0.16, 0.34
"""Height of wrist 1 above the shoulder at a place, and on the way [m]."""
UPPER_ARM, FOREARM = 0.425, 0.39225
"""Lengths of a UR5 [m]."""


def pose(base: float, reach: float, height: float) -> list[float]:
    """Joints [rad] with wrist 1 at `reach` and `height` [m] from the shoulder, elbow up, the flange pointing down."""
    cosine = (reach**2 + height**2 - UPPER_ARM**2 - FOREARM**2) / (2 * UPPER_ARM * FOREARM)
    fold = math.acos(cosine)
    rise = math.atan2(height, reach) + math.atan2(FOREARM * math.sin(fold), UPPER_ARM + FOREARM * math.cos(fold))
    shoulder = rise - math.pi  # the arm works on the side that the base joint turns away from x
    return [base, shoulder, -fold, -1.5 * math.pi - shoulder + fold, math.pi / 2, 0.0]


def segment(first: tuple[float, float], last: tuple[float, float], waypoints: int) -> NDArray[np.float64]:
    """From place to place. Shape: (waypoints, 6) rad, in ten thousandths."""
    (base, reach), (next_base, next_reach) = first, last
    middle = ((base + next_base) / 2, (reach + next_reach) / 2)
    poses = [pose(*first, LOW), pose(*first, HIGH), pose(*middle, HIGH), pose(*last, HIGH), pose(*last, LOW)]
    t = np.linspace(0.0, 1.0, waypoints)
    smooth = t**3 * (10 - 15 * t + 6 * t**2)
    joints: NDArray[np.float64] = splines_through(np.array([poses])).at(smooth[None])[0].round(4)
    return joints


def trajectory() -> list[NDArray[np.float64]]:
    """The three segments, the last of which ends where the first begins."""
    ends = zip(PLACES, PLACES[1:] + PLACES[:1], WAYPOINTS, strict=True)
    return [segment(first, last, waypoints) for first, last, waypoints in ends]


if __name__ == "__main__":
    rows = ",\n".join(json.dumps(one.tolist(), separators=(",", ":")) for one in trajectory())
    print('{"trajectory":[\n' + rows + "\n]}")
