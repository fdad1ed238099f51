"""Paint instruments that never were into a frame: examples from which a network learns what tools look like.

An instrument enters from the border of the view: a shaft with the shading of a cylinder, a wrist of mottled metal, and
none, one or two jaws, with or without a window. Materials are steel, black and gray plastic, and colored parts. Metal
takes part of its color from the tissue around it, as mirrors do. Some instruments throw a shadow or are blurred by
their motion. All numbers are ranges: nothing here is fitted to a real instrument.

`h, w` image size. Lengths are in px of an image whose longer side is 192 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

WIDTH_PX = (5.0, 57.0)
"""Width of a shaft, drawn evenly in its logarithm."""
REACH = (0.08, 0.5)
"""Length in the view, as a share of the image's diagonal."""
PARTS = ((0.75, 0.6, 0.25), (0.2, 0.35, 0.7), (0.8, 0.8, 0.75), (0.3, 0.55, 0.35))
"""RGB of colored parts: gold, blue, ivory, green."""
Color = NDArray[np.float32]


@dataclass(frozen=True)
class _Canvas:
    """Where parts are painted."""

    x: NDArray[np.float32]
    """(h, w) px."""
    y: NDArray[np.float32]
    """(h, w) px."""
    around: NDArray[np.float32]
    """(h, w, 3) color of the tissue around, which metal mirrors."""
    fine: NDArray[np.float32]
    """(h, w) noise of standard deviation about 1 with spots of 3 px."""
    coarse: NDArray[np.float32]
    """(h, w) noise with spots of 8 px."""
    image: NDArray[np.float32]
    """(h, w, 3) color of the instrument; written."""
    covered: NDArray[np.bool_]
    """(h, w) where the instrument hides the tissue; written."""
    outline: NDArray[np.bool_]
    """(h, w) the instrument with its windows; written."""


@dataclass(frozen=True)
class _Look:
    """What all parts of one instrument share."""

    width: float
    """Of the shaft, px."""
    brightness: float
    mirror: float
    """Share of the color that comes from the tissue around, 0..1."""
    highlight: float
    """Brightness of the highlights."""


def paint_tool(
    rng: Generator, rgb: NDArray[np.float32], view: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Paint one instrument.

    Args:
        rgb: (h, w, 3), where 1 is the clip's white.
        view: (h, w) True inside the endoscope's image; not empty.
    Returns:
        (h, w, 3) the frame with the instrument; (h, w) True on the instrument and in its windows.
    """
    h, w = view.shape
    y, x = np.mgrid[:h, :w].astype(np.float32)
    start, along = _entry(rng, view)
    width = float(np.exp(rng.uniform(*np.log(WIDTH_PX))))
    look = _Look(width, rng.uniform(0.5, 1.6), rng.uniform(0, 0.35), rng.uniform(0.1, 1.2))
    around = cv2.GaussianBlur(rgb, (0, 0), 12)
    empty = np.zeros((h, w), bool)
    noise = _noise(rng, h, w, 3), _noise(rng, h, w, 8)
    canvas = _Canvas(x, y, around, *noise, np.zeros_like(rgb), empty, empty.copy())

    jaw, wrist = rng.uniform(0.6, 3.0) * width, rng.uniform(0, 1.6) * width
    shaft = max(rng.uniform(*REACH) * float(np.hypot(h, w)) - jaw - wrist, 0.0) + 10
    _paint_part(rng, canvas, look, start, along, shaft, (width, width), _material(rng), rng.choice([0.0, 0.2]))
    end = start + along * shaft
    along = _turned(along, rng.normal(0, 0.35))
    if wrist > 2:
        ends = (width * rng.uniform(0.7, 1.0), width * rng.uniform(0.6, 1.05))
        _paint_part(rng, canvas, look, end, along, wrist, ends, _material(rng), rng.uniform(0.3, 1))
        end = end + along * wrist * 0.95
    steel, window = np.full(3, rng.uniform(0.2, 0.8), np.float32), rng.random() < 0.4
    opening = rng.uniform(0, 0.3)
    for side in ((), (0,), (-1, 1))[rng.choice(3, p=[0.12, 0.33, 0.55])]:
        ends = (width * rng.uniform(0.3, 0.75), width * rng.uniform(0.12, 0.5))
        toward = _turned(along, side * opening + rng.normal(0, 0.05))
        _paint_part(rng, canvas, look, end, toward, jaw, ends, steel, rng.uniform(0.2, 1), window, rng.normal(0, 0.12))
    return _blend(rng, rgb, view, canvas)


def _entry(rng: Generator, view: NDArray[np.bool_]) -> tuple[Color, Color]:
    """A point a little outside the border of the view, and a direction (unit vector) into the view."""
    inner = cv2.erode(np.pad(view, 1).astype(np.uint8), np.ones((3, 3), np.uint8))[1:-1, 1:-1] > 0
    ys, xs = np.nonzero(view & ~inner)
    k = rng.integers(len(ys))
    border = np.array([xs[k], ys[k]], np.float32)
    center = np.array([float(np.mean(index)) for index in reversed(np.nonzero(view))])
    along = center + rng.normal(0, 0.3, 2) * view.shape[::-1] - border
    along = (along / (np.hypot(*along) + 1e-6)).astype(np.float32)
    return border - along * 10, along


def _material(rng: Generator) -> Color:
    """RGB: steel, black, gray, or a colored part."""
    kind = rng.choice(4, p=[0.45, 0.25, 0.2, 0.1])
    if kind == 3:
        return np.array(PARTS[rng.integers(len(PARTS))], np.float32) * np.float32(rng.uniform(0.5, 1.1))
    return np.full(3, rng.uniform(*((0.25, 0.8), (0.02, 0.15), (0.15, 0.4))[kind]), np.float32)


def _paint_part(
    rng: Generator,
    canvas: _Canvas,
    look: _Look,
    start: Color,
    along: Color,
    length: float,
    ends: tuple[float, float],
    material: Color,
    roughness: float,
    window: bool = False,
    bend: float = 0.0,
) -> None:
    """Paint a rod from `start` in the direction `along`, with widths `ends` px, a round tip, and the light of a rod."""
    dx, dy = canvas.x - start[0], canvas.y - start[1]
    ahead = dx * along[0] + dy * along[1]
    aside = dy * along[0] - dx * along[1] - np.float32(bend / max(length, 1)) * ahead * ahead
    half = (ends[0] + (ends[1] - ends[0]) * np.clip(ahead / max(length, 1), 0, 1)) / 2
    across = aside / np.maximum(half, 0.5)
    inside = (ahead >= -1) & (ahead <= length) & (np.abs(across) <= 1)
    inside |= (ahead > length) & ((ahead - length) ** 2 + aside**2 < (ends[1] / 2) ** 2)
    light = 0.35 + 0.65 * np.sqrt(np.clip(1 - across**2, 0, 1))
    highlight = np.exp(-(((across - rng.uniform(-0.6, 0.6)) / rng.uniform(0.05, 0.25)) ** 2))
    if roughness:  # facets that mirror the lamp, or darkness
        facets = canvas.fine + 0.5 * canvas.coarse > rng.uniform(0.2, 1.2)
        highlight = 0.5 * highlight + facets * rng.uniform(0.3, 1) * roughness
        light = light * (1 + 0.45 * roughness * np.clip(canvas.fine, -1.5, 1.5))
    color = material * look.brightness * np.clip(light, 0.05, 2)[..., None] + look.highlight * highlight[..., None]
    color = (1 - look.mirror) * color + 1.2 * look.mirror * canvas.around * np.clip(light, 0.1, 2)[..., None]
    if rng.random() < 0.4:  # rings
        period = rng.uniform(0.3, 2) * look.width
        ring = ahead % period < period * rng.uniform(0.05, 0.3)
        color = np.where(ring[..., None], color * rng.uniform(0.3, 1.6), color)
    canvas.outline[inside] = True
    if window:
        inside &= ~((np.abs(across) < rng.uniform(0.25, 0.6)) & (ahead > 0.15 * length) & (ahead < 0.9 * length))
    canvas.image[inside] = color[inside]
    canvas.covered[inside] = True


def _blend(
    rng: Generator, rgb: NDArray[np.float32], view: NDArray[np.bool_], canvas: _Canvas
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Put the instrument over the frame: its shadow, the blur of lens and motion."""
    share, image, outline = canvas.covered.astype(np.float32), canvas.image, canvas.outline.astype(np.float32)
    if rng.random() < 0.4:
        shadow = np.roll(share, rng.integers(-6, 7, 2), (0, 1))
        rgb = rgb * (1 - rng.uniform(0.2, 0.6) * cv2.GaussianBlur(shadow, (0, 0), 3))[..., None]
    sharpness = rng.uniform(0.3, 1.2)
    share, image = (cv2.GaussianBlur(part, (0, 0), sharpness) for part in (share, image))  # image: times its share
    if rng.random() < 0.15:
        size = int(rng.integers(3, 11))
        path = np.zeros((size, size), np.float32)
        cv2.line(path, (0, int(rng.integers(size))), (size - 1, int(rng.integers(size))), 1.0)
        share, image, outline = (cv2.filter2D(part, -1, path / path.sum()) for part in (share, image, outline))
    painted = rgb * (1 - share[..., None]) + np.clip(image, 0, 1.1)
    return (np.clip(painted, 0, 1.15) * view[..., None]).astype(np.float32), (outline > 0.5) & view


def _noise(rng: Generator, h: int, w: int, spot_px: int) -> NDArray[np.float32]:
    coarse = rng.standard_normal((h // spot_px + 2, w // spot_px + 2)).astype(np.float32)
    return cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)


def _turned(along: Color, angle: float) -> Color:
    """The direction turned by `angle`, rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([cos * along[0] - sin * along[1], sin * along[0] + cos * along[1]], np.float32)
