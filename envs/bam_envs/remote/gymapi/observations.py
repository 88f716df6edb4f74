"""Observations as the fields of bam_msgs/GymFeedback and back; see `gymapi_leaves` for what goes where.

Images go into ``color_img``, all of them where that is a list and the first one where it is not; a depth image that was
asked for into ``depth_img``. What these fields cannot say exactly is a tree of JSON by the name of its leaf, which
travels in ``info``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import Space

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.remote.gymapi.leaves import (
    EXACT,
    IMAGE,
    NUMBERS,
    POSE,
    Leaf,
    Path,
    from_pose,
    in_order,
    is_depth,
    joined,
    leaves_of,
    part_of,
    split,
    to_numbers,
    to_pose,
)
from bam_envs.remote.gymapi.versions import JUNE_22, Version
from bam_envs.remote.values import exact, pack, tree_from_json, tree_to_json
from bam_envs.ros.images import (
    FORMATS,
    color_message,
    depth_message,
    read_color_message,
    read_depth_message,
)

Trees = dict[str, Any]


class ObservationCodec:
    """Observations of one space as fields of GymFeedback and back.

    Args:
        space: Of one row.
        image_format: ``"png"``, which keeps every bit, or ``"jpeg"``.
        depth: Names of the leaves that are depth images [m], to be sent in whole millimetres; one at most.

    Raises:
        InvalidValue: Another format, or a name that is no leaf that may be a depth image.
    """

    def __init__(self, space: Space[Any], image_format: str = "png", depth: Sequence[str] = ()) -> None:
        self.space, self.image_format, self.depth = space, image_format, tuple(depth)
        self._leaves = leaves_of(space, "observation")
        self._images = [leaf for leaf in self._leaves if leaf.kind == IMAGE]
        if image_format not in FORMATS:
            raise InvalidValue(f"The image format must be png or jpeg, not {image_format!r}.")
        fitting = [leaf.name for leaf in self._leaves if is_depth(leaf.space)]
        if not set(self.depth) <= set(fitting) or len(self.depth) > 1:
            raise InvalidValue(f"depth must name one of the depth images ({', '.join(fitting)}), not {self.depth}.")

    def encode(
        self, observation: Any, stamp: Mapping[str, int] | None = None, version: Version = JUNE_22
    ) -> tuple[dict[str, Any], Trees]:
        """Fields of a message, those at their defaults left out, and the exact trees of what is not in them.

        Raises:
            InvalidValue: It is not one of the space, or NaN is in it.
            MissingExtra: There is an image and nothing to encode it with.
        """
        value = exact(self.space, observation, "observation")
        fields: dict[str, Any] = {}
        trees: Trees = {}
        images = self._images if version.lists else self._images[:1]
        for leaf in self._leaves:
            part = part_of(value, leaf.path)
            if leaf.name in self.depth:
                image = depth_message(part, leaf.name, stamp)
                fields["depth_img"] = [image] if version.lists else image
            elif leaf in images:
                image = color_message(part, self.image_format, leaf.name, stamp)
                fields["color_img"] = [*fields.get("color_img", []), image] if version.lists else image
            elif not _write_numbers(leaf, part, fields):
                trees[leaf.name] = tree_to_json(pack(leaf.space, part, leaf.name))
        return fields, trees

    def decode(self, feedback: Mapping[str, Any], trees: Mapping[str, Any]) -> Any:
        """The observation in a complete, checked message and its exact trees.

        Raises:
            ProtocolError: Something is missing or does not fit the space.
        """
        try:
            rest = [leaf for leaf in self._leaves if leaf.name not in trees]
            values = {one.path: _from_tree(one, trees[one.name]) for one in self._leaves if one.name in trees}
            rest = self._read_depth(rest, feedback, values)
            self._read_images([leaf for leaf in rest if leaf.kind == IMAGE], feedback, values)
            self._read_lists(rest, feedback, values)
            _refuse_missing([leaf for leaf in rest if leaf.kind == EXACT])
            return exact(self.space, joined(self.space, values), "observation")
        except InvalidValue as error:
            raise ProtocolError(f"The observation does not fit its space: {error}") from error

    def _read_lists(self, leaves: list[Leaf], feedback: Mapping[str, Any], values: dict[Path, Any]) -> None:
        numbers = [leaf for leaf in leaves if leaf.kind == NUMBERS]
        labels = tuple(label for leaf in numbers for label in leaf.labels)
        given, names = feedback["observation"], feedback["observation_names"]
        if numbers:
            values |= split(numbers, in_order(given, names, labels, "observation", extra=True))
        poses = [leaf for leaf in leaves if leaf.kind == POSE]
        if poses:
            expected = tuple(leaf.name for leaf in poses)
            ordered = in_order(feedback["pose"], feedback["pose_names"], expected, "pose", extra=True)
            values |= {leaf.path: from_pose(leaf, pose) for leaf, pose in zip(poses, ordered, strict=True)}

    def _read_images(self, leaves: list[Leaf], feedback: Mapping[str, Any], values: dict[Path, Any]) -> None:
        for leaf, message in zip(leaves, _chosen(feedback["color_img"], leaves, "color_img"), strict=True):
            image = read_color_message(message)
            if image is None:
                raise ProtocolError(f"color_img must hold {leaf.name}, and is empty.")
            values[leaf.path] = _shaped(leaf, image, "color_img")

    def _read_depth(self, leaves: list[Leaf], feedback: Mapping[str, Any], values: dict[Path, Any]) -> list[Leaf]:
        """The leaves that are left when depth images have been read."""
        names = set(feedback["observation_names"])
        wanted = [leaf for leaf in leaves if is_depth(leaf.space) and not names & set(leaf.labels)]
        images = [read_depth_message(one) for one in _listed(feedback["depth_img"])] if wanted else []
        found = [image for image in images if image is not None]
        done = wanted[: len(found)]
        for leaf, image in zip(done, found, strict=False):
            values[leaf.path] = _shaped(leaf, image, "depth_img").astype(leaf.space.dtype)
        return [leaf for leaf in leaves if leaf not in done]


def _write_numbers(leaf: Leaf, part: Any, fields: dict[str, Any]) -> bool:
    """Put numbers or a pose into `fields`, if those can say it exactly; whether they can."""
    if leaf.kind == NUMBERS and (numbers := to_numbers(part)) is not None:
        fields.setdefault("observation_names", []).extend(leaf.labels)
        fields.setdefault("observation", []).extend(map(float, numbers))
        return True
    if leaf.kind == POSE and (pose := to_pose(part)) is not None:
        fields.setdefault("pose_names", []).append(leaf.name)
        fields.setdefault("pose", []).append(pose)
        return True
    return False


def _from_tree(leaf: Leaf, tree: Any) -> Any:
    return exact(leaf.space, tree_from_json(tree), leaf.name)


def _refuse_missing(leaves: list[Leaf]) -> None:
    if leaves:
        names = ", ".join(leaf.name for leaf in leaves)
        raise ProtocolError(f"The feedback does not hold {names}: only a server of bam-train can send that.")


def _listed(images: Any) -> list[Mapping[str, Any]]:
    """Racks send one image or a list of them, by their version."""
    return list(images) if isinstance(images, (list, tuple)) else [images]


def _chosen(images: Any, leaves: list[Leaf], field: str) -> list[Mapping[str, Any]]:
    """One image for each leaf: by its frame_id where that is a leaf's name, else in their order."""
    listed = _listed(images)
    names = [one["header"]["frame_id"] for one in listed]
    if leaves and all(leaf.name in names for leaf in leaves):
        return [listed[names.index(leaf.name)] for leaf in leaves]
    if len(listed) < len(leaves):
        raise ProtocolError(f"{field} must hold {len(leaves)} images, not {len(listed)}.")
    return listed[: len(leaves)]


def _shaped(leaf: Leaf, image: np.ndarray[Any, Any], field: str) -> np.ndarray[Any, Any]:
    shape = leaf.space.shape or ()
    # A grey image has no axis for its one channel in a file.
    if image.shape != shape and (*image.shape, 1) != shape:
        raise ProtocolError(f"{field} must hold an image of shape {shape} for {leaf.name}, not {image.shape}.")
    return image.reshape(shape)
