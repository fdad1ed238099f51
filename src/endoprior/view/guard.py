"""Who may talk to the viewer, and what may be said: its own pages, and messages that make sense.

Any program of this machine can connect, and the library behind the page takes what it is sent at its word: it would set
any attribute of a control, or keep the parts of an upload that nobody asked for.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

from ..core.checks import InputError
from ..core.geometry import FARTHEST_MM

LOOPBACK = ("127.0.0.1", "localhost", "::1")
LARGEST_MESSAGE = 2**16
"""Bytes a browser may send at once; what it does send has some hundreds."""
MOST_BROWSERS = 32
"""Connections at a time."""
MOST_PER_SECOND = 500
"""Messages of one connection; dragging sends as many as the screen draws pictures."""
LARGEST_CANVAS = 100_000
"""Pixels along a side."""


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
    try:
        same, name = urlsplit(origin).netloc == asked_host, urlsplit(f"//{asked_host}").hostname
    except ValueError:
        return False
    # A foreign name that was made to point at this machine is not us either.
    return same and (name in LOOPBACK if bound_host in LOOPBACK else True)


class Pace:
    """How much one connection says."""

    def __init__(self) -> None:
        self._since, self._said = 0.0, 0

    def exceeded(self, now: float) -> bool:
        """Count a message that came at `now`, s; whether that makes more than `MOST_PER_SECOND` in this second."""
        if now - self._since >= 1:
            self._since, self._said = now, 0
        self._said += 1
        return self._said > MOST_PER_SECOND


def sensible(kind: str, message: Mapping[str, Any], accepts: Callable[[str, Any], bool]) -> bool:
    """Whether a browser that shows the viewer's page could have sent this.

    Args:
        kind: name of the message's type.
        message: its fields.
        accepts: whether the control of this id can have this value.
    """
    if kind == "ViewerCameraMessage":
        return is_camera(message) and _is_canvas(message)
    if kind == "ScenePointerMessage":
        return _is_click(message)
    if kind == "GuiUpdateMessage":
        updates, uuid = message["updates"], message["uuid"]
        # Anything else in there would be set as well: what listens to the control, whether it is there at all.
        return isinstance(updates, dict) and updates.keys() == {"value"} and accepts(str(uuid), updates["value"])
    return False


def is_camera(fields: Mapping[str, Any]) -> bool:
    """Whether `wxyz`, `position`, `look_at`, `up_direction` and `fov` describe a camera near the tissue."""
    places = (fields["position"], fields["look_at"], fields["up_direction"])
    turned = are_numbers(fields["wxyz"], 4, 1e3) and math.hypot(*fields["wxyz"]) > 1e-6
    return turned and all(are_numbers(place, 3, FARTHEST_MM) for place in places) and are_numbers([fields["fov"]], 1, 4)


def are_numbers(values: Any, count: int, largest: float) -> bool:
    """Whether these are `count` finite numbers, none beyond `largest` on either side of 0."""
    if not isinstance(values, list | tuple) or len(values) != count:
        return False
    return all(type(v) in (int, float) and -largest <= v <= largest for v in values)


def _is_canvas(fields: Mapping[str, Any]) -> bool:
    sides = [fields["image_width"], fields["image_height"]]
    return are_numbers(sides, 2, LARGEST_CANVAS) and min(sides) >= 0


def _is_click(fields: Mapping[str, Any]) -> bool:
    places, ray = fields["screen_pos"], (fields["ray_origin"], fields["ray_direction"])
    clicked = fields["event_type"] == "click" and isinstance(places, list | tuple) and len(places) == 1
    known = fields["modifier"] is None or isinstance(fields["modifier"], str)
    return clicked and known and are_numbers(places[0], 2, 1e3) and all(are_numbers(v, 3, FARTHEST_MM) for v in ray)
