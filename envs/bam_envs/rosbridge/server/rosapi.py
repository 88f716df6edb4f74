"""The services of rosapi that clients ask for: what time it is, which topics and services there are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bam_envs.rosbridge.bus import Caller, Handler, Message
from bam_envs.rosbridge.server.services import Services
from bam_envs.rosbridge.server.session import read_name
from bam_envs.rosbridge.server.topics import Topics


def rosapi(topics: Topics, services: Services, clock: Callable[[], float]) -> dict[str, tuple[str, Handler]]:
    """Type and handler of each service, by name.

    Args:
        topics: All there are.
        services: All there are.
        clock: Wall clock [s].
    """

    def time_of_day(request: Message, caller: Caller) -> dict[str, Any]:
        now = clock()
        seconds = int(now)
        nanoseconds = int((now - seconds) * 1e9)
        # Both spellings: clients of ROS 1 read the one, clients of ROS 2 the other.
        return {"time": {"sec": seconds, "nanosec": nanoseconds, "secs": seconds, "nsecs": nanoseconds}}

    def all_topics(request: Message, caller: Caller) -> dict[str, Any]:
        return {"topics": [one.name for one in topics], "types": [one.kind for one in topics]}

    def topic_type(request: Message, caller: Caller) -> dict[str, Any]:
        topic = topics.find(read_name(request, "topic"))
        return {"type": topic.kind if topic else ""}

    def all_services(request: Message, caller: Caller) -> dict[str, Any]:
        return {"services": [one.name for one in services]}

    def service_type(request: Message, caller: Caller) -> dict[str, Any]:
        service = services.find(read_name(request, "service"))
        return {"type": service.kind if service else ""}

    return {
        "/rosapi/get_time": ("rosapi/GetTime", time_of_day),
        "/rosapi/topics": ("rosapi/Topics", all_topics),
        "/rosapi/topic_type": ("rosapi/TopicType", topic_type),
        "/rosapi/services": ("rosapi/Services", all_services),
        "/rosapi/service_type": ("rosapi/ServiceType", service_type),
    }
