"""Paint what a flexible scope carries or leaves: its cap, catheters, snares, clips.

`h, w` image size. Colors in [0, 1], sRGB. Lengths in px of an image whose longer side is 256 px.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from .foreign_bodies import painted_line
from .instruments import end_of, entry, turned
from .noise import Field, log_uniform, smooth_field
from .parts import Canvas, Part, Point, canvas_over, coated, paint, steel, tip_material, vivid


def cap(rng: Generator, tissue: Field, view: NDArray[np.bool_]) -> Canvas:
    """The cap at the end of a scope: a wall along the border, all around or on one side, that tissue is seen through.

    Inside of its bright rim everything is tissue; the wall bends and mirrors what is behind it, and veils it.
    """
    h, w = view.shape
    y, x = np.mgrid[:h, :w].astype(np.float32)
    middle, radius = _opening(rng, (h, w))
    dx, dy = x - middle[0], y - middle[1]
    distance = np.hypot(dx, dy) + 1e-3
    depth = distance - radius * (1 + 0.01 * smooth_field(rng, (h, w), 40))
    around = np.arctan2(dy, dx)
    color = _through_wall(rng, tissue, middle, dx, dy, depth / distance)
    streaks = _around(rng, around, 30) * np.exp(-np.abs(depth - rng.uniform(0, 25)) / log_uniform(rng, 4, 25))
    color = color + (np.float32(rng.uniform(0, 0.25)) * np.clip(streaks, -0.5, 2))[..., None]
    for at in (0.0, *rng.uniform(3, 40, rng.integers(0, 3))):  # rims: a lit edge, dark beside it
        width = log_uniform(rng, 0.7, 3)
        lit = np.exp(-(((depth - at - width) / width) ** 2)) * np.clip(0.5 + 0.5 * _around(rng, around, 12), 0.05, 2)
        dark = np.exp(-(((depth - at - 3 * width) / width) ** 2))
        color = color * (1 - rng.uniform(0, 0.5) * dark)[..., None] + (rng.uniform(0.05, 0.7) * lit)[..., None]
    canvas = canvas_over(tissue, np.ones((h, w), np.float32))
    covered = np.clip(0.5 + depth, 0, 1).astype(np.float32)
    canvas.color[:], canvas.covered[:], canvas.outline[:] = np.clip(color, 0, 1.5), covered, covered
    return canvas


def _opening(rng: Generator, size: tuple[int, int]) -> tuple[Point, float]:
    """Middle and radius of the opening of a cap: its wall is 3 to 25 % of the image's height on the side it is on."""
    h, w = size
    middle, half = np.array([w / 2, h / 2]), np.array([w / 2, h / 2])
    if rng.random() < 0.3:
        return middle + rng.normal(0, 0.04, 2) * w, rng.uniform(0.42, 0.6) * w
    radius = log_uniform(rng, 0.4, 1.5) * w
    angle = rng.choice([0.5, 1.5]) * np.pi + rng.normal(0, 0.4) if rng.random() < 0.7 else rng.uniform(0, 2 * np.pi)
    side = np.array([np.cos(angle), np.sin(angle)])
    reach = float(np.min(half / np.maximum(np.abs(side), 1e-3)))
    return middle + side * (reach - rng.uniform(0.03, 0.25) * h - radius), radius


def _through_wall(rng: Generator, tissue: Field, middle: Point, dx: Field, dy: Field, off: Field) -> Field:
    """(h, w, 3) tissue as the wall of a cap shows it: bent or mirrored at its rim, soft, veiled; seldom opaque.

    `dx`, `dy` are px from the middle of the opening; `off` is the distance from the rim as a share of theirs.
    """
    pulled = 1 - off * np.float32(rng.uniform(1.2, 2.2) if rng.random() < 0.4 else rng.uniform(-0.4, 0.9))
    bent = smooth_field(rng, dx.shape, 25) * np.float32(rng.uniform(0, 4))
    color = cv2.remap(
        tissue,
        (middle[0] + dx * pulled + bent).astype(np.float32),
        (middle[1] + dy * pulled + bent).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    color = cv2.GaussianBlur(color, (0, 0), log_uniform(rng, 0.4, 5))
    veil = rng.uniform(0.05, 0.5) if rng.random() < 0.85 else rng.uniform(0.5, 0.95)
    tone = np.array([rng.uniform(0.7, 1.05), 1, rng.uniform(0.9, 1.2)]) * log_uniform(rng, 0.1, 0.8)
    uneven = np.clip(1 + 0.4 * smooth_field(rng, dx.shape, 50), 0.2, 2)
    return color * rng.uniform(0.6, 1.15) * (1 - veil) + veil * (tone * uneven[..., None])


def _around(rng: Generator, angle: Field, knots: int) -> Field:
    """(h, w) noise of mean 0 that depends on the `angle` (h, w), rad, alone."""
    values = rng.standard_normal(knots)
    turns = np.linspace(-np.pi, np.pi, knots + 1)
    return np.interp(angle, turns, np.append(values, values[0])).astype(np.float32)


def catheter(rng: Generator, tissue: Field, view: NDArray[np.bool_]) -> Canvas:
    """A thin bent tube of any hue, often with marks, from the border: open, or with a tip, a snare or wires."""
    h, w = view.shape
    canvas = canvas_over(tissue, np.full((h, w), log_uniform(rng, 0.5, 1.6), np.float32))
    start, along = entry(rng, view)
    width, length = log_uniform(rng, 3, 22), rng.uniform(0.15, 0.9) * float(np.hypot(h, w))
    first = vivid(rng)
    marks = rng.uniform(0.2, 0.95, rng.integers(0, 5))
    bands = tuple((at, at + rng.uniform(0.02, 0.08), vivid(rng) if rng.random() < 0.5 else first) for at in marks)
    if rng.random() < 0.5:  # a tip of another kind
        bands += ((1 - rng.uniform(0.04, 0.2), 1.01, tip_material(rng)),)
    bend, rounded = rng.normal(0, 0.2), bool(rng.random() < 0.5)
    widths = (width * rng.uniform(1, 1.5), width)
    tube = Part(start - along * width, along, length, widths, first, 0, bend, rounded, bands=bands)
    along = turned(along, 2 * bend)
    if rng.random() < 0.45:
        for points in _wires(rng, end_of(tube), along, width):
            tone = np.full(3, rng.uniform(0.3, 1)) * np.array([1, rng.uniform(0.8, 1), rng.uniform(0.6, 1.1)])
            painted_line(canvas, points, rng.uniform(1.2, 3), tone.astype(np.float32), rng)
    paint(rng, canvas, tube)
    return canvas


def _wires(rng: Generator, end: Point, along: Point, width: float) -> list[NDArray]:
    """Points (n, 2) of a snare's loop, a basket's wires or a guide wire out of a tube that ends at `end`."""
    t = np.linspace(0, 1, 40)[:, None]
    across, length = turned(along, np.pi / 2), width * log_uniform(rng, 1.5, 8)
    kind = rng.choice(3, p=[0.55, 0.2, 0.25])
    if kind == 2:
        sway = np.cumsum(rng.normal(0, 0.02, (40, 1)).cumsum(0), 0)
        return [end + along * t * length * 2 + across * sway * length]
    wide, lean = length * rng.uniform(0.15, 0.5), rng.normal(0, 0.3)
    shape = np.sin(np.pi * t ** rng.uniform(0.7, 1.6)) * wide
    sides = (-1, 1) if kind == 0 else (-1, -0.35, 0.35, 1)
    return [end + along * t * length + across * (side * shape + lean * length * t**2) for side in sides]


def clips(rng: Generator, tissue: Field, view: NDArray[np.bool_]) -> Canvas:
    """One to three small clips that were left on tissue: two arms each, of metal or plastic, side by side."""
    h, w = view.shape
    canvas = canvas_over(tissue, np.full((h, w), log_uniform(rng, 0.6, 1.6), np.float32))
    place = rng.uniform(0.15, 0.85, 2) * (w, h)
    angle, length = rng.uniform(0, 2 * np.pi), log_uniform(rng, 8, 30)
    material = (steel, lambda r: coated(r, 0.6, 1), vivid)[rng.choice(3, p=[0.5, 0.25, 0.25])](rng)
    thin = max(length * rng.uniform(0.12, 0.3), 2.0)
    for i in range(rng.integers(1, 4)):
        along = turned(np.array([1.0, 0.0]), angle + rng.normal(0, 0.15))
        across = turned(along, np.pi / 2)
        at = place + across * i * thin * rng.uniform(2, 4)
        for side in (-0.5, 0.5) if rng.random() < 0.6 else (0,):
            bend, shift = -side * rng.uniform(0, 0.3), across * side * thin * rng.uniform(1, 2)
            paint(rng, canvas, Part(at + shift, along, length, (thin * 1.2, thin), material, rng.uniform(0, 0.8), bend))
    return canvas
