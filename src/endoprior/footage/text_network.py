"""The network that finds text: PP-OCR's mobile text detector, version 3, run by OpenCV. Text is not read.

The network gives each pixel the probability that it lies in the core of a line of text, which is thinner than the line
(differentiable binarization, Liao et al. 2020). A connected core becomes a rectangle, grown to the line's size. One
image has false boxes, on highlights and tools: `footage.texts` confirms boxes over several images.

The weights are a file in the package, checked against its digest; docs/text_network.md says where they come from.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape, shipped_file
from .image_operations import HEIGHT, LEFT, TOP, WIDTH, Image, components

FILE = Path(__file__).with_name("text_network.onnx")
SHA256 = "3439588c030faea393a54515f51e983d8e155b19a2e8aba7891934c1cf0de526"
"""Of the file; a test compares it with the file and with docs/text_network.md."""
LONG_SIDE_PX = 640  # Larger images are shrunk to this longer side: that of a frame. Capitals of 8 px are found
MULTIPLE = 32  # Sides of the network's image are multiples of this, px
CORE = 0.3  # Least probability in the core of a line
MIN_SCORE = 0.6  # Least mean probability of a core
MIN_CORE_PX = 3  # Smallest side of a core, px of the network's image
GROWTH = 1.8
"""A rectangle is its core, grown on each side by this times the core's area over its perimeter. The network was trained
with cores that are shrunk so; 1.6 leaves the rim of some letters."""
MAX_HEIGHT = 0.2  # Largest height of a line, in heights of the image: larger boxes are whole organs


@dataclass(frozen=True)
class TextBox:
    """A rectangle around a line of text, px of the image; it need not be level."""

    score: float  # mean probability of the core, 0 to 1
    x: float  # center
    y: float
    length: float  # longer side
    height: float  # shorter side
    degrees: float  # of the longer side, from the rows of the image, -90 to 90, clockwise

    def corners(self) -> NDArray[np.float32]:
        """(4, 2) x, y of the corners, px."""
        return np.asarray(cv2.boxPoints(self._rectangle()), np.float32)

    def shared(self, other: TextBox) -> float:
        """Area in both boxes, as a share of the smaller one."""
        _, points = cv2.rotatedRectangleIntersection(self._rectangle(), other._rectangle())
        both = 0.0 if points is None else cv2.contourArea(cv2.convexHull(points))
        return both / min(self.length * self.height, other.length * other.height)

    def _rectangle(self) -> tuple[tuple[float, float], tuple[float, float], float]:
        return (self.x, self.y), (self.length, self.height), self.degrees


def box_around(points: NDArray[np.float32], score: float, margin: float = 0.0) -> TextBox:
    """The smallest rectangle around points (n, 2), grown by `margin`, px, on each side."""
    (x, y), (length, height), degrees = cv2.minAreaRect(points)
    if length < height:
        length, height, degrees = height, length, degrees + 90
    turned = (degrees + 90) % 180 - 90
    return TextBox(score, x, y, length + 2 * margin, height + 2 * margin, turned)


class TextDetector:
    """Finds lines of text in single images. One thread uses it at a time."""

    def __init__(self) -> None:
        """Load the weights; InputError if the file is missing or changed."""
        data = shipped_file(FILE, SHA256, "the weights of the text detector")
        self._network = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))

    def find(self, rgb_u8: Image, scale: float = 1.0) -> list[TextBox]:
        """Rectangles around what looks like lines of text in an image (H, W, 3), from top to bottom.

        Args:
            scale: the network sees the image shrunk by it, if `LONG_SIDE_PX` does not ask for less: large text is found
                all the same, and faster.
        """
        check_shape("rgb_u8:H,W,3", rgb_u8=rgb_u8)
        core = self._core(rgb_u8, min(scale, 1.0, LONG_SIDE_PX / max(rgb_u8.shape)))
        enlarge = np.array([rgb_u8.shape[1] / core.shape[1], rgb_u8.shape[0] / core.shape[0]], np.float32)
        regions, places = components(core > CORE)
        found = []
        for number, (left, top, width, height) in enumerate(places[1:, [LEFT, TOP, WIDTH, HEIGHT]].tolist(), 1):
            if min(width, height) < MIN_CORE_PX:
                continue
            part = slice(top, top + height), slice(left, left + width)
            inside = regions[part] == number
            score = float(core[part][inside].mean())
            centers = np.argwhere(inside)[:, ::-1] + np.array([left + 0.5, top + 0.5])
            line = box_around(centers.astype(np.float32), score, 0.5)
            growth = GROWTH * line.length * line.height / (2 * (line.length + line.height))
            box = box_around(box_around(line.corners(), score, growth).corners() * enlarge, score)
            if score >= MIN_SCORE and box.height <= MAX_HEIGHT * rgb_u8.shape[0]:
                found.append(box)
        return sorted(found, key=lambda box: (box.y, box.x))

    def _core(self, rgb_u8: Image, scale: float) -> NDArray[np.float32]:
        """(h, w) probability of a line's core, on the network's image."""
        width, height = (max(MULTIPLE, MULTIPLE * round(scale * side / MULTIPLE)) for side in rgb_u8.shape[1::-1])
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = cv2.resize(rgb_u8, (width, height), interpolation=how)
        blue_first = small[..., ::-1].astype(np.float32) / np.float32(127.5) - 1
        self._network.setInput(np.ascontiguousarray(blue_first.transpose(2, 0, 1)[None]))
        return np.asarray(self._network.forward()[0, 0], np.float32)
