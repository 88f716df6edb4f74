"""Who may come in: the token, the number of clients, the certificate, and clear errors when listening fails."""

from __future__ import annotations

import asyncio
import errno
import logging
import ssl
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.rosbridge.encoding import decode_frame
from bam_envs.rosbridge.server.connection import BridgeConnection
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
_GREETING = 2.0
"""How long a page may take to show its token [s]."""
_POLICY_VIOLATION = 1008
"""Close code of who does not show it."""
_logger = logging.getLogger(__name__)


class Door:
    """Lets clients in, or says why not.

    Args:
        tokens: What they must show.
        most: Most clients.
        present: How many there are.
    """

    def __init__(self, tokens: Tokens, most: int, present: Callable[[], int]) -> None:
        self._tokens, self._guesses = tokens, Guesses()
        self._most, self._present = most, present

    def check(self, connection: ServerConnection, request: Request) -> Response | None:
        """The refusal of a request to open a WebSocket, or None; a page may show its token later (`greet`)."""
        if not isinstance(connection, BridgeConnection):
            raise TypeError(f"Expected a BridgeConnection, found {connection!r}.")
        shown, is_page = _shown(request), "Origin" in request.headers
        if shown and self._tokens.exist:
            refusal = self._look(connection, shown)
            if refusal is not None:
                return refusal
        elif is_page and not self._tokens.exist:
            # Any page open in a browser on this computer reaches loopback; programs send no Origin.
            _logger.warning(_PAGE_REFUSED, ", ".join(request.headers.get_all("Origin"))[:100])
            return connection.respond(HTTPStatus.FORBIDDEN, _NO_PAGES + "\n")
        elif is_page:
            return None  # browsers set no headers, and an address with a token is logged: it may be a message, too
        elif self._tokens.needed:
            return _unauthorized(connection)
        if self._present() >= self._most:
            text = f"There are {self._most} clients, and no room for more.\n"
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, text)
        connection.role = connection.role or "client"
        return None

    def _look(self, connection: BridgeConnection, shown: list[str]) -> Response | None:
        if not self._guesses.may_try(connection.host):
            return connection.respond(HTTPStatus.TOO_MANY_REQUESTS, _TOO_OFTEN + "\n")
        connection.role = self._tokens.role(shown) if len(set(shown)) == 1 else None  # several would be several guesses
        if connection.role is None:
            self._guesses.wrong(connection.host)
            return _unauthorized(connection)
        return None

    async def greet(self, connection: BridgeConnection) -> None:
        """See to it that who came in without a token shows it now, or is out."""
        if connection.role is not None:
            return
        reason = _FIRST.format(_GREETING)
        try:
            token = _read_auth(await asyncio.wait_for(connection.next_frame(), _GREETING))
        except (TimeoutError, asyncio.TimeoutError):
            token = None
        if token is not None and not self._guesses.may_try(connection.host):
            reason, token = _TOO_OFTEN, None
        if token is not None:
            connection.role = self._tokens.role([token])
            if connection.role is None:
                self._guesses.wrong(connection.host)
                reason = "The token is wrong."
        if connection.role is not None and self._present() >= self._most:
            connection.role, reason = None, f"There are {self._most} clients, and no room for more."
        if connection.role is None:
            await connection.close(_POLICY_VIOLATION, reason)


def _shown(request: Request) -> list[str]:
    """The tokens that `request` shows."""
    headers = request.headers.get_all("Authorization")
    bearers = [text.partition(" ")[2].strip() for text in headers if text.lower().startswith("bearer ")]
    return bearers + parse_qs(urlsplit(request.path).query).get("token", [])


def _read_auth(frame: str | bytes) -> str | None:
    try:
        message = decode_frame(frame)
    except ProtocolError:
        return None
    token = message.get("token")
    return token if message.get("op") == "auth" and isinstance(token, str) else None


def _unauthorized(connection: BridgeConnection) -> Response:
    response = connection.respond(HTTPStatus.UNAUTHORIZED, _NO_TOKEN + "\n")
    response.headers["WWW-Authenticate"] = "Bearer"
    return response


def tls_context(cert: str, key: str | None) -> ssl.SSLContext:
    """A server's side of TLS.

    Args:
        cert: File with the certificate chain.
        key: File with its key; None if it is in the same one.

    Raises:
        InvalidValue: They cannot be read, or do not fit each other.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    files = f"{cert} is" if key is None else f"{cert} and {key} are"
    try:
        context.load_cert_chain(cert, key)
    except ssl.SSLError as error:
        if key is None and _is_only_a_certificate(cert):
            raise InvalidValue(f"Certificate: {cert} holds no key; give the file with its key too (--key).") from error
        reason = error.reason or "not PEM"
        raise InvalidValue(f"Certificate: {files} not a certificate with its key in PEM: {reason}.") from error
    except OSError as error:
        read = cert if key is None else f"{cert} and {key}"
        raise InvalidValue(f"Certificate: {read} cannot be read: {error.strerror}.") from error
    return context


def _is_only_a_certificate(path: str) -> bool:
    content = Path(path).read_bytes()
    return b"BEGIN CERTIFICATE" in content and b"PRIVATE KEY" not in content


def listening_error(host: str, port: int, error: OSError | UnicodeError) -> InvalidValue:
    """Why a server cannot listen, and what to do."""
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.EADDRINUSE:
        return InvalidValue(
            f"Port {port} on {host} is in use. Stop the program there, or choose another port (0 takes a free one)."
        )
    if number == errno.EACCES:
        return InvalidValue(f"Port {port} on {host} is not allowed for this user; choose one above 1023.")
    return InvalidValue(f"Listening on {host!r}, port {port}: expected an address of this computer ({error}).")
