"""The messages that the viewer accepts from a browser. viser trusts every message: one could set any attribute of a
control, or store parts of an upload that was not requested.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from ..core.geometry import FARTHEST_MM

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
    "fov": lambda value: are_numbers([value], 1, 4),
    **dict.fromkeys(
        ("image_width", "image_height"), lambda value: are_numbers([value], 1, LARGEST_CANVAS) and value >= 0
    ),
    "event_type": lambda value: value == "click",
    "screen_pos": lambda value: isinstance(value, list | tuple) and len(value) == 1 and _is_on_screen(value[0]),
    **dict.fromkeys(("ray_origin", "ray_direction", "start_position", "end_position"), _is_place),
    **dict.fromkeys(("start_screen_pos", "end_screen_pos"), _is_on_screen),
    "phase": lambda value: value in ("start", "update", "end"),
    "button": lambda value: value == "left",
    "name": lambda value: value == BRUSH_NODE,
    "owner": lambda value: value == "",
    "instance_index": lambda value: value is None,
    "modifier": lambda value: value is None or isinstance(value, str),
}
"""For the fields of messages of these kinds, whether they can have a value. viser rejects a message without one."""


def is_valid_message(message: Any, accepts: Callable[[str, Any], bool]) -> bool:
    """Whether the viewer's own page could have sent this decoded message: one of `KINDS`, or a value of a control.

    Args:
        accepts: whether the control with this id can have this value.
    """
    if not isinstance(message, dict):
        return False
    if message.get("type") == "GuiUpdateMessage":
        updates = message.get("updates")
        # viser would set any other attribute too, such as callbacks or visibility.
        named = isinstance(updates, dict) and updates.keys() == {"value"}
        return named and accepts(str(message.get("uuid")), updates["value"])
    rules = ((rule, message[name]) for name, rule in FIELDS.items() if name in message)
    return message.get("type") in KINDS and all(rule(value) for rule, value in rules)
