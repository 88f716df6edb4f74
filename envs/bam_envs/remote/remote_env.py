"""RemoteEnv: an environment that runs elsewhere, as a `gymnasium.Env`; and functions that make one from a URL."""

import inspect
from collections.abc import Mapping, Sequence
from pkgutil import resolve_name
from typing import Any

import gymnasium as gym
from gymnasium import Space

from bam_envs.core.close_at_exit import close_at_exit
from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.core.location import NO_CREDENTIALS, Credentials, Remote
from bam_envs.core.wording import closest
from bam_envs.remote.remote_vector_env import Described, RemoteVectorEnv
from bam_envs.remote.wire.transport import EnvSpecMessage, Info, Transport

__all__ = ["RemoteEnv", "RemoteVectorEnv", "make_remote_env", "make_remote_vector_env", "open_transport"]

Where = str | Transport
"""A URL of `open_transport`, or a transport."""
_CLASSES = {
    "tcp": "bam_envs.remote.tcp_transport:TcpTransport",
    "ws": "bam_envs.remote.rosbridge_transport:RosbridgeTransport",
    "wss": "bam_envs.remote.rosbridge_transport:RosbridgeTransport",
    "ros2": "bam_envs.remote.ros2_transport:RclpyTransport",
}
"""Transport class by scheme of the URL; imported on use."""


class RemoteEnv(Described, gym.Env[Any, Any]):
    """One environment behind a transport, which connects on first use.

    A lost link does not end an episode: `LinkLost` and the other faults of the transport are raised, and the next
    `reset` reconnects. It is closed when Python ends.
    """

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.metadata = {"render_modes": []}
        self._spec: EnvSpecMessage | None = None
        self._running = False
        self._steps, self._warned = 0, False
        close_at_exit(self)

    def connect(self) -> EnvSpecMessage:
        """Return the description of the remote environment.

        Raises:
            NoServer: No server, or none with this environment.
            InvalidValue: The server has several environments; use `RemoteVectorEnv`.
        """
        if self._spec is None:
            spec = self.transport.connect()
            if spec.vector:
                raise InvalidValue(
                    f"{spec.env_id} has {spec.num_envs} environments there, and one is wanted. Make it with "
                    f"num_envs={spec.num_envs}, or serve one (bam-serve without --num-envs)."
                )
            self._spec = spec
        return self._spec

    @property
    def _description(self) -> EnvSpecMessage:
        return self.connect()

    @property
    def observation_space(self) -> Space[Any]:  # type: ignore[override]
        """The observation space of the remote environment."""
        return self._description.observation_space

    @property
    def action_space(self) -> Space[Any]:  # type: ignore[override]
        """The action space of the remote environment."""
        return self._description.action_space

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Begin an episode; seed and options are sent to the server."""
        super().reset(seed=seed)
        self.connect()
        self._warn_if_truncated()
        self._running, self._steps = False, 0
        observation, info = self.transport.reset(seed, options)
        self._running = True
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """One step of the remote environment."""
        if not self._running:
            raise ResetNeeded("No episode is running: it ended, or never began. Call reset() first.")
        observation, reward, terminated, truncated, info = self.transport.step(action)
        self._running, self._steps = not (terminated or truncated), self._steps + 1
        return observation, reward, terminated, truncated, info

    def _warn_if_truncated(self) -> None:
        """Warn once if the local time limit, which `gymnasium.make` adds, ended an episode before the server's."""
        entry = gym.registry.get(self.spec.id) if self.spec is not None else None
        if entry is None or self._warned or not self._running or self._steps != entry.max_episode_steps:
            return
        if self._steps < (self.max_episode_steps or 0):
            self._warned = True
            gym.logger.warn(
                f"Episodes of {entry.id} are cut after {self._steps} steps here, and last {self.max_episode_steps} "
                f"there; for those: gymnasium.make(..., max_episode_steps=-1)."
            )

    def render(self) -> None:
        """Do nothing: rendered frames are not sent, unlike observations that are images."""

    def close(self) -> None:
        """Release the remote environment and drop the link."""
        self._running = False
        self.transport.close()


def make_remote_env(env_id: str, at: Remote | Where, **options: Any) -> RemoteEnv:
    """The environment `env_id` that runs elsewhere; connects on first use.

    Args:
        env_id: Its id; a server with another environment refuses. "" for any environment.
        at: Where it runs; or a transport, or a URL for `open_transport`, which takes the `options` and raises
            InvalidValue.
        options: Options such as ``timeout`` and ``credentials``.
    """
    opened = _opened(env_id, at, options)
    if len(opened) != 1:
        raise InvalidValue(f"transport= of one environment is one address, and these are {len(opened)}; give one.")
    return RemoteEnv(opened[0])


def make_remote_vector_env(
    env_id: str, at: Remote | Where | Sequence[Where], num_envs: int | None = None, **options: Any
) -> RemoteVectorEnv:
    """The environments `env_id` that run elsewhere, stepped together; see `make_remote_env`.

    Args:
        env_id: Their id.
        at: As for `make_remote_env`, or several, which are stepped at the same time; each may have many environments.
        num_envs: Expected total number of environments; None for any.
        options: As for `make_remote_env`.
    """
    return RemoteVectorEnv(_opened(env_id, at, options), num_envs)


def _opened(env_id: str, at: Remote | Where | Sequence[Where], options: Mapping[str, Any]) -> list[Transport]:
    if isinstance(at, Remote):
        options = {**options, "credentials": at.credentials, "timeout": at.timeout}
        at = at.urls
    several = [at] if isinstance(at, (str, Transport)) else at
    return [open_transport(one, env_id=env_id, **options) if isinstance(one, str) else one for one in several]


def open_transport(
    url: str,
    *,
    env_id: str = "",
    credentials: Credentials = NO_CREDENTIALS,
    timeout: float | None = None,
    **options: Any,
) -> Transport:
    """The transport of `url`, not connected yet.

    =======================  ====================================================
    url                      server
    =======================  ====================================================
    tcp://host:port          ``bam-serve --tcp PORT``
    ws://host:port/space     a rosbridge server, such as ``bam-serve --port PORT``
    wss://host:port/space    the same with TLS
    ros2://space             a ROS 2 graph, where rclpy is installed
    =======================  ====================================================

    Args:
        url: `space` is a ROS namespace and may be left out.
        env_id: The requested environment; "" for the one that is served.
        credentials: Files of certificates and of the server's token.
        timeout: Longest wait for an answer [s]; None for the default of the transport's class.
        options: Other keywords of that class, such as ``connect_timeout``.

    Raises:
        InvalidValue: The URL has another scheme, the transport has no such option, or the file cannot be read.
    """
    scheme, separator, rest = url.partition("://")
    if not separator or (not rest.strip("/") and scheme != "ros2"):
        meant = "" if separator or ":" not in url else f" Did you mean {f'ws://{url}'!r}?"
        expected = "A transport is a URL such as tcp://10.0.0.5:5555 or ws://10.0.0.5:9090"
        raise InvalidValue(f"{expected}, not {url!r}.{meant}")
    if scheme not in _CLASSES:
        schemes = ", ".join(f"{one}://" for one in _CLASSES)
        web = {"http": "ws", "https": "wss"}.get(scheme)
        close = web or closest(scheme, _CLASSES)
        meant = f" Did you mean {f'{close}://{rest}'!r}?" if close else ""
        raise InvalidValue(f"{url}: unknown transport {scheme}://; there are {schemes}.{meant}")
    options |= {"credentials": credentials} | ({} if timeout is None else {"timeout": timeout})
    make: Any = resolve_name(_CLASSES[scheme])
    # A class that passes options on to its parent takes the parent's options too.
    signatures = [inspect.signature(kind) for kind in make.__mro__ if "__init__" in vars(kind) and kind is not object]
    known = dict.fromkeys(name for signature in signatures for name in signature.parameters)
    names = [name for name in known if name not in ("url", "env_id", "options")]
    for name in options:
        if name not in names:
            raise InvalidValue(f"{url} takes no {name}; its options are {', '.join(names)}.")
    transport: Transport = make(url, env_id=env_id, **options)
    return transport
