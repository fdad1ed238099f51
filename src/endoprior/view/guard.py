"""Who may talk to the viewer: a port that is free, and pages that came from the viewer itself."""

from __future__ import annotations

import socket
from urllib.parse import urlsplit

from ..checks import InputError

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def check_address(host: str, port: int) -> None:
    """Make sure the address can be listened on; the server itself would search or wait without a word.

    Raises:
        InputError: it cannot.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"--port: expected 0 to 65535; got {port}. Take 0 for any free one.")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(found[0], socket.SOCK_STREAM) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(found[4])
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{host}:{port}: expected a free address; got: {reason}. Try --port 0.") from None


def trusted(origin: str | None, asked_host: str | None, bound_host: str) -> bool:
    """Whether a connection may be served.

    A page of another site that is open in the same browser can connect to 127.0.0.1 too; it must not see the scene.

    Args:
        origin: the `Origin` header: the page that connects; programs that are not browsers send none.
        asked_host: the `Host` header: what the client believes to talk to.
        bound_host: the address the viewer listens on.
    """
    if origin is None:
        return True
    if urlsplit(origin).netloc != asked_host:
        return False
    # A foreign name that was made to point at this machine is not us either.
    name = urlsplit(f"//{asked_host}").hostname
    return name in LOOPBACK if bound_host in LOOPBACK else True
