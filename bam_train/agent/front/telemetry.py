"""What a robot does, as one message of plain values for people who look at it: numbers, picture, room to its limits."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.description import Gripper, cube_edge
from bam_envs.arms.serial_chain import Arm, chain_of
from bam_envs.core.kinematics import UR5E_GRIPPER, UR_JOINTS
from bam_envs.core.robot import RobotSpec, RobotState, SignalSpec
from bam_envs.safety.arm_tubes import tubes_of
from bam_envs.safety.base_guards import LaserZones
from bam_envs.safety.guard import Limits, columns_in, is_base, measured_places, position_range

Array = NDArray[np.float64]
Row = dict[str, Any]
_MOST = 16
"""Most numbers of a signal that is sent; longer ones are scans, which are drawn."""
_POINTS = 180
"""Most points of the scans in a message."""
_MARGIN_SPAN, _SPAN, _LASER_SPAN = 0.5, 0.1, 1.0
"""Room beyond a limit from which on a bar fills: of joints [rad], of an arm's tool and links [m], of a base [m]."""


class Telemetry:
    """Makes the messages of one robot.

    Args:
        spec: The robot.
        limits: The limits of its guards.
        geometry: Kinematics of an arm; None: those of a UR5e with a gripper, if its joints have their names.
        workspace: Where the task moves the tool: lowest and highest x, y, z [m]; None: anywhere. Shape: (2, 3).
    """

    def __init__(
        self, spec: RobotSpec, limits: Limits, *, geometry: Arm | None = None, workspace: Array | None = None
    ) -> None:
        self._spec, self._signals = spec, [one for one in spec.signals if len(one.labels) <= _MOST]
        self._units = {one.name: dict(zip(one.labels, one.units, strict=True)) for one in self._signals}
        self._most_age = limits.max_age or (0.5 if is_base(spec) else 0.1)
        self._body = _Base(spec, limits) if is_base(spec) else _Arm(spec, limits, geometry, workspace)
        self.scene: dict[str, Any] = {} if isinstance(self._body, _Base) else self._body.scene()
        """What a page draws an arm from, told once; {} of a base, and of an arm whose outline is not known.

        ``joints``: names of signal and label; ``mount``, ``placements``, ``axes`` and ``tool``: its kinematics, as in
        `bam_envs.arms.serial_chain.SerialChain`, poses row by row; ``capsules``: link, two ends and radius [m];
        ``gripper``: None or ``width`` when it is open, and ``boxes``: palm, finger and pad of the right side, middle
        and half edges each, in the tool's frame [m]; ``cube``: edge of the object [m]; ``box``: lowest and highest x,
        y, z of the tool [m]; ``table``: its height [m].
        """

    def message(self, state: RobotState, t: float, *, command: Array | None = None, age: float = 0.0) -> dict[str, Any]:
        """The message about a state.

        Args:
            state: Of one robot.
            t: Wall time [s].
            command: The command that was sent last (1, m), if it is known.
            age: Age of the state [s].

        Returns:
            ``event``; ``t``; ``state`` and ``units``: a mapping by label for each signal; ``command``: number by label;
            ``tool``: x, y, z [m], of an arm; ``near``: by the name of a guard, ``value``, ``limit``, ``unit`` and
            ``share`` (0: far from it, 1: it acts); and to draw, ``object`` (pose of the tracked object: x, y, z [m] and
            a quaternion x, y, z, w); or ``base`` (x, y [m], yaw [rad]), ``outline`` (corners x, y) and ``scan`` (points
            x, y in the base's frame [m]). What is not known, or not finite, is None or left out.
        """
        near = {"state age": _below(age, self._most_age, "s")} | self._body.near(state)
        return {
            "event": "telemetry",
            "t": t,
            "state": {one.name: _named(one, state.signals[one.name][0]) for one in self._signals},
            "units": self._units,
            "command": None if command is None else _named(self._spec.command, command[0]),
            "tool": None,
            "near": {name: row for name, row in near.items() if row is not None},
            **self._body.picture(state),
        }


class _Arm:
    """An arm, whose kinematics may be unknown."""

    def __init__(self, spec: RobotSpec, limits: Limits, geometry: Arm | None, workspace: Array | None) -> None:
        self._limits, self._joints = limits, columns_in(spec.command, "rad")
        if geometry is None and tuple(spec.command.labels[at] for at in self._joints) == UR_JOINTS:
            geometry = UR5E_GRIPPER
        self._spec, self._geometry, self._has_gripper = spec, geometry, (has_gripper := "m" in spec.command.units)
        self._tubes = None if geometry is None else tubes_of(geometry, tool=has_gripper)
        self._positions = [row for row in measured_places(spec, spec.command.units) if row[0] in self._joints]
        speeds = measured_places(spec, [f"{unit}/s" for unit in spec.command.units])
        self._speeds = [row for row in speeds if row[0] in self._joints]
        low, high = position_range(spec, limits)
        self._ends = [(low[at], high[at]) for at in self._joints]
        floor = limits.table_height if has_gripper else -math.inf
        self._low = limits.box_x_min, limits.box_y_min, floor if limits.box_z_min is None else limits.box_z_min
        self._high = limits.box_x_max, limits.box_y_max, limits.box_z_max
        box = np.array([self._low, self._high])
        if workspace is not None:
            box = np.stack([np.maximum(box[0], workspace[0]), np.minimum(box[1], workspace[1])])
        self._box = _plain(box.ravel())

    def scene(self) -> dict[str, Any]:
        chain = None if self._geometry is None else chain_of(self._geometry)
        if chain is None or not chain.capsules:
            return {}
        gripper, cube = None, cube_edge(math.inf, chain.turns)
        if self._has_gripper:
            opening = self._spec.command.high[self._spec.command.units.index("m")]
            length, boxes = Gripper(open=opening).boxes(chain.tool_placement)
            from_tool = [[*middle[:2], middle[2] - length, *half] for middle, half in boxes]
            gripper, cube = {"width": opening, "boxes": from_tool}, cube_edge(opening, chain.turns)
        links = [one for one in chain.capsules if one.link <= chain.num_joints]
        labels = {one.name: one.labels for one in self._spec.signals}
        return {
            "joints": [[signal, labels[signal][column]] for _, signal, column in self._positions],
            "mount": chain.mount.ravel().tolist(),
            "placements": chain.placements.reshape(-1, 16).tolist(),
            "axes": chain.axes.tolist(),
            "tool": chain.tool_placement.ravel().tolist(),
            "capsules": [[one.link, *one.start, *one.end, one.radius] for one in links],
            "gripper": gripper,
            "cube": cube,
            "box": self._box,
            "table": self._limits.table_height,
        }

    def picture(self, state: RobotState) -> dict[str, Any]:
        if self._geometry is None:
            return {}
        shown: dict[str, Any] = {"tool": _plain(self._geometry.tool_point(_numbers(state, self._positions)))}
        if {"object_position", "object_quaternion"} <= state.signals.keys():
            w, *xyz = state.signals["object_quaternion"][0]
            shown["object"] = _plain([*state.signals["object_position"][0], *xyz, w])
        return shown

    def near(self, state: RobotState) -> dict[str, Row | None]:
        limits, geometry = self._limits, self._geometry
        q, speeds = _numbers(state, self._positions), _numbers(state, self._speeds)
        inside = min(min(value - low, high - value) for value, (low, high) in zip(q, self._ends, strict=True))
        margin = limits.position_margin
        near = {"position margin": _above(inside + margin, margin, "rad", _MARGIN_SPAN)}
        moves = len(speeds) == len(q)
        if moves:
            near["joint speed"] = _below(max(map(abs, speeds)), limits.joint_speed, "rad/s")
        if geometry is None:
            return near
        if moves:
            velocity = geometry.tool_jacobian(q)[:3] @ speeds
            near["tool speed"] = _below(float(np.linalg.norm(velocity)), limits.tool_speed, "m/s")
        rows = zip(geometry.tool_point(q), self._low, self._high, strict=True)
        near["workspace box"] = _above(min(min(at - low, high - at) for at, low, high in rows), 0.0, "m", _SPAN)
        if self._tubes is not None:
            room = min(self._tubes.nearest(q), self._tubes.lowest(q) - limits.table_height)
            near["collision"] = _above(room, limits.clearance, "m", _SPAN)
        return near


class _Base:
    """A base, whose shape may be unknown."""

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self._limits, self._body = limits, spec.body
        self._zones = None if spec.body is None else LaserZones(spec, limits, spec.body)
        self._has_scans = self._zones is not None and math.isfinite(self._zones.limit_value)
        places = measured_places(spec, spec.command.units)
        units = dict.fromkeys(spec.command.units[place] for place, *_ in places)
        self._speeds = [(unit, [one for one in places if spec.command.units[one[0]] == unit]) for unit in units]

    def picture(self, state: RobotState) -> dict[str, Any]:
        if self._body is None or "base_pose" not in state.signals:
            return {}
        points = self._points(state)
        few = points[:, :: max(1, -(-points.shape[1] // _POINTS))].T
        pose, outline = _plain(state.signals["base_pose"][0]), [_plain(one) for one in self._body.edge]
        return {"base": pose, "outline": outline, "scan": [_plain(one) for one in few]}

    def near(self, state: RobotState) -> dict[str, Row | None]:
        limits = {"m/s": ("base speed", self._limits.base_speed), "rad/s": ("turn speed", self._limits.turn_speed)}
        near = {}
        for unit, place in self._speeds:
            speed, (name, limit) = math.hypot(*_numbers(state, place)), limits[unit]
            near[name] = _below(speed, limit, unit)
        if self._body is not None and self._has_scans:
            x, y = self._points(state)
            x = x[np.abs(y) <= self._body.side]  # what it meets when it drives straight on, or back
            beyond = np.where(x > 0.0, x - self._body.front, -x - self._body.back)
            near["laser zones"] = _above(float(beyond.min(initial=math.inf)), self._limits.laser_stop, "m", _LASER_SPAN)
        return near

    def _points(self, state: RobotState) -> Array:
        """What the scanners see, in the base's frame [m]. Shape: (2, k)."""
        return self._zones.points(state.signals) if self._zones is not None and self._has_scans else np.empty((2, 0))


def _numbers(state: RobotState, places: Iterable[tuple[int, str, int]]) -> list[float]:
    return [float(state.signals[signal][0, column]) for _, signal, column in places]


def _below(value: float, limit: float, unit: str) -> Row | None:
    """How near `value` is to a `limit` above it."""
    return _row(value, limit, unit, value / limit)


def _above(value: float, limit: float, unit: str, span: float) -> Row | None:
    """How near `value` is to a `limit` below it."""
    return _row(value, limit, unit, 1.0 - (value - limit) / span)


def _row(value: float, limit: float, unit: str, share: float) -> Row | None:
    if not (math.isfinite(value) and math.isfinite(limit)):
        return None
    return {"value": round(value, 4), "limit": limit, "unit": unit, "share": round(min(max(share, 0.0), 1.0), 3)}


def _named(signal: SignalSpec, values: Array) -> dict[str, float | None]:
    return dict(zip(signal.labels, _plain(values), strict=True))


def _plain(values: Iterable[float]) -> list[float | None]:
    """Numbers for JSON, which has no NaN; None instead."""
    return [round(float(one), 5) if math.isfinite(one) else None for one in values]
