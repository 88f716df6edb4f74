"""RclpyTransport: an environment in a ROS 2 graph, reached as a ROS 2 node without any bridge."""

import time
import uuid
from collections.abc import Callable
from typing import Any, Literal

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer
from bam_envs.core.location import NO_CREDENTIALS
from bam_envs.core.timing import Deadline
from bam_envs.remote.rosbridge_transport import RosbridgeTransport
from bam_envs.remote.wire.gymapi_messages import base_name, service_name
from bam_envs.remote.wire.ros2_node import RclpyBus
from bam_envs.ros.messages import write_stamp

_GRAPH_POLL_PERIOD = 0.02
"""Time between two checks for the environment in the graph [s]."""


class RclpyTransport(RosbridgeTransport):
    """A `RosbridgeTransport` over a ROS 2 node instead of a bridge.

    Args:
        url: ``ros2://namespace``; the namespace may be left out.
        env_id: The requested environment; "" for the one that is served.
        channel: ``"topics"``, a pair of std_msgs/String, or ``"service"``, for racks; that needs the package bam_msgs.
        domain: ROS domain; None for the environment variable ROS_DOMAIN_ID.
        options: Other options of `RosbridgeTransport`, except ``credentials`` and ``token``.
    """

    def __init__(
        self,
        url: str,
        env_id: str = "",
        *,
        channel: Literal["service", "topics"] = "topics",
        domain: int | None = None,
        **options: Any,
    ) -> None:
        given = {**vars(options.pop("credentials", NO_CREDENTIALS)), "token": options.pop("token", None)}
        for name, value in given.items():
            if value is not None:
                raise InvalidValue(f"{url}: ROS 2 has no {name}; it is for ws:// and wss://.")
        self._domain = domain
        super().__init__(url, env_id, channel=channel, **options)

    def _make_link(self) -> Any:
        return RclpyLink(self.url, self.channel, timeout=self.endpoint.connect_timeout, domain=self._domain)


class RclpyLink(RclpyBus):
    """The node of a client, with the methods of a `RosbridgeLink`; `connect` looks for the environment of `channel`."""

    def __init__(self, url: str, channel: str, *, timeout: float = 3.0, domain: int | None = None) -> None:
        scheme, separator, rest = url.partition("://")
        if scheme != "ros2" or not separator:
            raise InvalidValue(f"An address in a ROS 2 graph is ros2://namespace, not {url!r}.")
        super().__init__(f"bam_client_{uuid.uuid4().hex[:8]}", domain=domain, serves=False)
        stripped = rest.strip("/")
        self.url, self.namespace = url, f"/{stripped}" if stripped else ""
        self.epoch = 0
        """Number of the connection: 1 from `connect` on."""
        self._channel, self._timeout = channel, timeout

    @property
    def is_up(self) -> bool:
        """Whether the node is in the graph."""
        return self.epoch > 0 and self._node is not None

    def connect(self) -> None:
        """Join the graph; raises NoServer if the environment is not in it."""
        if self.is_up:
            return
        by_service = self._channel == "service"
        wanted = service_name(self.namespace) if by_service else f"{base_name(self.namespace)}/request"
        deadline = Deadline(self._timeout)
        self.start()
        while not (self.is_offered(wanted) if by_service else self.is_heard(wanted)):
            if deadline.passed:
                self.close()
                flag = f" --namespace {self.namespace.strip('/')}" if self.namespace else ""
                raise NoServer(
                    self.url,
                    f"no node offers {wanted} after {self._timeout:g} s. Have both ends the same "
                    f"ROS_DOMAIN_ID? Start one: bam-serve --rclpy{flag}",
                )
            time.sleep(_GRAPH_POLL_PERIOD)
        self.epoch = 1

    def wait_up(self, timeout: float) -> None:
        """Raise LinkLost if the link was closed; there is nothing to wait for."""
        if not self.is_up:
            raise LinkLost(f"{self.url}: the node has left the graph.")

    def on_down(self, callback: Callable[[LinkLost], None]) -> None:
        """Do nothing: a ROS graph has no connection that drops."""

    def stamp(self, seconds: float) -> dict[str, int]:
        """A time [s] in the spelling of ROS 2."""
        return write_stamp(seconds)
