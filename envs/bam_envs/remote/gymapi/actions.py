"""Actions as bam_msgs/GymAction and back; see `gymapi_leaves` for what goes where.

What the lists cannot say exactly (Text, Sequence, images, infinities) is JSON in ``prefix``, marked by ``bam:``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium import Space, spaces

from bam_envs.remote.gymapi.leaves import (
    EXACT,
    GRIPPER_WIDTH,
    IMAGE,
    NUMBERS,
    POSE,
    Leaf,
    Path,
    from_pose,
    in_order,
    joined,
    leaves_of,
    part_of,
    split,
    to_numbers,
    to_pose,
)
from bam_envs.remote.values import exact, pack, tree_from_json, tree_to_json
from bam_envs.rosbridge.strict_json import dump_json, load_json

DEFAULT = 1
"""The action_type of an action that is none of the rack's own."""
PREFIX = "bam:"
WAYPOINT = {
    "kp_scale": 1.0,
    "kd_scale": 1.0,
    "max_velocity": 10.0,
    "max_effort": 1.0,
    "target_link": "tcp_world",
    "planner": "ptp",
    "vel_scale": 1.0,
    "accel_scale": 1.0,
    "blend_radius": 0.0,
    "goal_tol": 0.2,
    "path_tol": 0.2,
}
"""How a rack's own client goes to a pose."""


class ActionCodec:
    """Actions of one space as GymAction messages and back.

    Args:
        space: Of one row.
        action_type: What a rack is to do with it: 1 default, 2 pick and lift, 3 pick and place, 4 open, 5 fold.
    """

    def __init__(self, space: Space[Any], action_type: int = DEFAULT) -> None:
        self.space, self.action_type = space, action_type
        leaves = leaves_of(space, "action", gripper=True)
        self._exact = any(leaf.kind in (EXACT, IMAGE) for leaf in leaves)
        numbers = [leaf for leaf in leaves if leaf.kind == NUMBERS]
        self._continuous = [leaf for leaf in numbers if isinstance(leaf.space, spaces.Box)]
        self._discrete = [leaf for leaf in numbers if not isinstance(leaf.space, spaces.Box)]
        self._poses = [leaf for leaf in leaves if leaf.kind == POSE]

    def encode(self, action: Any) -> dict[str, Any]:
        """The message of `action`; fields at their defaults are left out.

        Raises:
            InvalidValue: It is not one of the space, or NaN is in it.
        """
        value = exact(self.space, action, "action")
        fields = None if self._exact else self._fields(value)
        return {"action_type": self.action_type, **(self._in_prefix(value) if fields is None else fields)}

    def decode(self, message: Mapping[str, Any]) -> Any:
        """The action in a complete, checked message.

        Raises:
            ProtocolError: Something is missing, too much, or does not fit.
            InvalidValue: It is not one of the space.
        """
        prefix = message["prefix"]
        if prefix.startswith(PREFIX):
            tree = tree_from_json(load_json(prefix.removeprefix(PREFIX), "prefix").get("action"))
            return exact(self.space, tree, "action")
        values = {**self._numbers(message, "continuous"), **self._numbers(message, "discrete"), **self._pose(message)}
        return joined(self.space, values)

    def _in_prefix(self, value: Any) -> dict[str, Any]:
        tree = tree_to_json(pack(self.space, value, "action"))
        return {"prefix": PREFIX + dump_json({"action": tree}, "An action")}

    def _fields(self, value: Any) -> dict[str, Any] | None:
        """The lists, or None if they cannot say it exactly."""
        fields: dict[str, Any] = {}
        for name, leaves in (("continuous", self._continuous), ("discrete", self._discrete)):
            lists = [to_numbers(part_of(value, leaf.path)) for leaf in leaves]
            if None in lists:
                return None
            if leaves:
                fields[f"{name}_names"] = _labels(leaves)
                fields[f"{name}_action"] = [number for numbers in lists for number in numbers or ()]
        poses = [to_pose(part_of(value, leaf.path)) for leaf in self._poses]
        if None in poses:
            return None
        if poses:
            params = [_param(part_of(value, leaf.path)) for leaf in self._poses]
            fields |= {"pose_names": [one.name for one in self._poses], "pose_action": poses, "pose_param": params}
        return fields

    def _numbers(self, message: Mapping[str, Any], kind: str) -> dict[Path, Any]:
        leaves = self._continuous if kind == "continuous" else self._discrete
        field = f"{kind}_action"
        ordered = in_order(message[field], message[f"{kind}_names"], tuple(_labels(leaves)), field)
        return split(leaves, ordered)

    def _pose(self, message: Mapping[str, Any]) -> dict[Path, Any]:
        expected = tuple(leaf.name for leaf in self._poses)
        poses = in_order(message["pose_action"], message["pose_names"], expected, "pose_action")
        params = [one[GRIPPER_WIDTH] for one in message["pose_param"]]
        widths = in_order(params or [0.0] * len(poses), message["pose_names"], expected, "pose_param")
        return {
            leaf.path: from_pose(leaf, pose, width)
            for leaf, pose, width in zip(self._poses, poses, widths, strict=True)
        }


def _labels(leaves: list[Leaf]) -> list[str]:
    return [label for leaf in leaves for label in leaf.labels]


def _param(pose: Mapping[str, Any]) -> dict[str, Any]:
    return {**WAYPOINT, GRIPPER_WIDTH: float(pose[GRIPPER_WIDTH].item()) if GRIPPER_WIDTH in pose else 0.0}
