"""Who may come in: the token, the number of clients, the certificate, and clear errors when listening fails."""

from __future__ import annotations

import errno
import hmac
import logging
import ssl
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from bam_envs.errors import InvalidValue

_NO_TOKEN = (
    "This server needs its token: send the header 'Authorization: Bearer TOKEN', or open the URL with ?token=TOKEN."
)
_NO_PAGES = "A web page comes in only with the token of this server, and it was started without one."
_PAGE_REFUSED = (
    "The web page %r was refused: a browser comes in only with a token. "
    "To let it in, start the server with one, and open its URL with ?token=TOKEN."
)
_logger = logging.getLogger(__name__)


class Door:
    """Lets clients in, or says why not.

    Args:
        token: What they must show; None for nothing.
        most: Most clients.
        present: How many there are.
    """

    def __init__(self, token: str | None, most: int, present: Callable[[], int]) -> None:
        if token is not None and not token:
            raise InvalidValue("Token: expected a text, found an empty one.")
        self._token = token.encode() if token is not None else None
        self._most, self._present = most, present

    def check(self, connection: ServerConnection, request: Request) -> Response | None:
        """The refusal of a request to open a WebSocket, or None."""
        if self._token is not None and not self._shows_token(request):
            response = connection.respond(HTTPStatus.UNAUTHORIZED, _NO_TOKEN + "\n")
            response.headers["WWW-Authenticate"] = "Bearer"
            return response
        if self._token is None and "Origin" in request.headers:
            # Any page open in a browser on this computer reaches loopback; programs send no Origin.
            _logger.warning(_PAGE_REFUSED, ", ".join(request.headers.get_all("Origin"))[:100])
            return connection.respond(HTTPStatus.FORBIDDEN, _NO_PAGES + "\n")
        if self._present() >= self._most:
            text = f"There are {self._most} clients, and no room for more.\n"
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, text)
        return None

    def _shows_token(self, request: Request) -> bool:
        headers = request.headers.get_all("Authorization")
        shown = [text.partition(" ")[2].strip() for text in headers if text.lower().startswith("bearer ")]
        shown += parse_qs(urlsplit(request.path).query).get("token", [])
        # In constant time: how long a refusal takes must not tell how much of the token was right.
        return any(hmac.compare_digest(one.encode("utf-8", "surrogateescape"), self._token or b"") for one in shown)


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
