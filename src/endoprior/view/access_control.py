"""Access control of the viewer: a secret token in its address, and limits of what connections send.

viser has no option for them. `access_control` hands them to the web server (`websockets`) that viser starts.
"""

from __future__ import annotations

import hmac
import logging
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from http import HTTPStatus
from typing import Any

import msgspec
import websockets.asyncio.server as web_server
from websockets.exceptions import ConnectionClosedError
from websockets.http11 import Request, Response

from .addresses import Names, is_known_host
from .incoming import Accepts, RateLimit, is_valid_message

MAX_MESSAGE_BYTES = 2**16
"""Largest message of a browser; normal messages have a few hundred bytes."""
MAX_BROWSERS = 32
"""Largest number of simultaneous connections."""
MAX_PER_SECOND = 500
"""Largest message rate of one connection; dragging sends one per screen refresh."""
HEADERS = {
    # viser's page is one file of inline scripts and styles. It unpacks them with WebAssembly, and its sorter of splats
    # builds functions from text. Its workers, sorter and images are blob: or data: addresses.
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
        "worker-src blob: data:; connect-src 'self' data:; img-src data: blob:; font-src data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
"""Headers of every response."""
WRONG_HOST = (
    "Expected localhost, an IP address or the name of this machine in the address of the viewer. "
    "Behind a proxy with another name: `endoprior view RUN --allow-host NAME`.\n"
)
WRONG_TOKEN = "Expected the address that endoprior printed when the viewer started: it has a token.\n"
ShowPage = Callable[[web_server.ServerConnection, Request], Response]
"""viser's answer to a request for its page."""


@contextmanager
def access_control(token: str, host: str, accepts: Accepts, allowed: Names = ()) -> Iterator[None]:
    """Start the viser server within this context, to guard all of its pages and connections.

    Args:
        token: the path of the page, a secret.
        host: address that the server listens on.
        allowed: other names in the address of the page, such as that of a proxy.
    Raises:
        RuntimeError: viser started no web server of `websockets`, so that nothing is guarded.
    """
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # it logs a traceback for each malformed request
    guard, serve, used = _Guard(token, host, allowed), web_server.serve, False

    def serve_guarded(*args: Any, process_request: ShowPage, **options: Any) -> Any:
        nonlocal used
        used = True
        guarded = {
            "process_request": partial(guard.answer, show_page=process_request),
            "create_connection": partial(_LimitedConnection, accepts=accepts),
            "max_size": MAX_MESSAGE_BYTES,
        }
        return serve(*args, **options | guarded)

    with _serving_by(serve_guarded):
        yield
    if not used:
        raise RuntimeError("viser starts its web server in another way than the viewer's access control expects")


@contextmanager
def _serving_by(serve: Callable[..., Any]) -> Iterator[None]:
    """Replace `websockets.asyncio.server.serve` within this context.

    viser (1.1) calls it in a function inside of a method, with its own `process_request` and a limit of 50 MB, and has
    no argument, hook or method to override for either, nor for the class of connections. This name is the only seam.
    """
    original = web_server.serve
    web_server.serve = serve
    try:
        yield
    finally:
        web_server.serve = original


@dataclass(frozen=True)
class _Guard:
    """Who may see the page and open a connection; see `access_control`."""

    token: str
    host: str
    allowed: Names

    def answer(
        self, connection: web_server.ServerConnection, request: Request, *, show_page: ShowPage
    ) -> Response | None:
        """The response to a request, with `HEADERS`; None opens the connection of a browser."""
        response = self._answer(connection, request, show_page)
        if response is not None:
            response.headers.update(HEADERS)
        return response

    def _answer(
        self, connection: web_server.ServerConnection, request: Request, show_page: ShowPage
    ) -> Response | None:
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or not is_known_host(hosts[0], self.host, self.allowed):
            return connection.respond(HTTPStatus.FORBIDDEN, WRONG_HOST)
        if not self._has_token(request.path):
            return connection.respond(HTTPStatus.FORBIDDEN, WRONG_TOKEN)
        if "Upgrade" in request.headers:
            is_full = len(connection.server.connections) >= MAX_BROWSERS
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "Too many browsers.\n") if is_full else None
        if request.path != f"/{self.token}/":  # viser's page obeys queries: one makes it connect to another server
            response = connection.respond(HTTPStatus.FOUND, "")
            response.headers["Location"] = f"/{self.token}/"
            return response
        return show_page(connection, replace(request, path="/"))

    def _has_token(self, path: str) -> bool:
        given = path.partition("?")[0].strip("/").encode(errors="replace")
        return hmac.compare_digest(given, self.token.encode())


class _LimitedConnection(web_server.ServerConnection):
    """A connection that passes on valid messages only, and ends if it floods or sends no MessagePack."""

    def __init__(self, *args: Any, accepts: Accepts, **options: Any) -> None:
        super().__init__(*args, **options)
        self._accepts, self._rate = accepts, RateLimit(MAX_PER_SECOND)

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            raw, message = await super().recv(decode), None
            with suppress(msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
                if isinstance(raw, bytes) and not self._rate.exceeded(clock.monotonic()):
                    message = msgspec.msgpack.decode(raw)
            if message is None:
                self.transport.abort()
                raise ConnectionClosedError(None, None)
            if is_valid_message(message, self._accepts):
                return raw
