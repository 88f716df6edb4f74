"""The admission of clients: tokens, the number of clients, the server's certificate; and errors of listening."""

import asyncio
import contextlib
import errno
import logging
import ssl
from collections.abc import Awaitable, Collection, Iterable
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from websockets.http11 import Request, Response

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.rosbridge.encoding import decode_frame
from bam_envs.rosbridge.server.client_session import ServerOptions
from bam_envs.rosbridge.server.server_connection import BridgeConnection
from bam_envs.rosbridge.server.site import Site, is_websocket
from bam_envs.rosbridge.tokens import Guesses, Refusals, Tokens, places, who_leaves

_BEARER = "This server needs its token: send the header 'Authorization: Bearer TOKEN'"
_TOO_OFTEN = "Too many wrong tokens came from this address; try again in a second."
_WRONG = "The token is wrong."
_REVOKED = "The token of this connection is valid no longer."
_NO_PAGES = "A web page comes in only with the token of this server, and it was started without one."
_PAGE_REFUSED = (
    "The web page %r was refused: a browser comes in only with a token. "
    'To let it in, start the server with one, and send it as the first message: {"op": "auth", "token": TOKEN}.'
)
_FIRST = 'The first message of a page must be its token, within {:g} s: {{"op": "auth", "token": TOKEN}}'
_POLICY_VIOLATION = 1008  # close code for a client that does not show its token
_STATUS = {_TOO_OFTEN: HTTPStatus.TOO_MANY_REQUESTS}
_logger = logging.getLogger(__name__)


class ClientAdmission:
    """Admits or refuses clients; `sockets` has the open ones."""

    def __init__(
        self,
        tokens: Tokens,
        options: ServerOptions,
        sockets: Collection[BridgeConnection],
        refusals: Refusals,
        site: Site | None,
        secure: bool,
    ) -> None:
        self._tokens, self._guesses, self._version = tokens, Guesses(), tokens.version
        self._options, self._sockets, self._site, self._secure = options, sockets, site, secure
        self._refusals = refusals

    def check(self, connection: BridgeConnection, request: Request) -> Response | None:
        """A page, or the refusal of a request, or None for a WebSocket; a page may show its token later (`greet`)."""
        refusal = None
        if self._site is not None:
            refusal = self._site.refusal(request, secure=self._secure, tokens=self._tokens.exist)
            if refusal is None and not is_websocket(request):
                return self._site.response(request)
        refusal = refusal or self._refusal(connection, request)
        if refusal is None:
            return None
        status, text = refusal
        if text != _NO_PAGES:
            self._refusals.note(connection.host, text)
        response = connection.respond(status, text + "\n")
        if status is HTTPStatus.UNAUTHORIZED:
            response.headers["WWW-Authenticate"] = "Bearer"
        return response

    def _refusal(self, connection: BridgeConnection, request: Request) -> tuple[HTTPStatus, str] | None:
        """Why a client may not open a WebSocket; else None, and a client without `greet` before it has its role."""
        headers, is_page = request.headers.get_all("Authorization"), "Origin" in request.headers
        shown = [text.partition(" ")[2].strip() for text in headers if text.lower().startswith("bearer ")]
        if self._site is None:
            shown += parse_qs(urlsplit(request.path).query).get("token", [])
        no_token = f"{_BEARER}." if self._site else f"{_BEARER}, or open the URL with ?token=TOKEN."
        if shown and self._tokens.exist:
            # Several different tokens would be several guesses.
            refusal = self._judge(connection, shown if len(set(shown)) == 1 else [])
            if refusal is not None:
                text = no_token if refusal == _WRONG and not self._site else refusal
                return _STATUS.get(refusal, HTTPStatus.UNAUTHORIZED), text
        elif is_page and not self._tokens.exist and self._site is None:
            # Any page open in a browser on this computer reaches loopback; programs send no Origin.
            _logger.warning(_PAGE_REFUSED, ", ".join(request.headers.get_all("Origin"))[:100])
            return HTTPStatus.FORBIDDEN, _NO_PAGES
        elif is_page and self._tokens.exist:
            return None  # browsers set no headers, and an address with a token is logged; `greet` reads a message
        elif self._tokens.needed:
            return HTTPStatus.UNAUTHORIZED, no_token
        connection.role = connection.role or self._tokens.otherwise
        if self._place(connection, request):
            return None
        connection.role = None
        return HTTPStatus.SERVICE_UNAVAILABLE, connection.full

    async def greet(self, connection: BridgeConnection) -> None:
        """Close a connection that was opened without a token unless its first message shows one."""
        if connection.role is not None:
            return
        if self._site is not None and self._site.socket(connection.request) is not None:
            await connection.send('{"event": "auth"}')
        limit = self._options.token_timeout
        reason: str | None = _FIRST.format(limit)
        with contextlib.suppress(asyncio.TimeoutError, ProtocolError):
            message = decode_frame(await asyncio.wait_for(connection.next_frame(), limit))
            if message.get("op") == "auth" and isinstance(message.get("token"), str):
                reason = self._judge(connection, [message["token"]])
        connection.spoke = 0.0
        if reason is None and not self._place(connection, connection.request):
            connection.role, reason = None, connection.full
        if reason is not None:
            self._refusals.note(connection.host, reason)
            await connection.close(_POLICY_VIOLATION, reason)

    def revoked(self, connections: Iterable[BridgeConnection]) -> list[Awaitable[None]]:
        """Close the connections whose token is valid no longer, or has another role; the closings are to be awaited."""
        self._tokens.refresh()
        if self._tokens.version == self._version:
            return []
        self._version = self._tokens.version
        gone = [one for one in connections if one.secret and self._tokens.role([one.secret]) != one.role]
        for one in gone:
            self._refusals.note(one.host, _REVOKED)
        return [one.close(_POLICY_VIOLATION, _REVOKED) for one in gone]

    def _judge(self, connection: BridgeConnection, shown: list[str]) -> str | None:
        """Set the role of a client that shows these tokens; returns the reason for a refusal, or None."""
        if not self._guesses.may_try(connection.host):
            return _TOO_OFTEN
        self._tokens.refresh()
        connection.role = self._tokens.role(shown)
        if connection.role is None:
            self._guesses.wrong(connection.host)
            return _WRONG
        connection.secret = shown[0]
        return None

    def _place(self, connection: BridgeConnection, request: Request | None) -> bool:
        """Give a client a place, perhaps that of another one; whether it is let in."""
        role, most = connection.role or "watch", self._options.max_clients
        present, room = [one for one in self._sockets if one.placed], places(most, role, self._tokens.roles)
        if len(present) >= room:
            leaves = who_leaves(connection, present)
            if leaves is None:
                whose = f"All {room} of {most} places for the role {role} are taken."
                connection.full = f"There are {most} clients, and no room for more." if room == most else whose
                return self._site is not None and self._site.lets_in(request)
            leaves.give_way("It gave its place to another client.")
        connection.placed = True
        return True


class _LoggedTls(ssl.SSLObject):
    """Logs handshakes that fail, which asyncio keeps to itself; it does not know the address."""

    _refusals = Refusals(_logger)

    def do_handshake(self) -> None:
        try:
            super().do_handshake()
        except ssl.SSLError as error:
            if not isinstance(error, (ssl.SSLWantReadError, ssl.SSLWantWriteError)):
                self._refusals.note("A client", f"TLS failed: {error.reason}.")
            raise


def tls_context(cert: str, key: str | None) -> ssl.SSLContext:
    """TLS settings of a server, from the files of its certificate chain and its key (None: in the same file)."""
    context, files = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), " and ".join(filter(None, (cert, key)))
    context.sslobject_class = _LoggedTls
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
