"""Access control of the viewer: a secret token in its address, and limits of what connections send and ask for.

viser has no option for them. `access_control` hands them to the web server (`websockets`) that viser starts. viser
also trusts every message: one could set any attribute of a control, or store parts of an upload that was not requested.
"""

from __future__ import annotations

import errno
import hmac
import ipaddress
import logging
import math
import re
import socket
import threading
import time as clock
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache, partial
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import msgspec
import websockets.asyncio.server as web_server
from websockets.exceptions import ConnectionClosedError
from websockets.http11 import Request, Response

from ..core.checks import input_error
from ..core.geometry import FARTHEST_MM

MAX_MESSAGE_BYTES = 2**16
"""Largest message of a browser; normal messages have a few hundred bytes."""
MAX_BROWSERS = 32
"""Largest number of simultaneous connections."""
MAX_PER_SECOND = 500
"""Largest message rate of one connection; dragging sends one per screen refresh."""
MAX_WAITING = 200
"""Largest number of waiting jobs; a person never reaches it."""
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
HOST_NAME = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?")
WRONG_HOST = (
    "Expected localhost, an IP address or the name of this machine in the address of the viewer. "
    "Behind a proxy with another name: `endoprior view RUN --allow-host NAME`.\n"
)
WRONG_TOKEN = "Expected the address that endoprior printed when the viewer started: it has a token.\n"
Job = Callable[[], object]
Names = Collection[str]
Accepts = Callable[[str, Any], bool]
"""Whether the control with this id can have this value."""


def check_address(host: str, port: int) -> None:
    """Check that the address is free; viser would silently use another port, or wait. Raises InputError."""
    if not 0 <= port <= 65535:
        raise input_error("--port", "0 to 65535", str(port), "`--port 0` for any free port.")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(found[0], socket.SOCK_STREAM) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(found[4])
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        unknown = isinstance(error, (socket.gaierror, UnicodeError)) or error.errno == errno.EADDRNOTAVAIL
        fix = "correct --host: an address of this machine." if unknown else "`--port 0`."
        raise input_error(f"{host}:{port}", "a free address", reason, fix) from None


def is_open(host: str) -> bool:
    """Whether other machines can connect to a viewer that listens on this address of `check_address`."""
    return not all(ipaddress.ip_address(found[4][0]).is_loopback for found in socket.getaddrinfo(host, None))


def is_known_host(asked: str, host: str, allowed: Names = ()) -> bool:
    """Whether a `Host` header names this machine: by an IP address, as localhost, by a name of its own, by `host`, or
    by a name that the user has `allowed`.

    Any other name was made to point here by somebody else (DNS rebinding).
    """
    try:
        name = (urlsplit(f"//{asked}").hostname or "").removesuffix(".")
        given = {each.lower().removesuffix(".") for each in ("localhost", host, *allowed)} - {""}
        return name in given or name in names_of_machine() or bool(ipaddress.ip_address(name))
    except ValueError:
        return False


@cache
def names_of_machine() -> frozenset[str]:
    """Names that this machine gives itself, in lower case: short, in full, and on its local network.

    The full one may ask a name server, once, and take some seconds.
    """
    own = socket.gethostname()
    found = [own, socket.getfqdn()]
    with suppress(OSError):  # one without an address
        name, others, _ = socket.gethostbyaddr(own)
        found += [name, *others]
    names = {name.lower().removesuffix(".") for name in found} - {""}
    short = own.lower().partition(".")[0]
    return frozenset(names | ({short, f"{short}.local"} if short else set()))


def check_names(names: Iterable[str]) -> None:
    """Raise InputError unless `--allow-host` has names of hosts alone: no address of a page, no port, no pattern."""
    for name in names:
        if not HOST_NAME.fullmatch(name):
            found = re.search(r"[A-Za-z0-9][A-Za-z0-9-]*(\.[A-Za-z0-9-]+)+", name)
            fix = f"`--allow-host {found[0] if found and '*' not in name else 'NAME'}`."
            raise input_error("--allow-host", "the name of a host, such as viewer.example.org", repr(name), fix)


class RateLimit:
    """Counts what happens in each second."""

    def __init__(self, most: int) -> None:
        self._most, self._since, self._count = most, float("-inf"), 0

    def exceeded(self, now: float) -> bool:
        """Count an event at `now`, s; whether there are more than allowed in this second."""
        if now - self._since >= 1:
            self._since, self._count = now, 0
        self._count += 1
        return self._count > self._most


class JobQueue:
    """A bounded job queue: many threads add jobs, one thread runs them."""

    def __init__(self) -> None:
        self._waiting: list[tuple[Hashable, Job]] = []
        self._changed = threading.Condition()

    def put(self, job: Job, key: Hashable = None, *, surely: bool = False) -> None:
        """Add a job. Jobs beyond `MAX_WAITING` are dropped.

        Args:
            key: only one job per key waits at a time. The job reads its state when it runs, so it uses the newest.
            surely: never drop this job.
        """
        with self._changed:
            keys = [each for each, _ in self._waiting]
            if key in keys if key is not None else len(keys) >= MAX_WAITING and not surely:
                return
            self._waiting.append((key, job))
            self._changed.notify()

    def take(self, seconds: float) -> list[Job]:
        """All waiting jobs, in order; an empty list if none arrives within `seconds`."""
        with self._changed:
            if not self._waiting and seconds > 0:
                self._changed.wait(min(seconds, threading.TIMEOUT_MAX))
            jobs, self._waiting = [job for _, job in self._waiting], []
            return jobs


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
    original, used = web_server.serve, False

    def serve(*args: Any, process_request: Callable[..., Response], **options: Any) -> Any:
        nonlocal used
        used = True

        def answer(connection: web_server.ServerConnection, request: Request) -> Response | None:
            path, hosts = request.path, request.headers.get_all("Host")
            given = path.partition("?")[0].strip("/").encode(errors="replace")
            if len(hosts) != 1 or not is_known_host(hosts[0], host, allowed):
                response = connection.respond(HTTPStatus.FORBIDDEN, WRONG_HOST)
            elif not hmac.compare_digest(given, token.encode()):
                response = connection.respond(HTTPStatus.FORBIDDEN, WRONG_TOKEN)
            elif "Upgrade" in request.headers:
                if len(connection.server.connections) < MAX_BROWSERS:
                    return None
                response = connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "Too many browsers.\n")
            elif path != f"/{token}/":  # viser's page obeys queries: one makes it connect to another server
                response = connection.respond(HTTPStatus.FOUND, "")
                response.headers["Location"] = f"/{token}/"
            else:
                response = process_request(connection, replace(request, path="/"))
            response.headers.update(HEADERS)
            return response

        connection = partial(_LimitedConnection, accepts=accepts)
        guarded = {"process_request": answer, "create_connection": connection, "max_size": MAX_MESSAGE_BYTES}
        return original(*args, **options | guarded)

    web_server.serve = serve
    try:
        yield
    finally:
        web_server.serve = original
    if not used:
        raise RuntimeError("viser starts its web server in another way than the viewer's access control expects")


BRUSH_NODE = "/brush"
"""The only object of the scene that browsers can drag: see `mask_editor`."""
LARGEST_CANVAS = 100_000
"""Largest side of a canvas, px."""


def are_numbers(values: Any, count: int, largest: float) -> bool:
    """Whether `values` are `count` finite numbers of absolute value at most `largest`."""
    if not isinstance(values, list | tuple) or len(values) != count:
        return False
    return all(type(v) in (int, float) and -largest <= v <= largest for v in values)


_is_place = partial(are_numbers, count=3, largest=FARTHEST_MM)
_is_on_screen = partial(are_numbers, count=2, largest=1e3)
KINDS = ("ViewerCameraMessage", "ScenePointerMessage", "SceneNodeDragMessage")
FIELDS: dict[str, Callable[[Any], bool]] = {
    "wxyz": lambda value: are_numbers(value, 4, 1e3) and math.hypot(*value) > 1e-6,
    **dict.fromkeys(("position", "look_at", "up_direction"), _is_place),
    **dict.fromkeys(("ray_origin", "ray_direction", "start_position", "end_position"), _is_place),
    "fov": lambda value: are_numbers([value], 1, 4),
    **dict.fromkeys(
        ("image_width", "image_height"), lambda value: are_numbers([value], 1, LARGEST_CANVAS) and value >= 0
    ),
    "event_type": lambda value: value == "click",
    "screen_pos": lambda value: isinstance(value, list | tuple) and len(value) == 1 and _is_on_screen(value[0]),
    **dict.fromkeys(("start_screen_pos", "end_screen_pos"), _is_on_screen),
    "phase": lambda value: value in ("start", "update", "end"),
    "button": lambda value: value == "left",
    "name": lambda value: value == BRUSH_NODE,
    "owner": lambda value: value == "",
    "instance_index": lambda value: value is None,
    "modifier": lambda value: value is None or isinstance(value, str),
}
"""For the fields of messages of these kinds, whether they can have a value. viser rejects a message without one."""


def is_valid_message(message: Any, accepts: Accepts) -> bool:
    """Whether the viewer's own page could have sent this decoded message: one of `KINDS`, or a value of a control."""
    if not isinstance(message, dict):
        return False
    if message.get("type") == "GuiUpdateMessage":
        match message.get("updates"):
            case {"value": value, **others} if not others:  # viser would set any other attribute too: callbacks ...
                return accepts(str(message.get("uuid")), value)
        return False
    rules = ((rule, message[name]) for name, rule in FIELDS.items() if name in message)
    return message.get("type") in KINDS and all(rule(value) for rule, value in rules)
