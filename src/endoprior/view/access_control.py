"""Access control of the viewer: which connections it accepts, and which messages are valid.

Any program on this machine can connect, and viser trusts every message: a message could set any attribute of a control,
or store parts of an upload that was not requested.
"""

from __future__ import annotations

import errno
import math
import socket
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

from ..core.checks import input_error
from ..core.geometry import FARTHEST_MM

LOOPBACK = ("127.0.0.1", "localhost", "::1")
MAX_MESSAGE_BYTES = 2**16
"""Largest message of a browser, bytes; normal messages have a few hundred."""
MAX_BROWSERS = 32
"""Largest number of simultaneous connections."""
MAX_PER_SECOND = 500
"""Largest message rate of one connection; dragging sends one per screen refresh."""
BRUSH_NODE = "/brush"
"""The only object of the scene that browsers can drag: see `mask_editor`."""
LARGEST_CANVAS = 100_000
"""Largest side of a canvas, px."""


def check_address(host: str, port: int) -> None:
    """Check that the address is free; viser would silently use another port, or wait.

    Raises:
        InputError: the address cannot be used.
    """
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


def is_trusted(origin: str | None, asked_host: str | None, bound_host: str) -> bool:
    """Whether to accept a connection.

    A page of another site, open in the same browser, can connect to 127.0.0.1 too; it must not see the scene.

    Args:
        origin: the `Origin` header: the page that connects. Programs other than browsers send none.
        asked_host: the `Host` header: the server name that the client uses.
        bound_host: the address the viewer listens on.
    """
    if origin is None:
        return True
    try:
        same, name = urlsplit(origin).netloc == asked_host, urlsplit(f"//{asked_host}").hostname
    except ValueError:
        return False
    # Reject other names that resolve to this machine (DNS rebinding).
    return same and (name in LOOPBACK if bound_host in LOOPBACK else True)


class RateLimit:
    """Message rate of one connection."""

    def __init__(self) -> None:
        self._since, self._count = 0.0, 0

    def exceeded(self, now: float) -> bool:
        """Count a message received at `now`, s; whether there are more than `MAX_PER_SECOND` in this second."""
        if now - self._since >= 1:
            self._since, self._count = now, 0
        self._count += 1
        return self._count > MAX_PER_SECOND


def is_valid_message(kind: str, message: Mapping[str, Any], accepts: Callable[[str, Any], bool]) -> bool:
    """Whether the viewer's own page could have sent this message.

    Args:
        kind: name of the message type.
        message: its fields.
        accepts: whether the control with this id can have this value.
    """
    if kind == "ViewerCameraMessage":
        return is_camera(message) and _is_canvas(message)
    if kind == "ScenePointerMessage":
        return _is_click(message)
    if kind == "SceneNodeDragMessage":
        return _is_drag(message)
    if kind == "GuiUpdateMessage":
        updates, uuid = message["updates"], message["uuid"]
        # viser would set any other attribute too, such as callbacks or visibility.
        return isinstance(updates, dict) and updates.keys() == {"value"} and accepts(str(uuid), updates["value"])
    return False


def is_camera(fields: Mapping[str, Any]) -> bool:
    """Whether `wxyz`, `position`, `look_at`, `up_direction` and `fov` describe a camera near the tissue."""
    places = (fields["position"], fields["look_at"], fields["up_direction"])
    turned = are_numbers(fields["wxyz"], 4, 1e3) and math.hypot(*fields["wxyz"]) > 1e-6
    return turned and all(are_numbers(place, 3, FARTHEST_MM) for place in places) and are_numbers([fields["fov"]], 1, 4)


def are_numbers(values: Any, count: int, largest: float) -> bool:
    """Whether `values` are `count` finite numbers of absolute value at most `largest`."""
    if not isinstance(values, list | tuple) or len(values) != count:
        return False
    return all(type(v) in (int, float) and -largest <= v <= largest for v in values)


def _is_canvas(fields: Mapping[str, Any]) -> bool:
    sides = [fields["image_width"], fields["image_height"]]
    return are_numbers(sides, 2, LARGEST_CANVAS) and min(sides) >= 0


def _is_click(fields: Mapping[str, Any]) -> bool:
    places, ray = fields["screen_pos"], (fields["ray_origin"], fields["ray_direction"])
    clicked = fields["event_type"] == "click" and isinstance(places, list | tuple) and len(places) == 1
    known = _is_modifier(fields["modifier"])
    return clicked and known and are_numbers(places[0], 2, 1e3) and all(are_numbers(v, 3, FARTHEST_MM) for v in ray)


def _is_drag(fields: Mapping[str, Any]) -> bool:
    places = fields["start_screen_pos"], fields["end_screen_pos"]
    points = fields["start_position"], fields["end_position"]
    known = fields["phase"] in ("start", "update", "end") and fields["button"] == "left"
    known = known and fields["name"] == BRUSH_NODE and fields["owner"] == "" and fields["instance_index"] is None
    finite = all(are_numbers(v, 2, 1e3) for v in places) and all(are_numbers(v, 3, FARTHEST_MM) for v in points)
    return known and finite and _is_modifier(fields["modifier"])


def _is_modifier(value: Any) -> bool:
    return value is None or isinstance(value, str)
