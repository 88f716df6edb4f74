"""The service bam_msgs/GymAPI of an environment, as a BAM rack offers it; and the same over a pair of topics."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any

from bam_envs.core.errors import BamEnvsError, RemoteError
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.wire.gymapi_codec import EnvCodec
from bam_envs.remote.wire.gymapi_messages import (
    KIND,
    GymRequest,
    RequestType,
    base_name,
    read_request,
    service_name,
    write_failure,
    write_info,
    write_response,
)
from bam_envs.remote.wire.gymapi_versions import (
    JUNE_17,
    JUNE_22,
    GymApiVersion,
    version_named,
    version_of_bus,
    version_of_request,
)
from bam_envs.remote.wire.transport import spec_to_json
from bam_envs.ros.freshness import FreshnessCheck
from bam_envs.ros.messages import write_stamp
from bam_envs.rosbridge.bus import Bus, Caller, Message
from bam_envs.rosbridge.sessions import Sessions
from bam_envs.rosbridge.string_rpc import StringRpcService

_log = logging.getLogger(__name__)
_LONGEST_NAME = 100
"""Characters of a client's name that are kept and shown to others."""


class GymApiService:
    """Answers GymAPI requests for an `EnvServer`: those of the racks' own clients, and of `RosbridgeTransport`.

    A request with a tag is executed once and only in time. A request without one, of a rack's own client, is always
    executed, and a step after the end of an episode begins the next one. The name of a client is ``client_id`` with
    its session or its connection.

    Args:
        env: The served environment.
        bus: The bus for the service and the topics.
        namespace: Prefix of every name.
        image_format: ``"png"``, which keeps every bit, or ``"jpeg"``.
        version: Version of the answers, such as ``"2025-06-17"``, if the request does not show it; None for that of the
            compiled types on the other side of `bus`, or the newest.
        clock: Wall clock [s], for stamps.
    """

    def __init__(
        self,
        env: EnvServer,
        bus: Bus,
        namespace: str = "",
        *,
        image_format: str = "png",
        version: str | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.env, self.bus, self.namespace = env, bus, namespace
        self._codec = EnvCodec(env.spec(), image_format=image_format)
        self._clock = clock
        self._version = None if version is None else version_named(version)
        self._freshness = FreshnessCheck()
        self._asked: Counter[str] = Counter()  # by the name of a caller of an unknown version
        self._leaving = ThreadPoolExecutor(1, "bam-gymapi-leaving")
        self._sessions = Sessions()
        # Every client can read published requests, so the tag in one proves nothing.
        published = partial(self.handle, published=True)
        self._topics = StringRpcService(bus, base_name(namespace), published, self._sessions)

    def start(self) -> GymApiService:
        """Offer the service and the topics. Returns itself."""
        if self._version is None:
            self._version = version_of_bus(self.bus)
        self.bus.on_leave(self._on_leave)
        self.bus.serve(service_name(self.namespace), KIND, self.handle)
        self.bus.serve(f"{base_name(self.namespace)}/session", "std_srvs/Trigger", self._sessions.open)
        self._topics.start()
        return self

    def close(self) -> None:
        """Stop answering on the topics. The service ends with its bus."""
        self._topics.close()
        self._leaving.shutdown()

    def handle(self, message: Message, caller: Caller, *, published: bool = False) -> dict[str, Any]:
        """The response to a request; never raises: an error becomes the text of a failure."""
        begun, known = time.monotonic(), version_of_request(message) or self._version
        version = known or JUNE_22
        try:
            request = read_request(message)
            if caller.name and request.tag is None and known is None and request.type is not RequestType.NONE:
                self._asked[caller.name] += 1
            if request.tag is not None and not published:  # `StringRpcService` has checked the tag of a published one
                self._freshness.require(request.tag)
            deadline = None if request.tag is None else begun + request.tag.deadline - request.tag.sent
            feedback = self._perform(request, version, caller, deadline, published)
            return write_response(feedback, time.monotonic() - begun, self._stamp(), version)
        except BamEnvsError as error:
            failure = error
        except Exception as error:  # a service always answers
            _log.exception("%s failed", service_name(self.namespace))
            failure = RemoteError(f"{type(error).__name__}: {error}")
        return write_failure(failure, time.monotonic() - begun, self._stamp(), version)

    def _perform(
        self, request: GymRequest, version: GymApiVersion, caller: Caller, deadline: float | None, published: bool
    ) -> list[dict[str, Any]]:
        self.env.require_name(request.env_name)
        name = request.client_id[:_LONGEST_NAME] or "somebody"
        # The session in the tag of a service call identifies a client on any of its connections. It is a secret, so it
        # is never shown to others.
        mark = (caller.session or caller.name) if published or request.tag is None else request.tag.session
        client = f"{name}#{mark}" if mark else name
        shown = f"{name} ({caller.address})" if caller.address else name
        if request.type is RequestType.STEP:
            action = self._codec.read_actions(request.actions)
            if request.tag is None and self.env.has_ended(client):  # clients of racks do not call reset themselves
                begun = self.env.reset(client, caller=caller, shown=shown)
                return self._codec.write_result(begun, self._stamp(), version, executed=False)
            stepped = self.env.step(client, action, deadline=deadline)
            return self._codec.write_result(stepped, self._stamp(), version)
        if request.type is RequestType.RESET:
            begun = self.env.reset(
                client, request.seed, request.options, take=request.take, deadline=deadline, caller=caller, shown=shown
            )
            return self._codec.write_result(begun, self._stamp(), version)
        if request.type is RequestType.CLOSE:
            self.env.leave(client)
            return []
        return [{**version.no_images, "info": write_info({}, {"spec": spec_to_json(self.env.spec())})}]

    def _stamp(self) -> dict[str, int]:
        stamp: Callable[[float], dict[str, int]] = getattr(self.bus, "stamp", write_stamp)
        return stamp(self._clock())

    def _on_leave(self, caller: Caller) -> None:
        self._sessions.left(caller)
        if self._asked.pop(caller.name, 0) == 1:
            _log.warning(
                "%s left after the first answer. bam_gym's client of before %s, which cannot read it, needs "
                "--gymapi-version %s here.",
                caller.shown,
                JUNE_22.name,
                JUNE_17.name,
            )
        # In another thread, because it waits for a running step, and this is the network thread.
        with suppress(RuntimeError):  # closed meanwhile
            self._leaving.submit(self.env.leave, connection=caller.name)
