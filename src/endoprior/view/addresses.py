"""Addresses: where the viewer listens, and which host names in the address of a page mean this machine."""

from __future__ import annotations

import errno
import ipaddress
import re
import socket
from collections.abc import Collection, Iterable
from contextlib import suppress
from functools import cache
from urllib.parse import urlsplit

from ..core.checks import input_error

HOST_NAME = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?")
Names = Collection[str]


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
