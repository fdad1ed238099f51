"""Paint one part of an instrument: a rod, a bar or a plate along an axis, with the light of its surface.

It is made of steel that mirrors its surroundings, or of plastic, coated or not, of every color.

`h, w` image size. Colors in [0, 1], sRGB. Lengths in px.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from .noise import Field, fractal_field, random_curve

Point = NDArray[np.floating]


@dataclass(frozen=True)
class Material:
    """How a surface answers the lamp."""

    color: Field
    """(3,) RGB."""
    mirror: float
    """Share of the color that is a reflection, 0..1."""
    tissue_share: float
    """Share of the reflection that has the color of the tissue around, 0..1; the rest is gray."""
    gloss: float
    """Brightness of the lamp's highlight."""
    gloss_width: float
    """Of the highlight, as a share of the half width of a rod."""
    grain: float
    """Strength of mottling: wear, dirt, brushed metal."""


def steel(rng: Generator) -> Material:
    """Polished or brushed metal."""
    color = np.full(3, rng.uniform(0.25, 0.9), np.float32) * _tint(rng, 0.05)
    return Material(
        color,
        rng.uniform(0.3, 1),
        rng.uniform(0, 0.75) if rng.random() < 0.8 else rng.uniform(0.75, 1),
        rng.uniform(0.2, 1.4),
        rng.uniform(0.04, 0.4),
        rng.uniform(0, 0.25),
    )


def coated(rng: Generator, low: float, high: float, tint: float = 0.08) -> Material:
    """A gray shaft, from black to white."""
    color = np.full(3, rng.uniform(low, high), np.float32) * _tint(rng, tint)
    return _plastic(rng, color)


def gray_blue(rng: Generator) -> Material:
    """The shafts of surgical robots: gray with a cast of blue."""
    color = np.array([1.0, rng.uniform(1.0, 1.15), rng.uniform(1.05, 1.45)], np.float32)
    return _plastic(rng, color * np.float32(rng.uniform(0.12, 0.6)))


def colored(rng: Generator) -> Material:
    """Gold, green, blue, yellow, ivory, purple; seldom anything else."""
    hue, pale, strong = (
        (rng.uniform(0.10, 0.15), 0.3, 0.85),
        (rng.uniform(0.25, 0.48), 0.2, 0.9),
        (rng.uniform(0.52, 0.68), 0.2, 0.95),
        (rng.uniform(0.08, 0.16), 0.05, 0.3),
        (rng.uniform(0.7, 0.85), 0.2, 0.7),
        (rng.uniform(0, 1), 0.1, 0.9),
    )[rng.choice(6, p=[0.25, 0.2, 0.28, 0.15, 0.06, 0.06])]
    rgb = colorsys.hsv_to_rgb(hue, rng.uniform(pale, strong), rng.uniform(0.25, 1))
    color = np.array(rgb, np.float32)
    if rng.random() < 0.25:  # anodized, or gilded: colored metal
        return replace(steel(rng), color=color)
    return _plastic(rng, color)


def vivid(rng: Generator) -> Material:
    """Plastic of any hue but that of tissue, or white: catheters, sheaths, plastic clips."""
    if rng.random() < 0.25:
        return coated(rng, 0.6, 1.0)
    rgb = colorsys.hsv_to_rgb(rng.uniform(0.11, 0.8), rng.uniform(0.25, 1), rng.uniform(0.3, 1))
    return _plastic(rng, np.array(rgb, np.float32))


def shaft_material(rng: Generator) -> Material:
    """Of a shaft: steel, black, gray, gray-blue, white, or colored."""
    kind = rng.choice(6, p=[0.2, 0.22, 0.15, 0.17, 0.1, 0.16])
    if kind == 0:
        return steel(rng)
    if kind == 3:
        return gray_blue(rng)
    if kind == 5:
        return colored(rng)
    return coated(rng, *{1: (0.01, 0.14), 2: (0.12, 0.5), 4: (0.6, 1.0)}[int(kind)])


def tip_material(rng: Generator) -> Material:
    """Of wrist and jaws: mostly steel."""
    kind = rng.choice(4, p=[0.68, 0.14, 0.1, 0.08])
    return (steel, lambda r: coated(r, 0.02, 0.25), lambda r: coated(r, 0.5, 1.0), colored)[kind](rng)


def _plastic(rng: Generator, color: Field) -> Material:
    return Material(
        np.clip(color, 0, 1),
        rng.uniform(0, 0.25),
        rng.uniform(0, 0.9),
        rng.uniform(0, 0.9),
        rng.uniform(0.05, 0.5),
        rng.uniform(0, 0.2),
    )


def _tint(rng: Generator, strength: float) -> Field:
    return np.exp(rng.normal(0, strength, 3)).astype(np.float32)


@dataclass(frozen=True)
class Canvas:
    """Where the parts of one instrument are painted."""

    around: Field
    """(h, w, 3) blurred tissue, which metal mirrors."""
    light: Field
    """(h, w) brightness of the lamp on the instrument: shafts are nearer to it than tips, or in shadow."""
    color: Field
    """(h, w, 3) color of the instrument; written."""
    covered: Field
    """(h, w) in [0, 1], how much of a pixel the instrument hides; written."""
    outline: Field
    """(h, w) the same with its windows filled; written."""


@dataclass(frozen=True)
class Part:
    """A body along an axis that may bend."""

    start: Point
    """(2,) x, y."""
    along: Point
    """(2,) unit direction."""
    length: float
    widths: tuple[float, ...]
    """Width at evenly spaced positions along the axis."""
    material: Material
    flat: float = 0.0
    """0: round like a rod, 1: flat like a plate."""
    bend: float = 0.0
    """How far the end is off the axis, as a share of the length."""
    round_tip: bool = True
    window: tuple[float, float, float] | None = None
    """A hole: from, to (shares of the length) and its share of the width."""
    teeth: float = 0.0
    """Depth of grooves across the part, 0..1."""
    bands: tuple[tuple[float, float, Material], ...] = field(default=())
    """Rings and prints: from, to (shares of the length), what they are made of."""


def paint(rng: Generator, canvas: Canvas, part: Part) -> None:
    """Paint `part` over what is on the canvas."""
    box = _box(part, canvas.covered.shape)
    if box is None:
        return
    y, x = np.mgrid[box].astype(np.float32)
    dx, dy = x - part.start[0], y - part.start[1]
    s = (dx * part.along[0] + dy * part.along[1]) / np.float32(max(part.length, 1e-3))
    side = dy * part.along[0] - dx * part.along[1] - np.float32(part.bend * part.length) * s * np.abs(s)
    half = np.interp(s, np.linspace(0, 1, len(part.widths)), np.array(part.widths) / 2).astype(np.float32)
    inside = np.clip(half - np.abs(side) + 0.5, 0, 1)
    end = (s - 1) * np.float32(part.length)
    if part.round_tip:
        inside *= np.clip(half - np.hypot(np.maximum(end, 0), side) + 0.5, 0, 1)
    else:
        inside *= np.clip(0.5 - end, 0, 1)
    inside *= np.clip(s * np.float32(part.length) + 0.5, 0, 1)
    if not inside.any():
        return
    u = np.clip(side / np.maximum(half, 0.5), -1, 1)
    color = _shaded(rng, canvas, box, part, part.material, s, u)
    for first, last, material in part.bands:
        ring = (s >= first) & (s < last)
        if ring.any():
            color = np.where(ring[..., None], _shaded(rng, canvas, box, part, material, s, u), color)
    outline, covered = inside, inside
    if part.window is not None:
        first, last, share = part.window
        hole = np.clip((np.minimum(s - first, last - s)) * np.float32(part.length) + 0.5, 0, 1)
        hole *= np.clip((share - np.abs(u)) * half + 0.5, 0, 1)
        covered = inside * (1 - hole)
        rim = np.exp(-((np.abs(u) - share) ** 2) * 30) * hole.max(initial=0)
        color = color * (1 - 0.4 * (rim * (hole > 0))[..., None])
    canvas.color[box] += covered[..., None] * (color - canvas.color[box])
    canvas.covered[box] = np.maximum(canvas.covered[box], covered)
    canvas.outline[box] = np.maximum(canvas.outline[box], outline)


def _box(part: Part, size: tuple[int, int]) -> tuple[slice, slice] | None:
    """The rows and columns that the part can touch; None outside of the image."""
    ends = np.stack([part.start, part.start + part.along * part.length])
    reach = max(part.widths) / 2 + abs(part.bend) * part.length + 2
    low, high = np.floor(ends.min(0) - reach).astype(int), np.ceil(ends.max(0) + reach).astype(int)
    rows, columns = slice(max(low[1], 0), min(high[1], size[0])), slice(max(low[0], 0), min(high[0], size[1]))
    return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None


def _shaded(
    rng: Generator, canvas: Canvas, box: tuple[slice, slice], part: Part, material: Material, s: Field, u: Field
) -> Field:
    """(h, w, 3) color of the part's surface at positions s along and u across."""
    normal = u * np.float32(1 - part.flat) + np.float32(0.15 * part.flat)
    facing = np.sqrt(np.clip(1 - normal**2, 0, 1))
    grain = fractal_field(rng, s.shape, float(rng.uniform(3, 16)), 3) * np.float32(material.grain)
    if part.teeth:
        period = max(rng.uniform(2.5, 6), 0.03 * part.length) / max(part.length, 1)
        grain = grain + np.float32(part.teeth) * np.sign(np.sin(s * np.float32(2 * np.pi / period)))
    # Metal mirrors the room as streaks along its axis: a random curve over the angle of the surface.
    angle = 0.5 + np.arcsin(normal) / np.pi + rng.normal(0, 0.08) * np.sin(s * rng.uniform(1, 8)) + 0.1 * grain
    streaks = random_curve(rng, int(rng.integers(4, 10)), angle)
    streaks = 1 / (1 + np.exp(-(streaks - rng.uniform(0.3, 0.7)) * rng.uniform(3, 14)))
    seen = canvas.around[box] * np.float32(material.tissue_share) * 1.5 + np.float32(1 - material.tissue_share)
    diffuse = material.color * (np.float32(0.25) + 0.75 * facing**1.2)[..., None]
    mirrored = material.color * seen * (0.08 + 1.1 * streaks)[..., None]
    color = (1 - material.mirror) * diffuse + np.float32(material.mirror) * mirrored
    color = color * (1 + grain)[..., None] * canvas.light[box][..., None]
    lamp = rng.uniform(-0.5, 0.5) if part.flat < 0.5 else rng.uniform(-0.3, 0.6)
    highlight = np.exp(-(((u - lamp) / material.gloss_width) ** 2))
    if part.flat > 0.5 or part.teeth:  # facets shine here and there
        highlight = highlight * np.clip(fractal_field(rng, s.shape, 9, 2) * 0.8, 0, 1)
    return color + (np.float32(material.gloss) * highlight * np.clip(1 + 2 * grain, 0, 2))[..., None]


def canvas_over(tissue: Field, light: Field) -> Canvas:
    """An empty canvas over (h, w, 3) tissue."""
    h, w = tissue.shape[:2]
    around = cv2.resize(tissue, (w // 16, h // 16), interpolation=cv2.INTER_AREA)
    around = cv2.resize(around, (w, h), interpolation=cv2.INTER_LINEAR)
    empty = np.zeros(tissue.shape[:2], np.float32)
    return Canvas(around, light, np.zeros_like(tissue), empty, empty.copy())
