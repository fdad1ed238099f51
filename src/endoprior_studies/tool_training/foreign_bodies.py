"""Paint what is no tissue and no instrument on a shaft: gauze, ribbed tubes, needles with thread.

`h, w` image size. Colors in [0, 1], sRGB. Lengths in px of an image whose longer side is 256 px.
"""

from __future__ import annotations

import colorsys

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from .noise import Field, fractal_field, log_uniform, smooth_field
from .parts import Canvas, Part, canvas_over, coated, colored, paint, steel


def gauze(rng: Generator, tissue: Field, view: NDArray[np.bool_]) -> Canvas:
    """A dressing, sponge, drape or blade along the border of the view, or around a gap: pale or gray, little shine."""
    h, w = view.shape
    y, x = np.mgrid[:h, :w].astype(np.float32)
    inward = _into_a_gap(rng, x, y) if rng.random() < 0.15 else _along_a_side(rng, x, y)
    uneven = rng.uniform(0, 0.12) * min(h, w) * smooth_field(rng, (h, w), rng.uniform(30, 120))
    inward = inward - uneven - rng.uniform(0.5, 2.5) * fractal_field(rng, (h, w), 8, 2)
    covered = np.clip(0.5 - inward, 0, 1).astype(np.float32)
    color = _cloth(rng, x, y)
    rim = 1 - rng.uniform(0, 0.8) * np.exp(-np.abs(inward) / log_uniform(rng, 2, 20))
    far = 1 + rng.uniform(-0.7, 0.5) * np.clip(-inward / (0.4 * min(h, w)), 0, 1)  # from the lamp
    color = color * (rim * far)[..., None]
    if rng.random() < 0.3:  # soaked with blood
        wet = np.clip(fractal_field(rng, (h, w), 40, 4) - rng.uniform(0.2, 1.2), 0, 1)[..., None]
        color = color + wet * (np.array([0.45, 0.05, 0.05], np.float32) - color)
    canvas = canvas_over(tissue, np.ones((h, w), np.float32))
    canvas.color[:], canvas.covered[:], canvas.outline[:] = color, covered, covered
    return canvas


def _along_a_side(rng: Generator, x: Field, y: Field) -> Field:
    """(h, w) distance from the edge of a cloth that lies along one side, px; negative on the cloth."""
    h, w = x.shape
    angle, depth = rng.uniform(0, 2 * np.pi), rng.uniform(0.06, 0.65) * min(h, w)
    cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    reach = (abs(cos) * w + abs(sin) * h) / 2
    inward = reach - ((x - w / 2) * cos + (y - h / 2) * sin)
    along = (y - h / 2) * cos - (x - w / 2) * sin
    return inward - depth - rng.normal(0, 0.25) * along - rng.normal(0, 0.002) * along**2


def _into_a_gap(rng: Generator, x: Field, y: Field) -> Field:
    """(h, w) the same for a cloth around an oval gap, in which the tissue is seen."""
    h, w = x.shape
    wide, high = rng.uniform(0.3, 0.7) * w, rng.uniform(0.3, 0.7) * h
    off_x, off_y = x - w * rng.uniform(0.3, 0.7), y - h * rng.uniform(0.3, 0.7)
    return (1 - np.hypot(off_x / wide, off_y / high)) * min(wide, high)


def _cloth(rng: Generator, x: Field, y: Field) -> Field:
    """(h, w, 3) color of woven gauze, of a grainy sponge, or of smooth and dull plastic or metal."""
    size = x.shape
    tone = colorsys.hsv_to_rgb(rng.uniform(0.04, 0.6), rng.uniform(0.0, 0.35), log_uniform(rng, 0.12, 0.95))
    surface = 1 + np.float32(rng.uniform(0.0, 0.35)) * fractal_field(rng, size, rng.uniform(2.5, 8), 2)
    if rng.random() < 0.4:
        period, turn = log_uniform(rng, 3, 9), rng.uniform(0, np.pi)
        first = np.sin((x * np.cos(turn) + y * np.sin(turn) + smooth_field(rng, size, 20) * 3) * 2 * np.pi / period)
        second = np.sin((y * np.cos(turn) - x * np.sin(turn) + smooth_field(rng, size, 20) * 3) * 2 * np.pi / period)
        surface = surface * (1 + rng.uniform(0.05, 0.3) * first * second)
    surface = surface * (1 + rng.uniform(0, 0.35) * fractal_field(rng, size, 60, 3))
    color = np.array(tone, np.float32) * np.clip(surface, 0.05, 2)[..., None]
    if rng.random() < 0.4:  # wet: small highlights
        wet = np.clip(fractal_field(rng, size, log_uniform(rng, 3, 14), 3) - rng.uniform(1, 2), 0, 1)
        color = color + (np.float32(rng.uniform(0.1, 0.6)) * wet)[..., None]
    return color


def ribbed_tube(rng: Generator, tissue: Field) -> tuple[Field, Canvas]:
    """The tissue, with a dark lumen or as it is, and a tube of an intubation or a drain over it: wide, often ribbed."""
    h, w = tissue.shape[:2]
    angle = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)], np.float32)
    middle = np.array([w / 2, h / 2], np.float32) + rng.normal(0, 0.2, 2).astype(np.float32) * (w, h)
    width, length = log_uniform(rng, 15, 90), float(np.hypot(h, w))
    material = (steel, lambda r: coated(r, 0.3, 1), lambda r: coated(r, 0.02, 0.4), colored)[rng.integers(4)](rng)
    if rng.random() < 0.6:
        tissue = _with_lumen(rng, tissue, middle + along * rng.uniform(-0.2, 0.5) * width, width)
    canvas = canvas_over(tissue, np.full((h, w), log_uniform(rng, 0.15, 1.4), np.float32))
    start = (middle - along * length * rng.uniform(0.9, 1.2)).astype(np.float32)
    taper = rng.uniform(0.6, 1.3)
    ribs = rng.uniform(0.1, 0.6) if rng.random() < 0.75 else 0.0
    bend = rng.normal(0, 0.08)
    rounded = bool(rng.random() < 0.5)
    paint(rng, canvas, Part(start, along, length, (width, width * taper), material, 0, bend, rounded, None, ribs))
    return tissue, canvas


def _with_lumen(rng: Generator, tissue: Field, middle: NDArray, width: float) -> Field:
    """(h, w, 3) tissue with a dark oval opening about `middle` (x, y), wider than the tube of that width."""
    h, w = tissue.shape[:2]
    y, x = np.mgrid[:h, :w].astype(np.float32)
    turn = rng.uniform(0, np.pi)
    dx, dy = x - middle[0], y - middle[1]
    long, short = rng.uniform(0.7, 2.5) * width, rng.uniform(0.6, 1.3) * width
    u, v = (dx * np.cos(turn) + dy * np.sin(turn)) / long, (dy * np.cos(turn) - dx * np.sin(turn)) / short
    edge = 1 + 0.15 * smooth_field(rng, (h, w), 40) - np.hypot(u, v)
    share = 1 / (1 + np.exp(-np.clip(edge * log_uniform(rng, 4, 40), -30, 30)))
    return tissue * (1 - share * rng.uniform(0.7, 1))[..., None]


def needle(rng: Generator, tissue: Field, view: NDArray[np.bool_]) -> Canvas:
    """A bent needle and its thread, anywhere in the view."""
    h, w = view.shape
    canvas = canvas_over(tissue, np.ones((h, w), np.float32))
    y, x = rng.uniform(0.15, 0.85, 2) * (h, w)
    radius, first = log_uniform(rng, 8, 40), rng.uniform(0, 360)
    arc = cv2.ellipse2Poly(
        (int(x), int(y)), (int(radius), int(radius * rng.uniform(0.4, 1))), 0, 0, int(rng.uniform(90, 200)), 4
    )
    turn = np.deg2rad(first)
    points = (np.array(arc) - (x, y)) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + (x, y)
    painted_line(canvas, points, rng.uniform(1.5, 4), np.full(3, rng.uniform(0.4, 1), np.float32), rng)
    tone = rng.choice([0, 1, 2])
    color = (np.array([0.35, 0.15, 0.55]), np.full(3, rng.uniform(0.02, 0.2)), np.array([0.2, 0.4, 0.75]))[tone]
    steps = np.cumsum(rng.normal(0, 1, (40, 2)).cumsum(0) * rng.uniform(0.3, 1.2), 0)
    painted_line(canvas, points[-1] + steps, rng.uniform(1, 2.2), color.astype(np.float32), rng)
    return canvas


def painted_line(canvas: Canvas, points: NDArray, width: float, color: Field, rng: Generator) -> None:
    """A line of that width; lines are thinner than cv2's whole pixels, so they are drawn at four times the size."""
    h, w = canvas.covered.shape
    large = np.zeros((4 * h, 4 * w), np.uint8)
    cv2.polylines(large, [np.round(points * 4).astype(np.int32)], False, 255, max(round(width * 4), 1))
    share = cv2.resize(large, (w, h), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    shine = np.clip(1 + 0.6 * smooth_field(rng, (h, w), 12), 0.3, 2.5)
    canvas.color[:] += share[..., None] * (color * shine[..., None] - canvas.color)
    np.maximum(canvas.covered, share, out=canvas.covered)
    np.maximum(canvas.outline, share, out=canvas.outline)
