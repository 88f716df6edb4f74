"""The admission of clients: tokens, the number of clients, the server's certificate; and errors of listening."""

import asyncio
import contextlib
import errno
import logging
import ssl
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from websockets.http11 import Request, Response

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.rosbridge.encoding import decode_frame
from bam_envs.rosbridge.server.client_session import ServerOptions
from bam_envs.rosbridge.server.server_connection import BridgeConnection
from bam_envs.rosbridge.tokens import Guesses, Tokens

_NO_TOKEN = (
    "This server needs its token: send the header 'Authorization: Bearer TOKEN', or open the URL with ?token=TOKEN."
)
_TOO_OFTEN = "Too many wrong tokens came from this address; try again in a second."
_NO_PAGES = "A web page comes in only with the token of this server, and it was started without one."
_PAGE_REFUSED = (
    "The web page %r was refused: a browser comes in only with a token. "
    'To let it in, start the server with one, and send it as the first message: {"op": "auth", "token": TOKEN}.'
)
_FIRST = 'The first message of a page must be its token, within {:g} s: {{"op": "auth", "token": TOKEN}}'
_POLICY_VIOLATION = 1008  # close code for a client that does not show its token
_logger = logging.getLogger(__name__)


class Admission:
    """Admits or refuses clients; `present` returns the number of clients."""

    def __init__(self, tokens: Tokens, options: ServerOptions, present: Callable[[], int]) -> None:
        self._tokens, self._guesses = tokens, Guesses()
        self._options, self._present = options, present

    def check(self, connection: BridgeConnection, request: Request) -> Response | None:
        """The refusal of a request to open a WebSocket, or None; a page may show its token later (`greet`)."""
        headers, is_page = request.headers.get_all("Authorization"), "Origin" in request.headers
        shown = [text.partition(" ")[2].strip() for text in headers if text.lower().startswith("bearer ")]
        shown += parse_qs(urlsplit(request.path).query).get("token", [])
        if shown and self._tokens.exist:
            # Several different tokens would be several guesses.
            refusal = self._judge(connection, shown if len(set(shown)) == 1 else [])
            if refusal == _TOO_OFTEN:
                return connection.respond(HTTPStatus.TOO_MANY_REQUESTS, _TOO_OFTEN + "\n")
            if refusal is not None:
                return _unauthorized(connection)
        elif is_page and not self._tokens.exist:
            # Any page open in a browser on this computer reaches loopback; programs send no Origin.
            _logger.warning(_PAGE_REFUSED, ", ".join(request.headers.get_all("Origin"))[:100])
            return connection.respond(HTTPStatus.FORBIDDEN, _NO_PAGES + "\n")
        elif is_page:
            return None  # browsers set no headers, and an address with a token is logged; `greet` reads a message
        elif self._tokens.needed:
            return _unauthorized(connection)
        if full := self._full():
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, full + "\n")
        connection.role = connection.role or "client"
        return None

    async def greet(self, connection: BridgeConnection) -> None:
        """Close a connection that was opened without a token unless its first message shows one."""
        if connection.role is not None:
            return
        limit = self._options.token_timeout
        reason: str | None = _FIRST.format(limit)
        with contextlib.suppress(asyncio.TimeoutError, ProtocolError):
            message = decode_frame(await asyncio.wait_for(connection.next_frame(), limit))
            if message.get("op") == "auth" and isinstance(message.get("token"), str):
                reason = self._judge(connection, [message["token"]])
        if reason is None and (full := self._full()):
            connection.role, reason = None, full
        if reason is not None:
            await connection.close(_POLICY_VIOLATION, reason)

    def _judge(self, connection: BridgeConnection, shown: list[str]) -> str | None:
        """Set the role of a client that shows these tokens; returns the reason for a refusal, or None."""
        if not self._guesses.may_try(connection.host):
            return _TOO_OFTEN
        connection.role = self._tokens.role(shown)
        if connection.role is None:
            self._guesses.wrong(connection.host)
            return "The token is wrong."
        return None

    def _full(self) -> str:
        most = self._options.max_clients
        return f"There are {most} clients, and no room for more." if self._present() >= most else ""


def _unauthorized(connection: BridgeConnection) -> Response:
    response = connection.respond(HTTPStatus.UNAUTHORIZED, _NO_TOKEN + "\n")
    response.headers["WWW-Authenticate"] = "Bearer"
    return response


def tls_context(cert: str, key: str | None) -> ssl.SSLContext:
    """TLS settings of a server, from the files of its certificate chain and its key (None: in the same file)."""
    context, files = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), " and ".join(filter(None, (cert, key)))
    try:
        context.load_cert_chain(cert, key)
    except ssl.SSLError as error:
        if key is None and b"PRIVATE KEY" not in (content := Path(cert).read_bytes()) and b"BEGIN CERT" in content:
            raise InvalidValue(f"Certificate: {cert} holds no key; give the file with its key too (--key).") from error
        verb, reason = "is" if key is None else "are", error.reason or "not PEM"
        raise InvalidValue(f"Certificate: {files} {verb} not a certificate with its key in PEM: {reason}.") from error
    except OSError as error:
        raise InvalidValue(f"Certificate: {files} cannot be read: {error.strerror}. Check --cert and --key.") from error
    return context


def listening_error(host: str, port: int, error: OSError | UnicodeError) -> InvalidValue:
    """The error of a server that cannot listen, with a remedy."""
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.EADDRINUSE:
        return InvalidValue(
            f"Port {port} on {host} is in use. Stop the program there, or choose another port (0 takes a free one)."
        )
    if number == errno.EACCES:
        return InvalidValue(f"Port {port} on {host} is not allowed for this user; choose one above 1023.")
    return InvalidValue(f"Listening on {host!r}, port {port}: expected an address of this computer ({error}).")
