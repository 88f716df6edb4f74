"""The versions of bam_msgs/GymAPI in the field, by the day of their release, and how to tell them apart.

Where the types are compiled (ROS 2), a field that the version lacks is refused, not ignored.
"""

import queue
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, ProtocolError, RemoteError
from bam_envs.rosbridge.bus import Bus
from bam_envs.rosbridge.client import RosbridgeLink

_FEEDBACK = "bam_msgs/GymFeedback"
_DETAILS = "/rosapi/message_details"
_ROSAPI_TIMEOUT = 1.0
"""Longest wait for an answer of rosapi [s]."""
_ECHO = "/bam/gymapi_fields"
"""Topic on which an empty message comes back with the fields that a server without rosapi was compiled with."""
_TRIES, _AGAIN = 10, 0.2
"""Number of such messages, and time between two [s]: a ROS graph takes a while to connect both ends of a topic."""


@dataclass(frozen=True)
class GymApiVersion:
    """One version of the messages."""

    name: str
    """The day of its release."""
    busy: str
    """Field of the request header that interrupts a busy rack."""
    lists: bool
    """Whether an entry has lists of images instead of one image of each kind."""

    @property
    def june(self) -> bool:
        """Whether it is from June on: with a stamp in the response header, and racks that reset themselves."""
        return self.busy == "force_busy"

    @property
    def no_images(self) -> dict[str, Any]:
        """The image fields of an entry without images; empty if their defaults suffice."""
        return {"color_img": [], "depth_img": [], "camera_info": []} if self.lists else {}


MAY_24 = GymApiVersion("2025-05-24", "force_if_busy", lists=False)
JUNE_17 = GymApiVersion("2025-06-17", "force_busy", lists=False)
JUNE_22 = GymApiVersion("2025-06-22", "force_busy", lists=True)
VERSIONS = {one.name: one for one in (MAY_24, JUNE_17, JUNE_22)}


def version_named(name: str) -> GymApiVersion:
    """The version of that day. Raises InvalidValue if there is none."""
    if name not in VERSIONS:
        raise InvalidValue(f"A version of GymAPI must be one of {', '.join(VERSIONS)}, not {name!r}.")
    return VERSIONS[name]


def version_of_request(message: object) -> GymApiVersion | None:
    """The version of a request; None if it could be of several."""
    return MAY_24 if MAY_24.busy in _header(message) else None


def version_of_response(message: object) -> GymApiVersion | None:
    """The version of a response, which suffices for requests to its server; None if it cannot be told."""
    header = _header(message)
    if "process_duration" in header:
        return JUNE_22
    return MAY_24 if "duration" in header else None


def _header(message: object) -> Mapping[str, Any]:
    header = message.get("header") if isinstance(message, Mapping) else None
    return header if isinstance(header, Mapping) else {}


def version_of_bus(bus: Bus) -> GymApiVersion | None:
    """The version of the types that `bus` was compiled with; None if it has none or does not report it."""
    fields: Mapping[str, bool] = {}  # name of each field of GymFeedback -> whether it is a list
    if hasattr(bus, "fields"):  # a ROS 2 node
        fields = bus.fields(_FEEDBACK)
    elif hasattr(bus, "call"):  # a link to a rosbridge server
        with suppress(RemoteError, LinkLost, ProtocolError):  # no rosapi there
            fields = _read_fields(bus.call(_DETAILS, "", {"type": _FEEDBACK}, _ROSAPI_TIMEOUT))
    if isinstance(bus, RosbridgeLink) and not fields:
        with suppress(BamEnvsError):
            fields = _echoed_fields(bus)
    if fields.get("color_img"):
        return JUNE_22
    if "duplicate_obs" in fields:
        return JUNE_17
    return MAY_24 if "duplicate_obs_ns" in fields else None


def _echoed_fields(link: RosbridgeLink) -> dict[str, bool]:
    """Whether each field is a list, by a message that the server of `link` completes; empty if none comes back."""
    came: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
    own = RosbridgeLink(link.endpoint, name="gymapi")  # when it closes, the server forgets the topic
    with closing(own):
        own.connect()
        own.subscribe(_ECHO, _FEEDBACK, lambda message, caller: came.put(message))
        own.advertise(_ECHO, _FEEDBACK)
        for _ in range(_TRIES):
            own.publish(_ECHO, {})
            with suppress(queue.Empty):
                return {name: isinstance(value, list) for name, value in came.get(timeout=_AGAIN).items()}
    return {}


def _read_fields(details: Mapping[str, Any]) -> dict[str, bool]:
    """Whether each field of the first type in an answer of rosapi is a list: its length is not -1."""
    definitions = details.get("typedefs")
    first = definitions[0] if isinstance(definitions, list) and definitions else None
    names, lengths = (first.get("fieldnames"), first.get("fieldarraylen")) if isinstance(first, Mapping) else (0, 0)
    if not isinstance(names, list) or not isinstance(lengths, list):
        return {}
    return {name: length != -1 for name, length in zip(names, lengths, strict=False) if isinstance(name, str)}
