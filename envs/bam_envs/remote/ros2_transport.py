"""RclpyTransport: an environment in a ROS 2 graph, reached as a ROS 2 node without any bridge."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer
from bam_envs.remote.gymapi.messages import base_name, service_name
from bam_envs.remote.ros2_node import RclpyBus
from bam_envs.remote.rosbridge_transport import RosbridgeTransport
from bam_envs.ros.messages import write_stamp
from bam_envs.rosbridge.bus import Listener, Message

_LOOK = 0.02
"""Time between two looks at who is in the graph [s]."""


class RclpyTransport(RosbridgeTransport):
    """What `RosbridgeTransport` does, by a node of its own.

    Args:
        url: ``ros2://namespace``; the namespace may be left out.
        env_id: The environment that is wanted; "" for the one that is there.
        channel: ``"topics"``, a pair of std_msgs/String, or ``"service"``, for racks; that needs the package bam_msgs.
        domain: ROS domain; None for that of the environment variable ROS_DOMAIN_ID.
        options: What else `RosbridgeTransport` takes, but for certificates and token.

    Raises:
        InvalidValue: The URL or an option is not possible.
    """

    def __init__(
        self, url: str, env_id: str = "", *, channel: str = "topics", domain: int | None = None, **options: Any
    ) -> None:
        for name in ("ca_file", "token"):
            if options.pop(name, None) is not None:
                raise InvalidValue(f"{url}: ROS 2 has no {name}; it is for ws:// and wss://.")
        self._domain = domain
        super().__init__(url, env_id, channel=channel, **options)

    def _make_link(self) -> Any:
        return RclpyLink(self.url, self.channel, timeout=self.connect_timeout, domain=self._domain)


class RclpyLink:
    """A node with the face of a `RosbridgeLink`, for one environment.

    Args:
        url: ``ros2://namespace``.
        channel: Which of the two ways must be there.
        timeout: How long `connect` looks for it [s].
        domain: ROS domain; None for that of the environment.
    """

    def __init__(self, url: str, channel: str, *, timeout: float = 3.0, domain: int | None = None) -> None:
        scheme, separator, rest = url.partition("://")
        if scheme != "ros2" or not separator:
            raise InvalidValue(f"An address in a ROS 2 graph is ros2://namespace, not {url!r}.")
        stripped = rest.strip("/")
        self.url, self.namespace = url, f"/{stripped}" if stripped else ""
        self.epoch = 0
        """Counts the connections: 1 from `connect` on."""
        self._channel, self._timeout, self._closed = channel, timeout, False
        self._bus = RclpyBus(f"bam_client_{uuid.uuid4().hex[:8]}", domain=domain, serves=False)

    @property
    def is_up(self) -> bool:
        """Whether the node is in the graph."""
        return self.epoch > 0 and not self._closed

    def connect(self) -> None:
        """Join the graph, and see that the environment is in it.

        Raises:
            NoServer: It is not.
            InvalidValue: rclpy is not here.
        """
        if self.is_up:
            return
        self._bus.start()
        self.epoch = 1
        deadline = time.monotonic() + self._timeout
        while not self._is_there():
            if time.monotonic() > deadline:
                self._bus.close()
                self.epoch = 0
                raise NoServer(
                    self.url,
                    f"no node offers {self._wanted()} after {self._timeout:g} s. Have both ends the same "
                    f"ROS_DOMAIN_ID? Start one: bam-serve --rclpy{self._flag()}",
                )
            time.sleep(_LOOK)

    def _is_there(self) -> bool:
        return (
            self._bus.is_offered(self._wanted()) if self._channel == "service" else self._bus.is_heard(self._wanted())
        )

    def _wanted(self) -> str:
        return service_name(self.namespace) if self._channel == "service" else f"{base_name(self.namespace)}/request"

    def _flag(self) -> str:
        return f" --namespace {self.namespace.strip('/')}" if self.namespace else ""

    def wait_up(self, timeout: float) -> None:
        """There is nothing to wait for: a graph is there, or the link was closed.

        Raises:
            LinkLost: It was closed.
        """
        if not self.is_up:
            raise LinkLost(f"{self.url}: the node has left the graph.")

    def stamp(self, seconds: float) -> dict[str, int]:
        """A time as ROS 2 spells it."""
        return write_stamp(seconds)

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Say that `topic` will be published."""
        self._bus.advertise(topic, kind, latch=latch)

    def publish(self, topic: str, message: Message) -> None:
        """Send `message` now, or not at all."""
        self._bus.publish(topic, message)

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Send several messages, each with its topic, in this order."""
        self._bus.publish_all(messages)

    def subscribe(self, topic: str, kind: str, listener: Listener) -> Callable[[], None]:
        """Call `listener` for each message, until what is returned is called."""
        return self._bus.subscribe(topic, kind, listener)

    def call(self, service: str, kind: str, request: Message, timeout: float) -> dict[str, Any]:
        """The response of `service`; errors as of `RclpyBus.call`."""
        return self._bus.call(service, kind, request, timeout)

    def close(self) -> None:
        """Leave the graph. As often as one likes."""
        self._closed = True
        self._bus.close()
