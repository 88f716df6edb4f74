"""Poses on a floor (x, y [m], yaw [rad]): those that are drawn, and those that the options of a reset ask for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bam_envs.core.errors import InvalidValue
from bam_envs.core.task import Array

START_TOLERANCE = 0.2
"""A base that is nearer than this to where it is to start is there [m], [rad]."""
_MEANT = "x, y [m] and yaw [rad]"


def spread(draws: Array, low: float, high: float) -> Array:
    """`draws` from [0, 1) as numbers from `low` to `high`."""
    return low + draws * (high - low)


def floor_pose(name: str, value: Any, boundary: float) -> Array:
    """The reset option `name` as a pose, with its yaw from -pi to pi. Shape: (3,).

    Args:
        name: For texts.
        value: Three numbers.
        boundary: How far the floor goes from the origin, along x and along y [m].

    Raises:
        InvalidValue: It is no pose, or not on the floor.
    """
    try:
        pose = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidValue(f"{name} must be three numbers, {_MEANT}, not {value!r}.") from error
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise InvalidValue(f"{name} must be three finite numbers, {_MEANT}, not {pose.tolist()}.")
    if np.abs(pose[:2]).max() > boundary:
        raise InvalidValue(f"{name} must be within {boundary:g} m of the origin along x and y, not {pose.tolist()}.")
    pose[2] = np.mod(pose[2] + math.pi, 2 * math.pi) - math.pi
    return pose


def preferred(asked: Array, drawn: Array) -> Array:
    """What was asked, and where that is nothing (NaN), what was drawn. Shape: (k, 3)."""
    return np.where(np.isnan(asked), drawn, asked)


def require_at(asked: Array, pose: Array) -> None:
    """Bases at `pose` (k, 3) are where they were `asked` (k, 3) to start; NaN is anywhere.

    Raises:
        InvalidValue: One is not, since a live base goes nowhere by itself.
    """
    off = asked - pose
    off[:, 2] = np.mod(off[:, 2] + math.pi, 2 * math.pi) - math.pi
    wrong = np.flatnonzero((np.abs(off) > START_TOLERANCE).any(axis=1))
    if len(wrong):
        there, here = asked[wrong[0]].tolist(), np.round(pose[wrong[0]], 3).tolist()
        raise InvalidValue(
            f"start_pose: this robot stays where it is, at {here}, and does not start at {there} (x, y [m], yaw "
            "[rad]). Drive it there, or leave start_pose out."
        )
