"""What instruments are made of: steel that mirrors its surroundings, plastic and coated shafts of every color.

Colors in [0, 1], sRGB.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from .noise import Field


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
