"""What browsers send and ask for, within limits: a rate, a bounded job queue, and messages of the viewer's own page.

viser trusts every message: one could set any attribute of a control, or store parts of an upload that was not
requested.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

from ..core.geometry import FARTHEST_MM

MAX_WAITING = 200
"""Largest number of waiting jobs; a person never reaches it."""
BRUSH_NODE = "/brush"
"""The only object of the scene that browsers can drag: see `mask_editor`."""
MAX_CANVAS = 100_000
"""Largest side of a canvas, px."""
Job = Callable[[], object]
Accepts = Callable[[str, Any], bool]
"""Whether the control with this id can have this value."""


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
    **dict.fromkeys(("image_width", "image_height"), lambda value: are_numbers([value], 1, MAX_CANVAS) and value >= 0),
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
