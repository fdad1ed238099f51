"""The messages that the viewer accepts from a browser. viser trusts every message: one could set any attribute of a
control, or store parts of an upload that was not requested.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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


def _is_place(value: Any) -> bool:
    return are_numbers(value, 3, FARTHEST_MM)


def _is_on_screen(value: Any) -> bool:
    return are_numbers(value, 2, 1e3)


def _is_side(value: Any) -> bool:
    return are_numbers([value], 1, LARGEST_CANVAS) and value >= 0


def _is_modifier(value: Any) -> bool:
    return value is None or isinstance(value, str)


FIELDS: dict[str, dict[str, Callable[[Any], bool]]] = {
    "ViewerCameraMessage": {
        "wxyz": lambda value: are_numbers(value, 4, 1e3) and math.hypot(*value) > 1e-6,
        **dict.fromkeys(("position", "look_at", "up_direction"), _is_place),
        "fov": lambda value: are_numbers([value], 1, 4),
        **dict.fromkeys(("image_width", "image_height"), _is_side),
    },
    "ScenePointerMessage": {
        "event_type": lambda value: value == "click",
        "screen_pos": lambda value: isinstance(value, list | tuple) and len(value) == 1 and _is_on_screen(value[0]),
        **dict.fromkeys(("ray_origin", "ray_direction"), _is_place),
        "modifier": _is_modifier,
    },
    "SceneNodeDragMessage": {
        "phase": lambda value: value in ("start", "update", "end"),
        "button": lambda value: value == "left",
        "name": lambda value: value == BRUSH_NODE,
        "owner": lambda value: value == "",
        "instance_index": lambda value: value is None,
        **dict.fromkeys(("start_screen_pos", "end_screen_pos"), _is_on_screen),
        **dict.fromkeys(("start_position", "end_position"), _is_place),
        "modifier": _is_modifier,
    },
}
"""For each accepted type of message, whether a field can have a value; `GuiUpdateMessage` is the fourth type."""


def is_valid_message(message: Any, accepts: Callable[[str, Any], bool]) -> bool:
    """Whether the viewer's own page could have sent this decoded message.

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
    rules = FIELDS.get(str(message.get("type")), {})
    return bool(rules) and all(name in message and rule(message[name]) for name, rule in rules.items())
