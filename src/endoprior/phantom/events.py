"""What disturbs a video for a while: blur, an overexposed image, a look outside of the body, a cut. Frames from 0."""

from __future__ import annotations

import re
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error

KINDS = ("blur", "white-out", "out-of-body", "cut")
FORM = re.compile(r"([a-z-]+):(\d+)(?:-(\d+))?")
BLUR_SHARE = 0.02  # standard deviation of the blur, image widths
ROOM, CLOTHS = (150, 165, 170), ((60, 120, 110), (200, 205, 210), (90, 110, 130), (30, 60, 70))
"""Colors of a room and of what is in it."""


@dataclass(frozen=True)
class Event:
    """One disturbance."""

    kind: str
    first: int  # frame; of a cut the first one of the other view
    last: int  # frame, included


def parse_events(text: str, frames: int) -> tuple[Event, ...]:
    """The events of `blur:10-14,cut:50`; a cut lasts to the end. InputError for another form, or other frames."""
    found = []
    for part in filter(None, text.split(",")):
        match = FORM.fullmatch(part)
        kind, first, last = match.groups() if match else ("", "0", None)
        span = int(first), frames - 1 if kind == "cut" else int(last or first)
        if kind not in KINDS or not 0 <= span[0] <= span[1] < frames:
            want = f"KIND:FIRST-LAST with a kind of {', '.join(KINDS)}, and frames in 0..{frames - 1}"
            raise input_error("--events", want, repr(part), "`--events blur:10-14,cut:30`.")
        found.append(Event(kind, *span))
    return tuple(found)


def is_mirrored(events: tuple[Event, ...], index: int) -> bool:
    """Whether a frame lies behind a cut: it is upside down and mirrored in one, which no motion of a camera does."""
    return sum(event.kind == "cut" and event.first <= index for event in events) % 2 == 1


def shows_body(events: tuple[Event, ...], index: int) -> bool:
    """Whether the camera is in the body."""
    return not any(event.kind == "out-of-body" and event.first <= index <= event.last for event in events)


def disturbed(image: NDArray[np.uint8], events: tuple[Event, ...], index: int, seed: int) -> NDArray[np.uint8]:
    """The image (H, W, 3) of a frame as the camera gives it."""
    width = image.shape[1]
    for event in events:
        if not event.first <= index <= event.last:
            continue
        if event.kind == "blur":
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR_SHARE * width), np.uint8)
        elif event.kind == "white-out":
            image = (235 + image // 13).clip(248, 255).astype(np.uint8)
        elif event.kind == "out-of-body":
            image = _room(image.shape[:2], index - event.first, seed)
    return image


def _room(size: tuple[int, int], step: int, seed: int) -> NDArray[np.uint8]:
    """A picture (H, W, 3) of a room, through which the camera turns."""
    height, width = size
    rng = np.random.default_rng([seed, 14])
    room = np.full((height, 2 * width, 3), ROOM, np.uint8)
    for _ in range(60):
        x, y, w, h = (rng.uniform(0, share) for share in (2, 1, 0.3, 0.4))
        corner, color = (int(x * width), int(y * height)), CLOTHS[rng.integers(len(CLOTHS))]
        cv2.rectangle(room, corner, (corner[0] + int(w * width), corner[1] + int(h * height)), color, -1)
    left = int(width * (0.5 - 0.5 * np.cos(step / 20)))
    noise = rng.normal(0, 1.5, (height, width, 3))
    return (cv2.GaussianBlur(room[:, left : left + width], (0, 0), 1.0) + noise).clip(0, 255).astype(np.uint8)
