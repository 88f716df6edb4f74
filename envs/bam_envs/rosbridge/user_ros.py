"""A link over a `roslibpy.Ros` of other code, which connects it, reconnects it and closes it."""

import asyncio
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import TimeoutError as NoAnswer
from contextlib import suppress
from functools import partial
from typing import Any

from roslibpy import Message as Request
from roslibpy import Ros
from roslibpy.comm import select_factory

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer
from bam_envs.core.wording import brief
from bam_envs.rosbridge.bus import Handler, Message, tell
from bam_envs.rosbridge.client_connection import TWISTED, send_now
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.ros_bus import SEND_WITHIN, Reply, RosBus

_MAX_MESSAGE = 64 * 1024 * 1024
_ANSWER_WITHIN = 3.0


def endpoint_of(ros: Any, robot_name: str = "") -> Endpoint:
    """The address of the server of a `Ros`, and its token; `InvalidValue` if it is not of the asyncio transport."""
    if not isinstance(ros, Ros):
        raise InvalidValue(f"A live robot is an address, ws://host:port, or a roslibpy.Ros; found {brief(ros)}.")
    if not isinstance(ros.factory, select_factory("asyncio")):
        raise InvalidValue(TWISTED)
    scheme, _, token = str((ros.factory.headers or {}).get("Authorization", "")).partition(" ")
    return Endpoint(ros.factory.url, token=token if scheme == "Bearer" else None, robot_name=robot_name)


class UserRosLink(RosBus):
    """A link over `ros`, which has to be connected. Nothing is sent while `ros` is not, nor later.

    `ros` has no heartbeat: a network that is dead without a word is found by the age of the states. Its listeners
    share one thread with all others of its process that use roslibpy.
    """

    def __init__(self, ros: Ros) -> None:
        address = endpoint_of(ros).address
        super().__init__(address.url, address.namespace, "roslibpy")
        self._ros, self._thread.listens = ros, True
        self._has_asked = False  # since the last message was published
        self._hooks: dict[str, Callable[[Any], None]] = {  # by event of roslibpy's; a topic and a service is one, too
            "ready": partial(tell, self._begin),
            "close": self._note_close,
        }

    def connect(self) -> None:
        """Use `ros` from now on; `NoServer` if it is not connected."""
        self._require_waiting_allowed("connect")
        if self._thread.loop is not None:
            return
        if not self._ros.is_connected:
            raise NoServer(self.url, "the roslibpy.Ros is not connected: call its run() before.")
        self._thread.loop = self._ros.factory.manager.loop
        self._thread.do(self._attach)
        learning = asyncio.run_coroutine_threadsafe(self._learn_clock(self._require_up()), self._thread.loop)
        try:
            learning.result(_ANSWER_WITHIN)
        except NoAnswer as error:
            learning.cancel()
            raise LinkLost(f"{self.url}: /rosapi/get_time did not answer in {_ANSWER_WITHIN:g} s.") from error

    def close(self) -> None:
        """Stop using `ros`, which stays connected. Idempotent; does nothing in a forked child."""
        if self._pid == os.getpid() and not self._closed:
            self._closed, self._why = True, "it was closed; make a new one"
            with suppress(LinkLost):
                self._thread.do(self._leave)

    @property
    def is_up(self) -> bool:
        """Whether a message can be sent now."""
        return (connection := self._up) is not None and connection.state == connection.STATE_OPEN

    # ---- used by any thread

    def _declare(self, request: dict[str, Any], *kind_and_listener: Any) -> None:
        request.pop("compression", None)  # a binary frame would end the connection: roslibpy reads JSON only
        if kind_and_listener[1:]:
            self._hook(request["topic"], partial(self._take_published, request["topic"]))
        super()._declare(request, *kind_and_listener)

    def ask_soon(self, request: dict[str, Any], took: Callable[[Reply], None]) -> None:
        """Send a goal or a call of a service without waiting; see the base class."""
        super().ask_soon(request, took)
        self._has_asked = True

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Send several messages now or not at all, behind what was asked before; see the base class."""
        if self._has_asked:  # roslibpy writes a request in the next round of its loop
            self._has_asked = False
            self._thread.do(lambda: None, SEND_WITHIN)
        super().publish_all(messages)

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service` of type `kind` through the server."""
        self._hook(service, self._serve)
        super().serve(service, kind, handler)

    def _hook(self, event: str, hook: Callable[[Any], None]) -> None:
        # Not in the lock of the declarations: roslibpy holds one of its own while a listener runs.
        hook = self._hooks.setdefault(event, hook)
        if self._thread.loop is not None:
            self._ros.on(event, hook)

    def _ask(self, connection: Any, request: Message, frame: str) -> None:
        is_goal = request["op"] == "send_action_goal"

        def back(result: bool, values: Any) -> None:
            reply = {"result": result, "values": values["values"] if is_goal else values}
            reply |= {"status": values["status"].value} if is_goal else {}
            plain = {name: dict(one) if isinstance(one, Mapping) else one for name, one in reply.items()}
            self._answered(request["id"], plain)

        self._send(connection)
        done, failed = partial(back, True), partial(back, False)
        if is_goal:
            connection.send_ros_action_goal(Request(request), done, lambda news: None, failed)
        else:
            connection.send_ros_service_request(Request(request), done, failed)

    # ---- the network thread

    def _attach(self) -> None:
        for event, hook in list(self._hooks.items()):
            self._ros.on(event, hook)
        self._why = "the roslibpy.Ros is not connected"
        if self._ros.is_connected:
            self._ros.factory.on_ready(self._hooks["ready"])

    def _send(self, connection: Any, *frames: str) -> None:
        send_now(connection, self.url, "", _MAX_MESSAGE, *frames)

    def _serve(self, request: Any) -> None:
        if self._up is not None:
            self._answer(self._up, dict(request))

    def _note_close(self, connection: Any) -> None:
        self._note_down(LinkLost(f"{self.url}: the link dropped: the connection of the roslibpy.Ros was closed."))

    def _leave(self) -> None:
        for event, hook in self._hooks.items():
            with suppress(KeyError):  # the user's code, or `roslibpy.Topic.unsubscribe`, may have removed it
                self._ros.off(event, hook)
        connection, self._up = self._up, None
        if connection is not None:
            self._send(connection, *self._farewell("advertise", "advertise_service", "subscribe"))
