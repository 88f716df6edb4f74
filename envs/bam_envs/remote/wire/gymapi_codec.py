"""Actions and results of one environment as GymAPI messages and back; see `gymapi_leaves` for the layout.

Values that the lists of an action cannot hold exactly (Text, Sequence, images, infinities) are JSON in ``prefix``,
marked by ``bam:``; values that the fields of an observation cannot hold are JSON in ``info``, by the name of the leaf.
Images go into ``color_img``: all of them if that is a list, else the first one. Depth images of racks are read from
``depth_img``.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import Space, spaces

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.core.spaces import Path, joined, part_at
from bam_envs.core.wording import brief
from bam_envs.remote.wire.gymapi_leaves import (
    EXACT,
    GRIPPER_WIDTH,
    IMAGE,
    NUMBERS,
    POSE,
    GymApiLeaf,
    Lists,
    is_depth,
    leaves_of,
)
from bam_envs.remote.wire.gymapi_messages import PREFIX, GymResponse, write_feedback
from bam_envs.remote.wire.gymapi_versions import JUNE_22, GymApiVersion
from bam_envs.remote.wire.transport import EnvSpecMessage, Info
from bam_envs.remote.wire.values import exact, pack, tree_from_json, tree_to_json
from bam_envs.ros.images import FORMATS, color_message, read_color_message, read_depth_message
from bam_envs.rosbridge.encoding import dump_json, load_json

Trees = dict[str, Any]
Values = dict[Path, Any]
DEFAULT = 1
"""The action_type of an action that is not a skill of the rack."""
WAYPOINT = {"target_link": "tcp_world", "planner": "ptp", "max_velocity": 10.0, "blend_radius": 0.0}
WAYPOINT |= dict.fromkeys(("kp_scale", "kd_scale", "max_effort", "vel_scale", "accel_scale"), 1.0)
WAYPOINT |= dict.fromkeys(("goal_tol", "path_tol"), 0.2)
"""Parameters of a motion to a pose, as in the racks' own client."""


class ActionCodec:
    """Actions of one space as GymAction messages and back; for `action_type` see `RosbridgeTransport`."""

    def __init__(self, space: Space[Any], action_type: int = DEFAULT) -> None:
        self.space, self.action_type = space, action_type
        leaves = leaves_of(space, "action", gripper=True)
        boxes = tuple(leaf for leaf in leaves if leaf.kind == NUMBERS and isinstance(leaf.space, spaces.Box))
        others = tuple(leaf for leaf in leaves if leaf.kind == NUMBERS and not isinstance(leaf.space, spaces.Box))
        self._numbers = [
            Lists("continuous_names", "continuous_action", boxes),
            Lists("discrete_names", "discrete_action", others),
        ]
        self._poses = Lists("pose_names", "pose_action", tuple(leaf for leaf in leaves if leaf.kind == POSE))
        self._fits = all(leaf.kind in (NUMBERS, POSE) for leaf in leaves)

    def encode(self, action: Any) -> dict[str, Any]:
        """The message of `action`, without fields at their defaults; raises InvalidValue if it does not fit."""
        value = exact(self.space, action, "action")
        fields: dict[str, Any] = {}
        for lists in (*self._numbers, self._poses):
            written = self._fits and all(lists.write(leaf, part_at(value, leaf.path), fields) for leaf in lists.leaves)
            if not written:
                tree = tree_to_json(pack(self.space, value, "action"))
                text = PREFIX + dump_json({"action": tree}, "An action")
                return {"action_type": self.action_type, "prefix": text}
        if poses := [part_at(value, leaf.path) for leaf in self._poses.leaves]:
            widths = [float(one.get(GRIPPER_WIDTH, np.zeros(())).item()) for one in poses]
            fields["pose_param"] = [{**WAYPOINT, GRIPPER_WIDTH: width} for width in widths]
        return {"action_type": self.action_type, **fields}

    def decode(self, message: Mapping[str, Any]) -> Any:
        """The action in a checked message; raises ProtocolError or InvalidValue if it does not fit."""
        prefix = message["prefix"]
        if prefix.startswith(PREFIX):
            tree = tree_from_json(load_json(prefix.removeprefix(PREFIX), "prefix").get("action"))
            return exact(self.space, tree, "action")
        values = self._poses.read(message)
        if widths := [one[GRIPPER_WIDTH] for one in message["pose_param"]]:
            ordered = self._poses.in_order(widths, message["pose_names"], "pose_param")
            for pose, width in zip(values.values(), ordered, strict=True):
                if GRIPPER_WIDTH in pose:
                    pose[GRIPPER_WIDTH][...] = width
        for lists in self._numbers:
            values |= lists.read(message)
        return joined(self.space, values)


class ObservationCodec:
    """Observations of one space as fields of GymFeedback and back; `image_format` is ``png`` or ``jpeg``."""

    def __init__(self, space: Space[Any], image_format: str = "png") -> None:
        self.space, self.image_format = space, image_format
        self._leaves = leaves_of(space, "observation")
        self._images = [leaf for leaf in self._leaves if leaf.kind == IMAGE]
        if image_format not in FORMATS:
            raise InvalidValue(f"The image format must be png or jpeg, not {image_format!r}.")

    def encode(
        self, observation: Any, stamp: Mapping[str, int] | None = None, version: GymApiVersion = JUNE_22
    ) -> tuple[dict[str, Any], Trees]:
        """Fields of a message, without those at their defaults, and exact trees of the parts that are not in them.

        Raises:
            InvalidValue: It is not in the space, or contains NaN.
            MissingExtra: There is an image, and Pillow is not installed.
        """
        value = exact(self.space, observation, "observation")
        fields: dict[str, Any] = {}
        trees: Trees = {}
        images = self._images if version.lists else self._images[:1]
        for leaf in self._leaves:
            part = part_at(value, leaf.path)
            if leaf in images:
                image = color_message(part, self.image_format, leaf.name, stamp)
                fields["color_img"] = [*fields.get("color_img", []), image] if version.lists else image
            elif not (leaf.kind in (NUMBERS, POSE) and _lists(leaf.kind).write(leaf, part, fields)):
                trees[leaf.name] = tree_to_json(pack(leaf.space, part, leaf.name))
        return fields, trees

    def decode(self, feedback: Mapping[str, Any], trees: Mapping[str, Any]) -> Any:
        """The observation in a checked message and its exact trees; raises ProtocolError if it does not fit."""
        try:
            values: Values = {
                leaf.path: exact(leaf.space, tree_from_json(trees[leaf.name]), leaf.name)
                for leaf in self._leaves
                if leaf.name in trees
            }
            self._read_images(feedback, values)
            for kind in (NUMBERS, POSE):
                if leaves := self._missing(kind, values):
                    values |= _lists(kind, leaves).read(feedback)
            if unread := self._missing(EXACT, values):
                names = ", ".join(leaf.name for leaf in unread)
                raise ProtocolError(f"The feedback does not hold {names}: only a server of bam-train can send that.")
            return exact(self.space, joined(self.space, values), "observation")
        except InvalidValue as error:
            raise ProtocolError(f"The observation does not fit its space: {error}") from error

    def _missing(self, kind: str, values: Values) -> tuple[GymApiLeaf, ...]:
        return tuple(leaf for leaf in self._leaves if leaf.kind == kind and leaf.path not in values)

    def _read_images(self, feedback: Mapping[str, Any], values: Values) -> None:
        """Read the depth images, of which some may be in the lists instead, and every colour image."""
        named = set(feedback["observation_names"])
        fitting = [leaf for leaf in self._leaves if is_depth(leaf.space) and leaf.path not in values]
        wanted = [leaf for leaf in fitting if not named & set(leaf.labels)]
        depths = [read_depth_message(one) for one in _listed(feedback["depth_img"])] if wanted else []
        for leaf, depth in zip(wanted, (one for one in depths if one is not None), strict=False):
            values[leaf.path] = _shaped(leaf, depth, "depth_img").astype(leaf.space.dtype)
        leaves, images = self._missing(IMAGE, values), _listed(feedback["color_img"])
        names = [one["header"]["frame_id"] for one in images]
        if all(leaf.name in names for leaf in leaves):
            images = [images[names.index(leaf.name)] for leaf in leaves]
        if len(images) < len(leaves):
            raise ProtocolError(f"color_img must hold {len(leaves)} images, not {len(images)}.")
        for leaf, message in zip(leaves, images, strict=False):
            image = read_color_message(message)
            if image is None:
                raise ProtocolError(f"color_img must hold {leaf.name}, and is empty.")
            values[leaf.path] = _shaped(leaf, image, "color_img")


def _lists(kind: str, leaves: tuple[GymApiLeaf, ...] = ()) -> Lists:
    """The lists of a feedback, in which a rack may send more than the space contains."""
    if kind == NUMBERS:
        return Lists("observation_names", "observation", leaves, extra=True)
    return Lists("pose_names", "pose", leaves, extra=True)


def _listed(images: Any) -> list[Mapping[str, Any]]:
    """A list of images; racks send one image or a list, depending on their version."""
    return list(images) if isinstance(images, (list, tuple)) else [images]


def _shaped(leaf: GymApiLeaf, image: np.ndarray[Any, Any], field: str) -> np.ndarray[Any, Any]:
    shape = leaf.space.shape or ()
    # A grey image in a file has no channel axis.
    if image.shape != shape and (*image.shape, 1) != shape:
        raise ProtocolError(f"{field} must hold an image of shape {shape} for {leaf.name}, not {image.shape}.")
    return image.reshape(shape)


class EnvCodec:
    """Actions and results as messages, one for each environment of `spec`; `foreign`: of a rack without `bam-serve`."""

    def __init__(
        self, spec: EnvSpecMessage, *, foreign: bool = False, action_type: int = DEFAULT, image_format: str = "png"
    ) -> None:
        self.spec, self.foreign = spec, foreign
        self._actions = ActionCodec(spec.action_space, action_type)
        self._observations = ObservationCodec(spec.observation_space, image_format)

    def write_actions(self, action: Any) -> tuple[dict[str, Any], ...]:
        """The messages of an action. Raises InvalidValue if it does not fit."""
        return tuple(self._actions.encode(one) for one in self.spec.each(action))

    def read_actions(self, messages: Sequence[Mapping[str, Any]]) -> Any:
        """The action in complete, checked messages. Raises InvalidValue or ProtocolError if they do not fit."""
        size = self.spec.num_envs
        if len(messages) != size:
            raise InvalidValue(f"A step must have {size} actions, one for each environment, not {len(messages)}.")
        actions = [self._actions.decode(one) for one in messages]
        return actions if self.spec.vector else actions[0]

    def write_result(
        self,
        result: tuple[Any, ...],
        stamp: Mapping[str, int],
        version: GymApiVersion = JUNE_22,
        *,
        executed: bool = True,
    ) -> list[dict[str, Any]]:
        """The feedback of a result of `EnvServer`, sent at `stamp`; `executed`: whether the action was executed."""
        feedback = []
        for observation, *ends, info in self.spec.split(result):
            fields, trees = self._observations.encode(observation, stamp, version)
            flags: Any = ends or (0.0, False, False)
            feedback.append(write_feedback(fields, trees, flags, info, version, executed=executed))
        return feedback

    def read_result(self, response: GymResponse) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info). Raises ProtocolError if the feedback does not fit."""
        size, count = self.spec.num_envs, len(response.feedback)
        if count != size:
            raise ProtocolError(f"The response must have {size} feedback, one for each environment, not {count}.")
        each = zip(response.feedback, response.infos, response.exact, strict=True)
        result: tuple[Any, Any, Any, Any, Any] = self.spec.joined([self._read(*one) for one in each])
        return result

    def _read(self, feedback: Mapping[str, Any], info: Info, bam: Info) -> tuple[Any, float, bool, bool, Info]:
        trees = bam.get("observation", {})
        if not isinstance(trees, dict):
            raise ProtocolError(f"info.bam.observation must be an object, not {brief(trees)}.")
        observation = self._observations.decode(feedback, trees)
        if self.foreign:
            info["executed"] = feedback["executed"]
        elif self.spec.vector and "final_obs" in info:
            try:
                info["final_obs"] = exact(self.spec.observation_space, info["final_obs"], "final_obs")
            except InvalidValue as error:
                raise ProtocolError(str(error)) from error
        return observation, float(feedback["reward"]), feedback["terminated"], feedback["truncated"], info
