"""A plain WebSocket connection with `websockets`, for what roslibpy cannot do; its failures in the same words."""

from __future__ import annotations

import socket

from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from bam_envs.rosbridge.link.dialing import Dial
from bam_envs.rosbridge.link.refusals import no_connection, no_websocket, refused_status, silent_port

CLOSE_WITHIN = 1.0
"""How long a closing handshake may take [s]."""
_PING_EVERY = _PING_ANSWERED_WITHIN = 2.0


def open_websocket(dial: Dial, timeout: float) -> ClientConnection:
    """Connect; to be used with ``with``.

    Args:
        dial: Where to, and how.
        timeout: For TCP, and again for the rest [s].

    Raises:
        NoServer: There is no server that can be used; the text says why.
        InvalidValue: The CA file cannot be read.
    """
    address, context = dial.address, dial.endpoint.tls_context()
    try:
        # A socket of our own keeps `websockets` from going through a proxy, behind which no robot is.
        plain = socket.create_connection((address.host, address.port), timeout)
    except OSError as error:
        raise no_connection(address, error, timeout) from error
    try:
        return connect(
            f"{address.url}/",
            sock=plain,
            ssl=context,
            server_hostname=address.host if context is not None else None,
            additional_headers=dial.endpoint.headers,
            compression=None,
            open_timeout=timeout,
            close_timeout=CLOSE_WITHIN,
            ping_interval=_PING_EVERY,
            ping_timeout=_PING_ANSWERED_WITHIN,
            max_size=dial.max_message,
        )
    except InvalidStatus as error:
        raise refused_status(address.url, error.response.status_code) from error
    except TimeoutError as error:
        raise silent_port(address.url, timeout) from error
    except OSError as error:
        raise no_connection(address, error, timeout) from error
    except WebSocketException as error:
        raise no_websocket(address.url, str(error)) from error
