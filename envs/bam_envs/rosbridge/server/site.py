"""A site on the port of a rosbridge server: pages, WebSocket paths of its own, and who may open them."""

import gzip
import hashlib
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from http import HTTPStatus
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qs

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from bam_envs.core.errors import InvalidValue
from bam_envs.core.location import is_loopback
from bam_envs.core.wording import brief
from bam_envs.rosbridge.bus import Caller
from bam_envs.rosbridge.server.server_connection import BridgeConnection

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".ico": "image/x-icon",
    ".txt": "text/plain; charset=utf-8",
    ".woff2": "font/woff2",
}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; font-src 'self'; "
        "connect-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
"""What keeps a page to its own server, which is asked each time; scripts and styles stand in files, not in it."""
_GZIP = re.compile(r"\bgzip\b(?!\s*;\s*q=0(\.0*)?\s*(,|$))", re.IGNORECASE)
"""Finds gzip in a header Accept-Encoding that does not refuse it."""
_IN_ADDRESS = "A token never stands in an address, which is logged: send the header 'Authorization: Bearer TOKEN'."

Handler = Callable[[BridgeConnection, Caller], Awaitable[None]]
"""Serves one admitted WebSocket, in the network thread; its messages have at most 1 MiB. It closes at the end."""


class Page(NamedTuple):
    """What is sent for one path."""

    kind: str  # its media type
    body: bytes


@dataclass(frozen=True)
class Site:
    """Pages by their exact path, and WebSockets by theirs; rosbridge has the path ``/``.

    A server with a site takes a token from the header ``Authorization`` or a page's first message, never from an
    address. A web page comes in only from the server itself: its Origin must be the address in the header ``Host``,
    which must be a loopback one while the server has no tokens (a foreign name may be made to lead here). A WebSocket
    of a page that has yet to show its token is told so: ``{"event": "auth"}``.
    """

    pages: Mapping[str, Page] = field(default_factory=dict)
    sockets: Mapping[str, Handler] = field(default_factory=dict)
    always: frozenset[str] = frozenset()
    """Paths of WebSockets that get in although there is no place: their handlers refuse most by `Caller.full`."""

    def lets_in(self, request: Request | None) -> bool:
        """Whether a client without a place gets in."""
        return request is not None and _path(request) in self.always

    def refusal(self, request: Request, *, secure: bool, tokens: bool) -> tuple[HTTPStatus, str] | None:
        """Why a request is refused, before its token is looked at; None if it is not."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1:
            return HTTPStatus.BAD_REQUEST, f"Expected one header Host, found {len(hosts)}."
        own = f"{'https' if secure else 'http'}://{hosts[0]}"
        if origins and origins != [own]:
            return (
                HTTPStatus.FORBIDDEN,
                f"The page {brief(', '.join(origins))} is not of this server, which is {brief(own)}.",
            )
        if not tokens and not is_loopback(re.sub(r":\d*$", "", hosts[0]).strip("[]").lower()):
            reason = f"Without tokens this server is there for 127.0.0.1 and localhost only, not for {brief(hosts[0])}."
            return HTTPStatus.FORBIDDEN, reason
        path, query = _path(request), request.path.partition("?")[2]
        if "token" in parse_qs(query, keep_blank_values=True):
            return HTTPStatus.BAD_REQUEST, _IN_ADDRESS
        known = {"/", *self.sockets} if is_websocket(request) else self.pages
        if path not in known:
            return HTTPStatus.NOT_FOUND, f"There is no {brief(path)} here."
        return None

    def response(self, request: Request) -> Response:
        """The page that a request asks for, compressed if the client takes that; no body if it has the page already."""
        kind, body = self.pages[_path(request)]
        headers = {"Content-Type": kind, "Connection": "close", "Vary": "Accept-Encoding", **_HEADERS}
        headers["ETag"] = _tag(body)
        if headers["ETag"] in request.headers.get_all("If-None-Match"):
            return Response(HTTPStatus.NOT_MODIFIED.value, HTTPStatus.NOT_MODIFIED.phrase, Headers(headers), b"")
        if _GZIP.search(",".join(request.headers.get_all("Accept-Encoding"))) and len(_packed(body)) < len(body):
            body, headers["Content-Encoding"] = _packed(body), "gzip"
        headers["Content-Length"] = str(len(body))
        return Response(HTTPStatus.OK.value, HTTPStatus.OK.phrase, Headers(headers), body)

    def socket(self, request: Request | None) -> Handler | None:
        """What serves the WebSocket of a request; None for that of rosbridge."""
        return None if request is None else self.sockets.get(_path(request))


@lru_cache(maxsize=64)
def _tag(body: bytes) -> str:
    return f'W/"{hashlib.sha256(body).hexdigest()[:32]}"'


@lru_cache(maxsize=64)
def _packed(body: bytes) -> bytes:
    return gzip.compress(body, mtime=0)


def is_websocket(request: Request) -> bool:
    """Whether a request wants to become a WebSocket."""
    return any("websocket" in text.lower() for text in request.headers.get_all("Upgrade"))


def _path(request: Request) -> str:
    return request.path.partition("?")[0]  # neither decoded nor joined with anything: a name in a table, or none


def read_pages(folder: Path) -> dict[str, Page]:
    """The files of a folder as pages of a `Site`, without subfolders; ``index.html`` is also ``/``."""
    pages: dict[str, Page] = {}
    for path in sorted(one for one in folder.iterdir() if one.is_file() and not one.name.startswith((".", "_"))):
        if path.suffix not in _TYPES:
            raise InvalidValue(f"{path}: expected a page with one of {', '.join(_TYPES)}.")
        pages[f"/{path.name}"] = Page(_TYPES[path.suffix], path.read_bytes())
    return {**pages, "/": pages["/index.html"]} if "/index.html" in pages else pages
