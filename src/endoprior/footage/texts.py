"""Confirm text over several images of a clip, and follow text that moves.

A box of the text detector (`text_network`) may be a highlight or a slot of a tool. Burnt-in text shows itself in
several images, in one of two ways: it is static, or it moves and keeps its size and stays level, which a tool
does not. Static text may be slanted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_operations import Image, Mask
from .text_network import TextBox

MIN_SEEN = 3  # Images in which a text has to be found
MIN_MEAN_SCORE, RARE, RARE_SCORE = 0.75, 6, 0.9
"""Of the boxes of a static text: least mean score, and that of a text in fewer than `RARE` images. The slots of a
tool that is static for a while have 0.82 in three images."""
MAX_WANDER = 0.08  # Mean distance of the boxes of a static text from their line, in heights: tools have 0.2
MIN_SHOWN_SHARE = 0.25  # Of the images from the first to the last one with a static text: so many show it
SAME_PLACE = 0.7  # Boxes that share so much of the smaller one are at one place
SAME_HEIGHT, SAME_LENGTH = 1.4, 1.25  # Largest ratios of heights, and of lengths, of one text
LEVEL_DEGREES = 4.0  # Text that moves is level up to this
MOVING_SCORE, FOLLOWED_SCORE = 0.9, 0.7  # Least scores of text that moves: to confirm it, and to follow it
MIN_ASPECT = 1.5  # Least length of text that moves, in heights
SURE_SCORE, MAX_SEEN = 0.97, 0.85
"""A text of this mean score that is in fewer than this share of the images from its first to its last one comes and
goes, as labels of a detector do: it is looked for in every frame, like text that moves. Faint text is only missed."""
JUMPS = 2  # In so many images a text has left its place for another one: then it moves
FOLLOWED_HEIGHT_PX = 18.0  # Height of the box of a text that the network follows: a lower one is often missed
Find = Callable[[Image], list[TextBox]]
FindAtScale = Callable[[Image, float], list[TextBox]]


@dataclass
class StaticText:
    """Text at one place. Its boxes lie on one line, and some may show a part of it."""

    seen: list[int] = field(default_factory=list)  # positions of the images that show it, ascending
    members: list[TextBox] = field(default_factory=list)  # the boxes

    @property
    def longest(self) -> TextBox:
        """The longest of the boxes: its direction is surest."""
        return max(self.members, key=lambda box: box.length)

    @property
    def box(self) -> TextBox:
        """From the first to the last letter of any box, and as high as usual."""
        along, across = self._spans()
        length, height = along[:, 1].max() - along[:, 0].min(), float(np.median(across[:, 1] - across[:, 0]))
        middle = (along[:, 1].max() + along[:, 0].min()) / 2, float(np.median(across))
        x, y = np.array(middle) @ _axes(self.longest)
        return TextBox(self._score, float(x), float(y), float(length), height, self.longest.degrees)

    def holds(self, box: TextBox) -> bool:
        """Whether a box lies at this place."""
        return _ratio(self.longest.height, box.height) < SAME_HEIGHT and self.box.shared(box) > SAME_PLACE

    def add(self, image: int, box: TextBox) -> None:
        """Take a box of an image at this position."""
        self.seen += [image] * (self.seen[-1:] != [image])
        self.members.append(box)

    @property
    def confirmed(self) -> bool:
        """Whether it is text rather than something that looks like it at times."""
        span = self.seen[-1] - self.seen[0] + 1
        least = MIN_MEAN_SCORE if len(self.seen) >= RARE else RARE_SCORE
        if len(self.seen) < max(MIN_SEEN, MIN_SHOWN_SHARE * span) or self._score < least:
            return False
        _, across = self._spans()
        return bool(np.abs(across.mean(1) - np.median(across.mean(1))).mean() < MAX_WANDER * self.box.height)

    @property
    def comes_and_goes(self) -> bool:
        """Whether it is surely absent from images between its first and its last one."""
        span = self.seen[-1] - self.seen[0] + 1
        return self._score >= SURE_SCORE and len(self.seen) < MAX_SEEN * span

    @property
    def _score(self) -> float:
        return float(np.mean([box.score for box in self.members]))

    def _spans(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n, 2) first and last px of each box along the line, and (n, 2) across it."""
        corners = np.stack([box.corners() for box in self.members]) @ _axes(self.longest).T
        low, high = corners.min(1), corners.max(1)
        return np.stack([low[:, 0], high[:, 0]], 1), np.stack([low[:, 1], high[:, 1]], 1)


@dataclass(frozen=True)
class Texts:
    """What is confirmed in a clip."""

    static: list[StaticText]  # from top to bottom
    moving: list[TextBox]  # one box of each text that moves: its size


def confirm(found: Sequence[list[TextBox]]) -> Texts:
    """The texts of a clip. Args: found: boxes of images that are spread over it, in order."""
    places: list[StaticText] = []
    for image, box in ((image, box) for image, boxes in enumerate(found) for box in boxes):
        here = next((place for place in places if place.holds(box)), None)
        if here is None:
            places.append(here := StaticText())
        here.add(image, box)
    loose = [(image, box) for image, boxes in enumerate(found) for box in boxes if _may_move(box)]
    static = []
    for place in (place for place in places if place.confirmed):
        elsewhere = {image for image, box in loose if image not in place.seen and _alike(box, place.longest)}
        if len(elsewhere) < JUMPS and not (place.comes_and_goes and _may_move(place.longest)):
            static.append(place)
            loose = [(image, box) for image, box in loose if box not in place.members]
    moving: list[TextBox] = []
    for _, box in loose:
        known = any(_alike(box, other) for other in moving)
        if not known and len({image for image, other in loose if _alike(box, other)}) >= MIN_SEEN:
            moving.append(box)
    return Texts(sorted(static, key=lambda text: (text.box.y, text.box.x)), moving)


def follow(images: Iterable[Image], moving: Sequence[TextBox], find: FindAtScale) -> list[list[TextBox]]:
    """Boxes of texts that move, in each image.

    The images are shrunk until the lowest text is `FOLLOWED_HEIGHT_PX` high. Nothing is carried from one image to the
    next: labels of a detector come and go from frame to frame.

    Args:
        images: (H, W, 3) all images of a clip, in order.
        moving: one box of each text, from `confirm`.
        find: the text detector: image and scale -> boxes.
    """
    scale = FOLLOWED_HEIGHT_PX / min(box.height for box in moving)
    return [[box for box in find(image, scale) if any(_is_followed(box, text) for text in moving)] for image in images]


def text_mask(boxes: Iterable[TextBox], shape: tuple[int, ...]) -> Mask:
    """(H, W) True on boxes."""
    mask = np.zeros(shape[:2], np.uint8)
    for box in boxes:
        cv2.fillConvexPoly(mask, np.round(box.corners() - 0.5).astype(np.int32), 1)
    return mask > 0


def rectangle(box: TextBox, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """x, y, width, height, px, around a box in an image (H, W)."""
    low, high = np.floor(box.corners().min(0)), np.ceil(box.corners().max(0))
    x, y = max(int(low[0]), 0), max(int(low[1]), 0)
    return x, y, min(int(high[0]), shape[1]) - x, min(int(high[1]), shape[0]) - y


def static_rectangles(images: Sequence[Image], find: Find) -> list[tuple[int, int, int, int]]:
    """`rectangle` of every static text in images (H, W, 3) of a clip, from top to bottom."""
    return [rectangle(text.box, images[0].shape) for text in confirm([find(image) for image in images]).static]


def _axes(box: TextBox) -> NDArray[np.float64]:
    """(2, 2) unit vectors along a line of text and across it, as rows."""
    turn = np.radians(box.degrees)
    return np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])


def _may_move(box: TextBox) -> bool:
    return box.score >= MOVING_SCORE and abs(box.degrees) <= LEVEL_DEGREES and box.length >= MIN_ASPECT * box.height


def _alike(box: TextBox, other: TextBox) -> bool:
    return _ratio(box.height, other.height) < SAME_LENGTH and _ratio(box.length, other.length) < SAME_LENGTH


def _is_followed(box: TextBox, text: TextBox) -> bool:
    """Whether a box may be a text that moves; at the edge of the image it is cut."""
    level = abs(box.degrees) <= LEVEL_DEGREES and box.score >= FOLLOWED_SCORE
    return level and _ratio(box.height, text.height) < SAME_HEIGHT and box.length < SAME_LENGTH * text.length


def _ratio(one: float, other: float) -> float:
    return max(one, other) / max(min(one, other), 1e-6)
