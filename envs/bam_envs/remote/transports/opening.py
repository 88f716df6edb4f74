"""One function that makes the transport of a URL."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.remote.transports.transport import Transport
from bam_envs.rosbridge.endpoint import Endpoint

_CLASSES = {
    "tcp": "bam_envs.remote.transports.tcp:TcpTransport",
    "ws": "bam_envs.remote.transports.rosbridge:RosbridgeTransport",
    "wss": "bam_envs.remote.transports.rosbridge:RosbridgeTransport",
    "ros2": "bam_envs.remote.transports.rclpy:RclpyTransport",
}
"""By the scheme of the URL; imported on use."""


def open_transport(
    url: str,
    *,
    env_id: str = "",
    ca_file: str | None = None,
    token_file: str | None = None,
    timeout: float | None = None,
    **options: Any,
) -> Transport:
    """The transport of `url`, not connected yet.

    =======================  ====================================================
    url                      what is there
    =======================  ====================================================
    tcp://host:port          ``bam-serve --tcp PORT``
    ws://host:port/space     a rosbridge server, such as ``bam-serve --port PORT``
    wss://host:port/space    the same with TLS
    ros2://space             a ROS 2 graph, where rclpy is installed
    =======================  ====================================================

    Args:
        url: Where the environment runs; `space` is a ROS namespace and may be left out.
        env_id: Which environment is wanted; "" for the one that is there.
        ca_file: Certificates that the server's is checked against, with wss://.
        token_file: A file that holds the server's secret.
        timeout: Longest that an answer is waited for [s]; None for the default of the transport's class.
        options: Other keywords of that class, such as ``connect_timeout``.

    Raises:
        InvalidValue: The URL has another scheme, the transport has no such option, or the file cannot be read.
    """
    scheme, separator, rest = url.partition("://")
    if not separator or (not rest.strip("/") and scheme != "ros2"):
        raise InvalidValue(f"A transport is a URL such as tcp://10.0.0.5:5555 or ws://10.0.0.5:9090, not {url!r}.")
    if scheme not in _CLASSES:
        raise InvalidValue(f"{url}: {UnknownName('transport', scheme, _CLASSES)} It must be one of {_schemes()}.")
    endpoint = Endpoint.with_token_file(url, ca_file=ca_file, token_file=token_file)
    for name, value in (("ca_file", ca_file), ("timeout", timeout)):
        if value is not None:
            options = {**options, name: value}
    if token_file is not None:
        options = {**options, "token": endpoint.token}
    module, _, name = _CLASSES[scheme].partition(":")
    make: Any = getattr(importlib.import_module(module), name)
    _require_options(url, make, options)
    transport: Transport = make(url, env_id=env_id, **options)
    return transport


def _require_options(url: str, make: type[Transport], options: Mapping[str, Any]) -> None:
    """Each option is one of the transport's."""
    # A class that hands options on to its parent takes those of the parent.
    signatures = [inspect.signature(kind) for kind in make.__mro__ if "__init__" in vars(kind) and kind is not object]
    names = dict.fromkeys(name for signature in signatures for name in signature.parameters)
    known = [name for name in names if name not in ("url", "env_id", "options")]
    for name in options:
        if name not in known:
            raise InvalidValue(f"{url} takes no {name}; its options are {', '.join(known)}.")


def _schemes() -> str:
    return ", ".join(f"{scheme}://" for scheme in _CLASSES)
