"""Opening a WebSocket to a server, and in words why it could not be opened: each reason has its own remedy."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus, WebSocketException

from bam_envs.core.errors import NoServer
from bam_envs.rosbridge.endpoint import Address, Endpoint

CLOSE_WITHIN = 1.0
"""Longest time for a closing handshake [s]."""
_HOST_MISMATCH = (62, 64)  # X509_V_ERR_HOSTNAME_MISMATCH, X509_V_ERR_IP_ADDRESS_MISMATCH
_QUIET = logging.getLogger(f"{__name__}.websockets")
_QUIET.setLevel(logging.CRITICAL)  # a link says itself, and in one line, why it ended or did not open


async def open_socket(endpoint: Endpoint, timeout: float, max_message: int) -> ClientConnection:
    """Connect and do the WebSocket handshake.

    Args:
        endpoint: The server.
        timeout: For everything together [s].
        max_message: Largest message to receive [bytes].

    Raises:
        NoServer: There is no server that can be used; the text says why.
        InvalidValue: The CA file cannot be read.
    """
    address, context = endpoint.address, endpoint.tls_context()
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout
    try:
        # TCP first, so that a port that is closed, one behind a firewall and one that is silent are told apart; and
        # so that websockets goes through no proxy, behind which no robot is.
        plain = await asyncio.wait_for(_open_tcp(address), timeout)
    except (OSError, asyncio.TimeoutError) as error:
        raise _no_connection(address, error, timeout) from error
    try:
        return await connect(
            f"{address.url}/",
            sock=plain,
            ssl=context,
            server_hostname=address.host if context is not None else None,
            additional_headers=endpoint.headers,
            compression=None,  # deflate costs more time than a fast network saves
            open_timeout=deadline - loop.time(),
            close_timeout=CLOSE_WITHIN,
            ping_interval=None,
            max_size=max_message,
            logger=_QUIET,
        )
    except InvalidStatus as error:
        raise _refused_status(address.url, error.response.status_code) from error
    except TimeoutError as error:
        raise _silent_port(address, timeout) from error
    except OSError as error:
        raise _no_connection(address, error, timeout) from error
    except ValueError as error:  # a redirect, which leads to another server than the one that was meant
        raise NoServer(address.url, f"a web server answers there: {error}. Is it the right port?") from error
    except WebSocketException as error:
        reason = error.__cause__ or error
        text = f"something listens there that is no WebSocket server ({reason}). If it has TLS, use wss://."
        raise NoServer(address.url, text) from error


async def _open_tcp(address: Address) -> socket.socket:
    loop = asyncio.get_running_loop()
    infos = await loop.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
    for place, (family, kind, protocol, _, target) in enumerate(infos):
        plain = socket.socket(family, kind, protocol)
        plain.setblocking(False)
        try:
            await loop.sock_connect(plain, target)
            return plain
        except BaseException as error:
            plain.close()
            if not isinstance(error, OSError) or place == len(infos) - 1:
                raise
    raise OSError("the name has no address")


def _silent_port(address: Address, timeout: float) -> NoServer:
    hint = " Does it speak TLS? If not, use ws://." if address.secure else ""
    return NoServer(
        address.url,
        f"the port is open, and what listens there says nothing within {timeout:.1f} s. "
        f"Is it a rosbridge server?{hint}",
    )


def silent_bridge(url: str, timeout: float) -> NoServer:
    """It speaks WebSocket, and answers no request within `timeout` [s]."""
    return NoServer(
        url,
        f"a WebSocket server that answers no rosbridge request within {timeout:.1f} s. "
        "Is it a rosbridge server, and is its ROS node alive?",
    )


def _refused_status(url: str, status: int) -> NoServer:
    if status in (401, 403):
        return NoServer(url, f"the token was refused (HTTP {status}). Give the server's token (--token-file).")
    return NoServer(url, f"a web server answers there, with HTTP {status}: no WebSocket. Is it the right port?")


def _no_connection(address: Address, error: OSError | asyncio.TimeoutError, timeout: float) -> NoServer:
    """TCP or TLS did not come about within `timeout` [s]; raise it ``from error``."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return NoServer(address.url, _untrusted(address, error))
    if isinstance(error, ssl.SSLError):
        return NoServer(address.url, f"TLS failed: {error.reason}. If the server has no TLS, use ws://.")
    if isinstance(error, TimeoutError | asyncio.TimeoutError):
        text = f"no connection within {timeout:.1f} s. Is the address right, is the machine on, is a firewall between?"
        return NoServer(address.url, text)
    if isinstance(error, socket.gaierror):
        return NoServer(address.url, f"the name {address.host!r} is not known: {error.strerror}. Try the IP address.")
    if isinstance(error, ConnectionRefusedError):
        return NoServer(
            address.url,
            f"refused: nothing listens there. Is the port open? Start one with "
            f"`bam-serve --env bam/pick --port {address.port}` "
            "or `ros2 launch rosbridge_server rosbridge_websocket_launch.xml`.",
        )
    if isinstance(error, ConnectionError):
        hint = "If the server has no TLS, use ws://." if address.secure else "Is it the right port?"
        return NoServer(address.url, f"the connection was cut while it was made. {hint}")
    return NoServer(address.url, f"cannot be reached: {error.strerror or error}.")


def _untrusted(address: Address, error: ssl.SSLCertVerificationError) -> str:
    reason = error.verify_message.rstrip(".")
    if error.verify_code in _HOST_MISMATCH:
        return f"the certificate is not for {address.host!r}: {reason}. Use a name that is in it."
    return (
        f"the certificate is not trusted: {reason}. "
        "Give the file of the authority that signed it as ca_file (--ca-file)."
    )
