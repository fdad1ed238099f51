"""Paint one instrument: a shaft that enters from the border, a wrist or none, and one of many tips.

Kinds: graspers and needle holders with windows or teeth, scissors, bipolar forceps, staplers, clip appliers, hooks,
suction tubes, probes, retractors, ultrasonic shears. All numbers are ranges; nothing is fitted to a real instrument.
`h, w` image size. Lengths in px of an image whose longer side is 256 px.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from .noise import Field, log_uniform, smooth_field
from .parts import (
    Canvas,
    Material,
    Part,
    Point,
    canvas_over,
    coated,
    colored,
    paint,
    shaft_material,
    steel,
    tip_material,
)

WIDTH_PX = (5.0, 60.0)
"""Width of a shaft, even in its logarithm."""
NEAR_WIDTH_PX = (45.0, 120.0)
"""The same of a shaft close to the camera, which is out of focus."""
REACH = (0.08, 0.75)
"""Length in the view, as a share of the image's diagonal."""


def instrument(
    rng: Generator, tissue: Field, view: NDArray[np.bool_], widths: tuple[float, float] = WIDTH_PX
) -> Canvas:
    """Paint one instrument over (h, w, 3) `tissue`; it enters from the border of `view` (h, w), as wide as `widths`."""
    h, w = view.shape
    canvas = canvas_over(tissue, _lamp(rng, (h, w)))
    start, along = entry(rng, view)
    width = log_uniform(rng, *widths)
    tip = _TIPS[rng.choice(len(_TIPS), p=_OFTEN)]
    reach = rng.uniform(*REACH) * float(np.hypot(h, w))
    shaft, end, along = _shaft(rng, start, along, width, reach)
    tip_is_behind = rng.random() < 0.5
    tips = tip(rng, end, along, width)
    for part in (*tips, *shaft) if tip_is_behind else (*shaft, *tips):
        paint(rng, canvas, part)
    return canvas


def _lamp(rng: Generator, size: tuple[int, int]) -> Field:
    """(h, w) brightness of the lamp on an instrument."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    slope_x, slope_y = rng.normal(0, 0.5, 2)
    light = 1 + slope_x * (x / size[1] - 0.5) + slope_y * (y / size[0] - 0.5)
    light = light + rng.uniform(0, 0.3) * smooth_field(rng, size, 60)
    strength = log_uniform(rng, 0.5, 1.7) if rng.random() < 0.85 else log_uniform(rng, 1.7, 4)  # overexposed
    return (np.clip(light, 0.15, 3) * strength).astype(np.float32)


def entry(rng: Generator, view: NDArray[np.bool_]) -> tuple[Point, Point]:
    """A point beyond the border of the view, and a direction (unit vector) into it."""
    h, w = view.shape
    angle = rng.uniform(0, 2 * np.pi)
    ray = np.array([np.cos(angle), np.sin(angle)], np.float32)
    steps = np.arange(0, np.hypot(h, w))
    x, y = w / 2 + ray[0] * steps, h / 2 + ray[1] * steps
    inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    inside[inside] &= view[y[inside].astype(int), x[inside].astype(int)]
    last = steps[inside].max() if inside.any() else 0
    border = np.array([w / 2 + ray[0] * last, h / 2 + ray[1] * last], np.float32)
    toward = np.array([w / 2, h / 2]) + rng.normal(0, 0.28, 2) * (w, h) - border
    along = (toward / (np.hypot(*toward) + 1e-6)).astype(np.float32)
    return border, along


def _shaft(
    rng: Generator, start: Point, along: Point, width: float, reach: float
) -> tuple[tuple[Part, ...], Point, Point]:
    """The shaft with rings and prints, and a wrist; the point and direction at which the tip begins."""
    material, bands = shaft_material(rng), []
    for _ in range(rng.choice(4, p=[0.5, 0.25, 0.15, 0.1])):
        first = rng.uniform(0.1, 1)
        other = shaft_material(rng) if rng.random() < 0.7 else replace(material, color=material.color * 0.4)
        bands.append((first, first + rng.uniform(0.01, 0.2), other))
    if rng.random() < 0.3:  # a collar at the end
        bands.append(
            (1 - rng.uniform(0.03, 0.3), 1.01, tip_material(rng) if rng.random() < 0.6 else shaft_material(rng))
        )
    back = 12 + width
    taper = rng.uniform(1.0, 1.5)  # nearer to the camera at the border
    length = reach + back
    bend = rng.normal(0, 0.02) if rng.random() < 0.8 else rng.normal(0, 0.12)
    part = Part(
        start - along * back,
        along,
        length,
        (width * taper, width),
        material,
        flat=0 if rng.random() < 0.85 else rng.uniform(0.3, 0.9),
        bend=bend,
        round_tip=bool(rng.random() < 0.4),
        bands=tuple(bands),
    )
    end = end_of(part)
    along = turned(along, 2 * bend)
    parts = [part]
    if rng.random() < 0.5:  # a wrist: fork, pulleys, cables
        along = turned(along, rng.normal(0, 0.4))
        size, material = width * rng.uniform(0.5, 1.7), tip_material(rng)
        widths = tuple(width * rng.uniform(0.6, 1.1) for _ in range(rng.integers(2, 5)))
        window = (rng.uniform(0.1, 0.5), rng.uniform(0.55, 0.95), rng.uniform(0.1, 0.5)) if rng.random() < 0.4 else None
        wrist = Part(
            end - along * width * 0.2, along, size, widths, material, rng.uniform(0, 1), window=window, teeth=0.0
        )
        if rng.random() < 0.4:
            wrist = replace(wrist, bands=((0.3, 0.6, tip_material(rng)),))
        parts.append(wrist)
        end = end_of(wrist)
        along = turned(along, rng.normal(0, 0.35))
    return tuple(parts), end, along


def _jaws(rng: Generator, end: Point, along: Point, width: float) -> tuple[Part, ...]:
    """One jaw that is seen, or two: grasper, needle holder, scissors, forceps."""
    length = width * log_uniform(rng, 0.6, 4)
    opening = abs(rng.normal(0, 0.3)) if rng.random() < 0.7 else 0.0
    material, curve = tip_material(rng), rng.normal(0, 0.12)
    first, last = width * rng.uniform(0.3, 0.8), width * rng.uniform(0.05, 0.5)
    middle = rng.uniform(min(first, last), max(first, last) * 1.1)
    window = (rng.uniform(0.1, 0.3), rng.uniform(0.6, 0.95), rng.uniform(0.2, 0.75)) if rng.random() < 0.35 else None
    teeth = rng.uniform(0.05, 0.35) if rng.random() < 0.4 else 0.0
    parts = []
    for side in ((0,), (-1, 1), (-1, 1), (-0.2, 1))[rng.integers(4)]:
        toward = turned(along, side * opening)
        bend = curve - side * opening * rng.uniform(0, 0.5)
        made = material if rng.random() < 0.9 else tip_material(rng)
        flat = rng.uniform(0, 1)
        parts.append(Part(end, toward, length, (first, middle, last), made, flat, bend, True, window, teeth))
    if rng.random() < 0.3:  # a pin
        size = width * rng.uniform(0.2, 0.5)
        parts.append(Part(end - along * size / 2, along, size, (size, size), steel(rng), 0.5))
    return tuple(parts)


def _stapler(rng: Generator, end: Point, along: Point, width: float) -> tuple[Part, ...]:
    """Two long jaws as wide as the shaft, often white, one thinner than the other."""
    length = width * rng.uniform(2, 6)
    body = coated(rng, 0.5, 1) if rng.random() < 0.6 else shaft_material(rng)
    opening = abs(rng.normal(0, 0.15))
    bands = tuple((f, f + rng.uniform(0.02, 0.2), shaft_material(rng)) for f in rng.uniform(0, 1, rng.integers(0, 4)))
    window = (rng.uniform(0.1, 0.5), rng.uniform(0.55, 0.9), rng.uniform(0.1, 0.5)) if rng.random() < 0.4 else None
    first = Part(end, turned(along, opening), length, (width, width * rng.uniform(0.6, 1)), body, 0.6, 0, True, window)
    second = Part(end, turned(along, -opening), length, (width * 0.8, width * 0.4), tip_material(rng), 0.4)
    return (second, replace(first, bands=bands))


def _hook(rng: Generator, end: Point, along: Point, width: float) -> tuple[Part, ...]:
    """A thin rod with a bent end, or a spatula."""
    thin, material = max(width * rng.uniform(0.12, 0.4), 2.0), tip_material(rng)
    rod = Part(end, along, width * rng.uniform(0.3, 2.5), (thin, thin), material, bend=rng.normal(0, 0.1))
    aside = turned(along, rng.choice([-1, 1]) * rng.uniform(0.2, 1.7))
    return (rod, Part(end_of(rod), aside, width * rng.uniform(0.3, 1.2), (thin, thin * rng.uniform(0.5, 2)), material))


def _tube(rng: Generator, end: Point, along: Point, width: float) -> tuple[Part, ...]:
    """The open end of a suction tube, or of a catheter, with side holes."""
    dark = coated(rng, 0.0, 0.08)
    rim = Part(end - along * 2, along, 2 + width * rng.uniform(0.1, 0.5), (width, width), shaft_material(rng))
    parts = [rim]
    for _ in range(rng.integers(0, 5)):
        at = end - along * width * rng.uniform(0.3, 3) + turned(along, np.pi / 2) * width * rng.uniform(-0.3, 0.3)
        size = width * rng.uniform(0.1, 0.3)
        parts.append(Part(at, along, size, (size, size), dark, 1))
    if rng.random() < 0.5:
        parts.append(Part(end_of(rim) - along * width * 0.15, along, width * 0.3, (width * 0.8, width * 0.7), dark, 1))
    return tuple(parts)


def _plate(rng: Generator, end: Point, along: Point, width: float) -> tuple[Part, ...]:
    """A retractor or a blade: wide and flat."""
    wide = width * rng.uniform(1, 3)
    window = (rng.uniform(0.1, 0.4), rng.uniform(0.5, 0.9), rng.uniform(0.2, 0.8)) if rng.random() < 0.4 else None
    widths = (width, wide, wide * rng.uniform(0.3, 1))
    return (
        Part(end, along, width * rng.uniform(1, 4), widths, tip_material(rng), 0.9, rng.normal(0, 0.1), True, window),
    )


def _clips(rng: Generator, end: Point, along: Point, width: float) -> tuple[Part, ...]:
    """Two thin curved arms that hold a clip."""
    length, thin = width * rng.uniform(0.8, 2), max(width * rng.uniform(0.1, 0.25), 1.5)
    material, across = tip_material(rng), turned(along, np.pi / 2) * width * np.float32(0.3)
    clip: Material = colored(rng) if rng.random() < 0.5 else steel(rng)
    arms = [
        Part(end + across * side, turned(along, side * 0.2), length, (thin * 1.5, thin), material, 0.2, -side * 0.2)
        for side in (-1, 1)
    ]
    return (*arms, Part(end + along * length * 0.6, along, length * 0.4, (width * 0.3, width * 0.2), clip, 0.5))


def _shears(rng: Generator, end: Point, along: Point, width: float) -> tuple[Part, ...]:
    """A thin long rod that vibrates, and beside it an arm with a white pad."""
    length, thin = width * rng.uniform(1.5, 5), max(width * rng.uniform(0.2, 0.4), 2.0)
    opening, curve = abs(rng.normal(0, 0.2)), rng.normal(0, 0.1)
    rod = Part(end, along, length, (thin * 1.3, thin), steel(rng), bend=curve)
    toward = turned(along, opening)
    arm = Part(end, toward, length * rng.uniform(0.9, 1.05), (thin * 2, thin), tip_material(rng), 0.4, curve)
    pad = replace(arm, start=end - turned(toward, np.pi / 2) * thin * 0.5, widths=(thin, thin * 0.6))
    return (rod, replace(pad, material=coated(rng, 0.6, 1)), arm) if rng.random() < 0.7 else (arm, rod)


def _none(rng: Generator, end: Point, along: Point, width: float) -> tuple[Part, ...]:
    """A blunt probe, or a shaft whose tip is hidden."""
    return (Part(end - along * 3, along, 3 + width * rng.uniform(0, 0.6), (width, width * 0.6), shaft_material(rng)),)


_Tip = Callable[[Generator, Point, Point, float], tuple[Part, ...]]
_TIPS: tuple[_Tip, ...] = (_jaws, _stapler, _hook, _tube, _plate, _clips, _shears, _none)
_OFTEN = (0.46, 0.1, 0.1, 0.09, 0.06, 0.05, 0.06, 0.08)


def end_of(part: Part) -> Point:
    """(2,) x, y of the end of its axis."""
    across = np.array([-part.along[1], part.along[0]], np.float32)
    return part.start + part.along * np.float32(part.length) + across * np.float32(part.bend * part.length)


def turned(along: Point, angle: float) -> Point:
    """The direction turned by `angle`, rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([cos * along[0] - sin * along[1], sin * along[0] + cos * along[1]], np.float32)
