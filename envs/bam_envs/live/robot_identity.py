"""Which robot is at an address: its serial number or its name, as the robot tells it, or else as its operator does."""

import queue
from contextlib import closing, suppress
from typing import Any

from bam_envs.core.errors import InvalidValue, LinkLost, RemoteError
from bam_envs.live import bringup
from bam_envs.ros.codec import RobotInfo
from bam_envs.ros.profile_tables import RobotProfile
from bam_envs.rosbridge.bus import Message
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint, is_loopback

FIRST_WITHIN = 1.5
"""Longest wait for the topic on which a robot repeats its name [s]."""


def robot_identity(endpoint: Endpoint, profile: RobotProfile, info: RobotInfo | None) -> str:
    """The serial number or name of the robot at `endpoint`; empty if neither is known.

    A robot without a description that tells it is asked as its profile says, over a connection of its own: with a ROS 2
    bridge, a service that does not answer holds up everything else on its connection.

    Raises:
        InvalidValue: It tells another one than `Endpoint.robot_name`.
        NoServer: There is no usable server.
    """
    told = "" if info is None else info.identity
    if not told and profile.identity and not (info is not None and info.simulated):
        link = RosbridgeLink(endpoint, name="identity")
        with closing(link):
            link.connect()
            told = _asked(link, profile)
    if told and endpoint.robot_name not in ("", told):
        raise InvalidValue(
            f"The robot at {endpoint.url} says that it is {told}, not {endpoint.robot_name}: correct the name, or the "
            "address. Nothing has moved."
        )
    return told or endpoint.robot_name


def is_one_robot(endpoint: Endpoint, identity: str) -> bool:
    """Whether `identity`, or the address if it is empty, belongs to one robot: every tunnel ends on this computer."""
    return bool(identity) or not is_loopback(endpoint.address.host)


def _asked(link: RosbridgeLink, profile: RobotProfile) -> str:
    """What the first source of `profile` that has an answer tells; empty if none has."""
    types = bringup.TopicTypes(link, profile, bringup.TIMEOUT)
    for source in profile.identity:
        message: Any = None
        if source.topic and types.may_be(link.namespace + source.topic, source.type):
            message = _first(link, link.namespace + source.topic, source.type)
        elif source.service:
            with suppress(LinkLost, RemoteError):
                message = bringup.ask(link, link.namespace + source.service, request=source.request)
        if found := source.identity(message):
            return found
    return ""


def _first(link: RosbridgeLink, topic: str, kind: str) -> Message | None:
    """The first message on `topic` within `FIRST_WITHIN`; None if there is none."""
    came: queue.SimpleQueue[Message] = queue.SimpleQueue()
    link.subscribe(topic, kind, lambda message, caller: came.put(message))
    with suppress(queue.Empty):
        return came.get(timeout=FIRST_WITHIN)
    return None
