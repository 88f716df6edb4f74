"""Why a server cannot be used, in words: each step that can fail has its own text, because it has its own remedy."""

from __future__ import annotations

import asyncio
import socket
import ssl

from bam_envs.core.errors import NoServer
from bam_envs.rosbridge.endpoint import Address

_HOST_MISMATCH = (62, 64)  # X509_V_ERR_HOSTNAME_MISMATCH, X509_V_ERR_IP_ADDRESS_MISMATCH


def no_connection(address: Address, error: OSError | asyncio.TimeoutError, timeout: float) -> NoServer:
    """TCP or TLS did not come about within `timeout` [s]; raise it ``from error``."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return NoServer(address.url, _untrusted(address, error))
    if isinstance(error, ssl.SSLError):
        return NoServer(address.url, f"TLS failed: {error.reason}. If the server has no TLS, use ws://.")
    if isinstance(error, TimeoutError | asyncio.TimeoutError):
        return NoServer(address.url, _unreachable(address, timeout))
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


def refused_status(url: str, status: int) -> NoServer:
    """An HTTP server answered the WebSocket handshake with a status of its own."""
    if status in (401, 403):
        return NoServer(url, f"the token was refused (HTTP {status}). Give the server's token (--token-file).")
    return NoServer(url, f"a web server answers there, with HTTP {status}: no WebSocket. Is it the right port?")


def no_websocket(url: str, reason: str) -> NoServer:
    """What listens there does not understand the WebSocket handshake."""
    return NoServer(url, f"something listens there that is no WebSocket server ({reason}). If it has TLS, use wss://.")


def silent_port(url: str, timeout: float) -> NoServer:
    """What listens there does not answer the WebSocket handshake within `timeout` [s]."""
    return NoServer(
        url, f"the port is open, and what listens there says nothing within {timeout:.1f} s. Is it a rosbridge server?"
    )


def silent_bridge(url: str, timeout: float) -> NoServer:
    """It speaks WebSocket, and answers no request within `timeout` [s]."""
    return NoServer(
        url,
        f"a WebSocket server that answers no rosbridge request within {timeout:.1f} s. "
        "Is it a rosbridge server, and is its ROS node alive?",
    )


def echoes(url: str) -> NoServer:
    """It sends back what it is sent, which looks like a request of its own, and would get an answer from us."""
    return NoServer(url, "an echo server: it sends back what it is sent. Is it the right port?")


def _unreachable(address: Address, timeout: float) -> str:
    tls = "does it speak TLS (wss://), " if address.secure else ""
    return f"no connection within {timeout:.1f} s. Is the address right, is the machine on, {tls}is a firewall between?"


def _untrusted(address: Address, error: ssl.SSLCertVerificationError) -> str:
    reason = error.verify_message.rstrip(".")
    if error.verify_code in _HOST_MISMATCH:
        return f"the certificate is not for {address.host!r}: {reason}. Use a name that is in it."
    return (
        f"the certificate is not trusted: {reason}. "
        "Give the file of the authority that signed it as ca_file (--ca-file)."
    )
