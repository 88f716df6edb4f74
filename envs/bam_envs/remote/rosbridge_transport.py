"""RosbridgeTransport: an environment behind the GymAPI service of `bam-serve` or of a BAM rack, through rosbridge."""

import os
import socket
import threading
import time
from contextlib import suppress
from typing import Any, Literal

import gymnasium as gym
from gymnasium import Space

from bam_envs.core.errors import LinkLost, NoServer, ProtocolError, RemoteError, UnknownName
from bam_envs.core.location import NO_CREDENTIALS, Credentials, serving
from bam_envs.core.registry import resolve_id
from bam_envs.core.validation import PositiveInt, check
from bam_envs.remote.wire.gymapi_codec import DEFAULT, EnvCodec
from bam_envs.remote.wire.gymapi_messages import (
    KIND,
    GymRequest,
    GymResponse,
    RequestType,
    base_name,
    read_response,
    refuse_foreign,
    service_name,
    whole_request,
    write_request,
)
from bam_envs.remote.wire.gymapi_versions import version_named
from bam_envs.remote.wire.transport import EnvSpecMessage, Info, Seed, plain_seed, spec_from_json, spec_to_json
from bam_envs.ros.freshness import Tagger
from bam_envs.rosbridge.bus import namespaces_with
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.sessions import is_over, read_session
from bam_envs.rosbridge.string_rpc import StringRpc

_QUESTIONS = 3
"""Most requests for the description: a ROS 2 bridge creates a client for each call, and loses an answer that comes
before the two ends have discovered each other."""
_CLOSE_TIMEOUT = 1.0  # [s]; a server that is gone must not delay `close`


class RosbridgeTransport:
    """Carries an environment through rosbridge. One request at a time; `close` may be called from any thread.

    Args:
        url: ``ws://host:port/namespace`` or ``wss://…``; the namespace may be left out.
        env_id: The requested environment, by the server's name; "" for the one that is served.
        channel: ``"service"``, which every rack has, or ``"topics"``, a pair of topics, which `bam-serve` has and
            which is several times faster through a real rosbridge.
        timeout: Longest time for a request [s]; a rack's pick takes seconds.
        connect_timeout: Longest time to connect [s].
        name: The name of this client, shown to others; computer and process by default.
        credentials: Files of certificates and of the server's token.
        token: The server's shared secret, if it has one and it is not in a file.
        take: Take command from the client that has it.
        observation_space: Of a single environment. This and the following are for racks that do not describe their
            environment; they are sent only the fields that racks know.
        action_space: Of a single environment.
        num_envs: Number of environments (arms), which begin their episodes together.
        period: Time between two actions [s]; None if it is not known.
        action_type: Of the actions: 1 default, 2 pick and lift, 3 pick and place, 4 open, 5 fold.
        gymapi_version: Version of the messages; None to detect it from the first answer.
        autoreset: Whether the rack begins the next episode in the step that ends one; None: True for versions from
            June on.

    Raises:
        InvalidValue: The URL or an option is not valid.
    """

    def __init__(
        self,
        url: str,
        env_id: str = "",
        *,
        channel: Literal["service", "topics"] = "service",
        timeout: float = 30.0,
        connect_timeout: float = 3.0,
        name: str | None = None,
        credentials: Credentials = NO_CREDENTIALS,
        token: str | None = None,
        take: bool = False,
        observation_space: Space[Any] | None = None,
        action_space: Space[Any] | None = None,
        num_envs: int = 1,
        period: float | None = None,
        action_type: int = DEFAULT,
        gymapi_version: str | None = None,
        autoreset: bool | None = None,
    ) -> None:
        self.endpoint = Endpoint(url, credentials, token, connect_timeout, timeout, stand_in=serving(env_id or "ENV"))
        self.channel = check(channel, Literal["service", "topics"], "channel")
        self.url, self.env_id, self.timeout, self.take = url, env_id, timeout, take
        self._spaces, self._num_envs = (observation_space, action_space), check(num_envs, PositiveInt, "num_envs")
        self._period, self._action_type, self._autoreset = period, action_type, autoreset
        self._version = None if gymapi_version is None else version_named(gymapi_version)
        self._name, self._lock, self._closed = name, threading.Lock(), False
        self._described_epoch: int | None = None
        self._known_epoch: int | None = None  # of the connection since which the environment's state is known
        self._last: list[Any] = []  # the last observation of each environment
        self._begin_process()

    def connect(self) -> EnvSpecMessage:
        """Open the link and read the description. Raises NoServer, also for a rack whose spaces are not known."""
        with self._lock:
            return self._connect().spec

    def reset(self, seed: Seed = None, options: Info | None = None) -> tuple[Any, Any]:
        """Begin an episode; waits for a link that dropped, at most the time to connect."""
        with self._lock:
            codec = self._connect()
            self._known_epoch = None
            plain = plain_seed(seed)
            if codec.foreign:
                refuse_foreign(plain, options)
            epoch = self._link.epoch
            response = self._ask(RequestType.RESET, seed=plain, options=options, take=self.take)
            result = codec.read_result(response)
            self._known_epoch, self._last = epoch, [one[0] for one in codec.spec.split(result)]
            return result[0], result[-1]

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info). Sent once, or not at all.

        Raises:
            LinkLost: Nothing was sent: the link is down, or it dropped or timed out since the last reset.
        """
        with self._lock:
            codec = self._codec
            if codec is None or self._closed or self._known_epoch != self._link.epoch or os.getpid() != self._pid:
                lost = "the link was lost, or is not open, so what the environment did since is unknown"
                reason = "this transport is closed" if self._closed else lost
                raise LinkLost(f"{self.url}: {reason}, and nothing was sent. Call reset() first.")
            result = codec.read_result(self._ask(RequestType.STEP, actions=codec.write_actions(action)))
            june = self._version is not None and self._version.june
            if codec.foreign and (june if self._autoreset is None else self._autoreset):
                # The rack has begun the next episode, and never sends the last observation of the old one: that of the
                # step before replaces it.
                each, before = codec.spec.split(result), self._last
                self._last = [one[0] for one in each]
                for i, (_, reward, terminated, truncated, info) in enumerate(each):
                    if terminated or truncated:
                        info = {**info, "stale_observation": True}
                        each[i] = (before[i], reward, terminated, truncated, info)
                result = codec.spec.joined(each)
            return result

    def close(self) -> None:
        """Release the environment and drop the link; a request under way ends with `LinkLost`."""
        if os.getpid() != self._pid:
            return  # the link is the parent's
        self._closed = True
        if self._lock.acquire(blocking=False):
            try:
                if self._codec is not None and self._link.is_up:
                    # A `bam-serve` notices by itself that the link is gone.
                    with suppress(LinkLost, ProtocolError, RemoteError):
                        self._ask(RequestType.CLOSE, timeout=min(self.timeout, _CLOSE_TIMEOUT))
            finally:
                self._lock.release()
        self._rpc.close()
        self._link.close()

    def _make_link(self) -> Any:
        return RosbridgeLink(self.endpoint, name="gymapi")

    def _begin_process(self) -> None:
        self._pid, self._tagger, self._link = os.getpid(), Tagger(), self._make_link()
        self._codec: EnvCodec | None = None
        self._base = base_name(self._link.namespace)
        self._rpc = StringRpc(self._link, self._base, self._tagger)

    def _connect(self) -> EnvCodec:
        if self._closed:
            raise LinkLost(f"{self.url}: this transport is closed; make a new one.")
        if os.getpid() != self._pid:  # after a fork: the parent's link must stay as it is
            self._begin_process()
        before = self._codec
        if before is None:
            self._link.connect()
        else:
            self._link.wait_up(self.endpoint.connect_timeout)
        if before is not None and self._described_epoch == self._link.epoch:
            return before
        epoch = self._link.epoch
        codec = self._described() if None in self._spaces else self._rack()
        if before is not None and spec_to_json(before.spec) != spec_to_json(codec.spec):
            raise ProtocolError(f"{self.url}: it serves another environment than before: {codec.spec.env_id}.")
        self._codec, self._described_epoch, self._known_epoch = codec, epoch, epoch
        if self.channel == "topics" and not codec.foreign and not self._tagger.signs:
            # Requests on topics are signed, because every client can read them.
            service = f"{self._base}/session"
            with suppress(RemoteError):  # an older server
                answer = self._link.call(service, "std_srvs/Trigger", {}, self.endpoint.connect_timeout)
                self._sign_with(read_session(answer, service))
        return codec

    def _sign_with(self, tagger: Tagger) -> None:
        self._rpc.close()
        self._tagger = tagger
        self._rpc = StringRpc(self._link, self._base, tagger)

    def _rack(self) -> EnvCodec:
        """The codec for a rack without a description; missing spaces are those of `env_id` in the local registry."""
        observation_space, action_space = self._spaces
        if observation_space is None or action_space is None:
            env: gym.Env[Any, Any] = gym.make(resolve_id(self.env_id))
            observation_space, action_space = env.observation_space, env.action_space
            env.close()  # type: ignore[no-untyped-call]
        spec = EnvSpecMessage(
            self.env_id or "rack",
            observation_space,
            action_space,
            self._num_envs,
            vector=self._num_envs > 1,
            autoreset=False,
            period=self._period,
        )
        return EnvCodec(spec, foreign=True, action_type=self._action_type)

    def _described(self) -> EnvCodec:
        """Request the server's description, which moves nothing; an answer without one is that of a rack."""
        limit, questions = max(self.endpoint.connect_timeout, 1.0) / _QUESTIONS, _QUESTIONS
        while True:
            try:
                response = self._exchange(RequestType.NONE, None, timeout=limit)
                break
            except RemoteError as error:
                # No such service, or a rack that does not know the request; else the session of this client is over.
                if not (self._tagger.signs and is_over(error)):
                    return self._foreign(str(error))
                self._sign_with(Tagger())
            except LinkLost as error:
                questions -= 1
                if not questions:
                    raise NoServer(self.url, f"rosbridge is there, and {self._where()} is silent: {error}") from error
        if response.error is not None and any(response.exact):  # of a `bam-serve`
            raise NoServer(self.url, str(response.error)) from response.error
        spec = response.exact[0].get("spec") if response.exact else None
        if spec is None:
            return self._foreign(str(response.error or "it does not describe its environment"))
        return EnvCodec(spec_from_json(spec))

    def _foreign(self, reason: str) -> EnvCodec:
        namespace = f" --namespace {self._link.namespace.strip('/')}" if self._link.namespace else ""
        remedy = f"Start one: bam-serve --env {self.env_id or 'bam/pick'}{namespace}"
        if "does not exist" in reason:  # the text of all bridges but one
            elsewhere = namespaces_with(self._link, "services", service_name(""))
            from bam_envs.live.bringup import what_answers

            other = what_answers(self._link, "environment")
            raise NoServer(self.url, f"{other or f'{reason}.'}{elsewhere} {remedy}")
        try:
            return self._rack()
        except UnknownName as error:
            raise NoServer(
                self.url,
                f"{self._where()}: {reason.rstrip('.')}; give observation_space and action_space, or an env_id that is "
                f"registered here. {remedy}",
            ) from error

    def _where(self) -> str:
        return service_name(self._link.namespace) if self.channel == "service" else f"{self._base}/request"

    def _ask(self, kind: RequestType, **fields: Any) -> GymResponse:
        """Send a request and return its response; after any error but a refusal, a reset is needed."""
        epoch = self._known_epoch if kind is RequestType.STEP else self._link.epoch
        try:
            response = self._exchange(kind, epoch, **fields)
        except RemoteError:
            raise
        except BaseException:  # even Ctrl-C: the request may be under way
            self._known_epoch = None
            raise
        if response.error is not None:
            raise response.error
        return response

    def _exchange(
        self, kind: RequestType, epoch: int | None, *, timeout: float | None = None, **fields: Any
    ) -> GymResponse:
        limit = self.timeout if timeout is None else timeout
        foreign = self._codec is not None and self._codec.foreign
        tag = None if foreign or epoch is None else self._tagger.next(epoch, limit)
        client = self._name or f"{socket.gethostname()}:{self._pid}"
        request = GymRequest(kind, client_id=client, env_name=self.env_id, tag=tag, **fields)
        message = write_request(request, self._link.stamp(time.time()))
        if foreign:
            message = whole_request(message, self._version)
        if self.channel == "topics":
            response = read_response(self._rpc.call(message, limit))
        else:
            response = read_response(self._link.call(service_name(self._link.namespace), KIND, message, limit))
        self._version = self._version or response.version
        return response
