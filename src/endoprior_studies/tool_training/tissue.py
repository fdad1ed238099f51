"""Procedural tissue: folded organs of several colors under the lamp of an endoscope, with vessels, fat, blood, gloss.

No atlas of organs: colors, shapes and light are drawn from wide ranges, so that what all tissues share is learned, and
pale, yellow, purple or overexposed tissue is not taken for a tool. `h, w` image size; colors in [0, 1], sRGB.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator

from .noise import Field, fractal_field, log_uniform, ridges, smooth_field

HUES = ((-0.02, 0.035, 0.3, 0.85), (-0.01, 0.07, 0.12, 0.4), (0.05, 0.125, 0.3, 0.75), (-0.2, -0.01, 0.12, 0.45))
"""Ranges of hue (turns) and saturation of tissue: red, pale, yellow and orange, purple."""
OFTEN = (0.5, 0.22, 0.17, 0.11)
DARK_ORGANS = 0.15
"""Share of organs that are nearly black, as a spleen or a liver far from the lamp."""


@dataclass(frozen=True)
class Palette:
    """The tissues of one scene are about equally colorful, since one lamp and one camera show them."""

    saturation: float

    @staticmethod
    def of(rng: Generator) -> Palette:
        """A random one."""
        _, _, pale, strong = HUES[rng.choice(4, p=OFTEN)]
        return Palette(rng.uniform(pale, strong) * (1 if rng.random() < 0.93 else 0.4))

    def tone(self, rng: Generator, dark: float = DARK_ORGANS) -> Field:
        """(3,) RGB of an organ."""
        low, high, _, _ = HUES[rng.choice(4, p=OFTEN)]
        saturation = float(np.clip(self.saturation * rng.uniform(0.7, 1.35), 0.05, 0.95))
        value = rng.uniform(0.03, 0.25) if rng.random() < dark else rng.uniform(0.3, 0.95)
        return np.array(colorsys.hsv_to_rgb(rng.uniform(low, high) % 1, saturation, value), np.float32)


def tissue(rng: Generator, size: tuple[int, int]) -> Field:
    """(h, w, 3) an image of tissue alone."""
    palette = Palette.of(rng)
    image = _colored(rng, size, palette)
    for _ in range(rng.choice(4, p=[0.25, 0.35, 0.25, 0.15])):
        image = _organ_over(rng, image, _colored(rng, size, palette))
    for add, often in MATTE_PARTS:
        if rng.random() < often:
            image = add(rng, image)
    if rng.random() < 0.25:
        image = _with_bands(rng, image, palette)
    image = _lit(rng, image)
    for add, often in LIT_PARTS:
        if rng.random() < often:
            image = add(rng, image)
    return np.clip(image, 0, 1)


def _colored(rng: Generator, size: tuple[int, int], palette: Palette) -> Field:
    """(h, w, 3) mottled color of one organ."""
    first, second = palette.tone(rng), palette.tone(rng)
    second = first + np.float32(rng.uniform(0.1, 0.7)) * (second - first)
    share = 1 / (1 + np.exp(-rng.uniform(0.8, 4) * fractal_field(rng, size, log_uniform(rng, 8, 70), 5, 0.6)))
    image = first + share[..., None] * (second - first)
    grain = fractal_field(rng, size, log_uniform(rng, 3, 12), 3)
    return image * (1 + np.float32(rng.uniform(0, 0.12)) * grain[..., None])


def _organ_over(rng: Generator, image: Field, other: Field) -> Field:
    """(h, w, 3) `other` in front of a part of `image`, with an edge that casts a shadow."""
    size = image.shape[:2]
    field = smooth_field(rng, size, log_uniform(rng, 50, 160)) + 0.06 * smooth_field(rng, size, 12)
    share = 1 / (1 + np.exp(-np.clip((field - rng.uniform(-0.4, 0.8)) * rng.uniform(15, 80), -30, 30)))
    width = int(rng.uniform(4, 18))
    dark = cv2.blur(cv2.blur(share, (width, width)), (width, width)) * (1 - share) * np.float32(rng.uniform(0, 1.2))
    rim = 1 - rng.uniform(0, 0.5) * np.exp(-np.abs(field - rng.uniform(0.05, 0.3)) * 12) * share
    image = image * (1 - np.clip(dark, 0, 0.9))[..., None]
    return image + share[..., None] * (other * rim[..., None] - image)


def _with_vessels(rng: Generator, image: Field) -> Field:
    size = image.shape[:2]
    for _ in range(rng.integers(1, 4)):
        warp = fractal_field(rng, size, log_uniform(rng, 10, 60), 4, 0.55)
        line = ridges(warp, rng.uniform(0.03, 0.12)) * (smooth_field(rng, size, 50) > rng.uniform(-1, 0.6))
        red = np.array([rng.uniform(0.3, 0.7), rng.uniform(0.02, 0.25), rng.uniform(0.05, 0.35)], np.float32)
        image = image + (np.float32(rng.uniform(0.2, 0.8)) * line)[..., None] * (red - image)
    return image


def _with_blood(rng: Generator, image: Field) -> Field:
    size = image.shape[:2]
    field = fractal_field(rng, size, log_uniform(rng, 12, 80), 4)
    share = np.clip((field - rng.uniform(0.2, 1.2)) * rng.uniform(2, 12), 0, 1) * np.float32(rng.uniform(0.5, 1))
    blood = np.array([rng.uniform(0.15, 0.6), rng.uniform(0, 0.08), rng.uniform(0, 0.08)], np.float32)
    return image + share[..., None] * (blood - image)


def _with_bands(rng: Generator, image: Field, palette: Palette) -> Field:
    """Ducts, ligaments, loops of small bowel: long pale bodies that could be mistaken for a shaft."""
    h, w = image.shape[:2]
    y, x = np.mgrid[:h, :w].astype(np.float32)
    for _ in range(rng.integers(1, 4)):
        angle, width = rng.uniform(0, np.pi), log_uniform(rng, 3, 40)
        dx, dy = x - rng.uniform(0, w), y - rng.uniform(0, h)
        along, across = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        across = across + width * rng.uniform(0.3, 1.5) * np.sin(along / rng.uniform(20, 90) + rng.uniform(0, 6))
        across = across / (width * (1 + 0.25 * smooth_field(rng, (h, w), 40)))
        inside = np.clip((1 - np.abs(across)) * width, 0, 1)
        light = 0.45 + 0.6 * np.sqrt(np.clip(1 - across**2, 0, 1))
        mottled = 1 + 0.1 * fractal_field(rng, (h, w), 20, 3)
        body = palette.tone(rng, dark=0) * (light * mottled)[..., None]
        image = image + inside[..., None] * (body - image)
    return image


def _with_ligaments(rng: Generator, image: Field) -> Field:
    """Pale, glossy and rather straight bands, alone or as a fan: the tissue that looks most like a shaft."""
    h, w = image.shape[:2]
    y, x = np.mgrid[:h, :w].astype(np.float32)
    angle, fan = rng.uniform(0, np.pi), rng.normal(0, 0.3)
    foot_x, foot_y = rng.uniform(0, w), rng.uniform(0, h)
    pale = np.array(colorsys.hsv_to_rgb(rng.uniform(0, 0.14), rng.uniform(0.04, 0.35), rng.uniform(0.6, 1)), np.float32)
    for i in range(rng.integers(1, 5)):
        turn, width = np.float32(angle + fan * i), log_uniform(rng, 2, 25)
        dx, dy = x - foot_x, y - foot_y - i * rng.uniform(0, 2) * width
        along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
        across = across + width * rng.uniform(0, 0.6) * np.sin(along / rng.uniform(40, 150) + rng.uniform(0, 6))
        across = across / (width * np.clip(1 + 0.3 * smooth_field(rng, (h, w), 50), 0.3, 2))
        share = np.clip((1 - np.abs(across)) * width * rng.uniform(0.15, 1), 0, 1) * np.float32(rng.uniform(0.5, 1))
        threads = 1 + rng.uniform(0, 0.2) * np.sin(across * rng.uniform(3, 12) + smooth_field(rng, (h, w), 30))
        body = pale * ((0.5 + 0.5 * np.sqrt(np.clip(1 - across**2, 0, 1))) * threads)[..., None]
        gloss = np.exp(-(((across - rng.uniform(-0.5, 0.5)) / rng.uniform(0.08, 0.4)) ** 2))
        gloss = gloss * np.clip(fractal_field(rng, (h, w), 16, 3), 0, 1.5) * rng.uniform(0, 0.6)
        image = image + share[..., None] * (body + gloss[..., None] - image)
    return image


def _with_fat(rng: Generator, image: Field) -> Field:
    """Lobes of fat: yellow to pale domes, dark between them, each with its highlight."""
    size = image.shape[:2]
    lobe = log_uniform(rng, 6, 35)
    seeds = (rng.random(size) > 1 / lobe**2).astype(np.uint8)
    seeds[0, 0] = 0  # at least one lobe
    distance = cv2.distanceTransform(seeds, cv2.DIST_L2, 3) / np.float32(lobe)
    dome = np.sqrt(np.clip(1.1 - distance**2, 0.05, 1))
    tone = colorsys.hsv_to_rgb(rng.uniform(0.07, 0.15), rng.uniform(0.1, 0.75), rng.uniform(0.6, 1))
    field = smooth_field(rng, size, log_uniform(rng, 40, 150)) - rng.uniform(-0.6, 0.8)
    share = 1 / (1 + np.exp(-np.clip(field * rng.uniform(5, 40), -30, 30)))
    return image + share[..., None] * (np.array(tone, np.float32) * dome[..., None] - image)


def _with_fibers(rng: Generator, image: Field) -> Field:
    """Pale threads of loose tissue in one direction, as where it is being divided."""
    h, w = image.shape[:2]
    y, x = np.mgrid[:h, :w].astype(np.float32)
    turn = rng.uniform(0, np.pi)
    across = (
        y * np.cos(turn) - x * np.sin(turn) + smooth_field(rng, (h, w), log_uniform(rng, 15, 60)) * rng.uniform(1, 8)
    )
    threads = ridges(np.sin(across / log_uniform(rng, 0.8, 5)), rng.uniform(0.2, 0.8))
    where = np.clip(fractal_field(rng, (h, w), log_uniform(rng, 20, 90), 3) - rng.uniform(-0.3, 0.8), 0, 1)
    pale = np.array([1, rng.uniform(0.75, 1), rng.uniform(0.65, 1)], np.float32) * np.float32(rng.uniform(0.5, 1))
    return image + (threads * where * np.float32(rng.uniform(0.3, 0.9)))[..., None] * (pale - image)


def _with_dark_corner(rng: Generator, image: Field) -> Field:
    """What the lamp does not reach behind the tissue: nearly black, a little blue, green or red."""
    h, w = image.shape[:2]
    y, x = np.mgrid[:h, :w].astype(np.float32)
    turn, depth = rng.uniform(0, 2 * np.pi), rng.uniform(-0.1, 0.35)
    beyond = ((x / w - 0.5) * np.cos(turn) + (y / h - 0.5) * np.sin(turn)) - 0.5 + depth
    beyond = beyond * w + 6 * fractal_field(rng, (h, w), 50, 4)
    share = 1 / (1 + np.exp(-np.clip(beyond * log_uniform(rng, 0.08, 2), -30, 30)))
    tone = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0, 0.6), log_uniform(rng, 0.01, 0.15))
    return image + share[..., None] * (np.array(tone, np.float32) - image)


def _with_cavity(rng: Generator, image: Field) -> Field:
    """A lumen or a gap that the lamp hardly reaches: walls fade, fluid glitters, rings of cartilage or folds."""
    size = image.shape[:2]
    field = smooth_field(rng, size, log_uniform(rng, 40, 160)) - rng.uniform(-0.1, 1.1)
    dark = 1 / (1 + np.exp(-np.clip(field * log_uniform(rng, 2, 40), -30, 30)))
    inside = image * np.float32(rng.uniform(0.02, 0.35))
    if rng.random() < 0.4:
        inside = inside * (1 + 0.6 * np.sin(field * rng.uniform(10, 40) + rng.uniform(0, 6)))[..., None]
    if rng.random() < 0.3:
        wet = np.clip(fractal_field(rng, size, log_uniform(rng, 4, 16), 3) - rng.uniform(1.2, 2.2), 0, 1)
        inside = inside + (wet * np.float32(rng.uniform(0.2, 0.9)))[..., None]
    return image + dark[..., None] * (inside - image)


def _with_debris(rng: Generator, image: Field) -> Field:
    """Flakes, stool, bubbles and mucus, pale or dark, alone or in swarms."""
    size = image.shape[:2]
    flakes = fractal_field(rng, size, log_uniform(rng, 4, 14), 3) + smooth_field(rng, size, log_uniform(rng, 30, 120))
    share = np.clip((flakes - rng.uniform(1.6, 2.6)) * rng.uniform(1, 6), 0, 1) * np.float32(rng.uniform(0.4, 1))
    tone = colorsys.hsv_to_rgb(rng.uniform(0.06, 0.16), rng.uniform(0.05, 0.6), rng.uniform(0.2, 0.95))
    return image + share[..., None] * (np.array(tone, np.float32) - image)


def _lit(rng: Generator, albedo: Field) -> Field:
    """(h, w, 3) the surface under a lamp beside the camera: shading of folds, distance, highlights."""
    h, w = albedo.shape[:2]
    relief = fractal_field(rng, (h, w), log_uniform(rng, 25, 130), 6, rng.uniform(0.3, 0.52))
    if rng.random() < 0.3:  # folds
        fold = smooth_field(rng, (h, w), log_uniform(rng, 15, 60))
        relief += rng.uniform(0.3, 1.0) * ridges(fold, rng.uniform(0.2, 0.8)) ** 2
    relief = cv2.GaussianBlur(relief, (0, 0), rng.uniform(0.6, 2.0))
    slope_x, slope_y = cv2.Sobel(relief, cv2.CV_32F, 1, 0), cv2.Sobel(relief, cv2.CV_32F, 0, 1)
    steep = np.float32(log_uniform(rng, 0.12, 0.7)) / max(float(np.sqrt(np.mean(slope_x**2 + slope_y**2))), 1e-6)
    slope_x, slope_y = slope_x * steep, slope_y * steep
    y, x = np.mgrid[:h, :w].astype(np.float32)
    lamp_x, lamp_y = rng.normal(w / 2, w / 4), rng.normal(h / 2, h / 4)
    tilt_x, tilt_y = (x - lamp_x) / w * rng.uniform(0.2, 1.2), (y - lamp_y) / h * rng.uniform(0.2, 1.2)
    facing = 1 / np.sqrt(1 + (slope_x + tilt_x) ** 2 + (slope_y + tilt_y) ** 2)
    distance = 1 + rng.uniform(0, 1.4) * (((x - lamp_x) / w) ** 2 + ((y - lamp_y) / h) ** 2) * 4
    light = facing ** rng.uniform(0.6, 3) / distance * (1 + 0.3 * rng.random() * np.clip(relief, -1.5, 1.5))
    image = albedo * light[..., None]
    image *= np.float32(rng.uniform(0.3, 1.1)) / max(float(np.percentile(image[::4, ::4].max(-1), 90)), 1e-3)
    if rng.random() < 0.85:  # wet gloss: where a finely rough surface faces the lamp
        wet, spot = rng.uniform(0.03, 0.25), log_uniform(rng, 3, 14)
        gloss_x = slope_x + wet * fractal_field(rng, (h, w), spot, 2)
        gloss_y = slope_y + wet * fractal_field(rng, (h, w), spot, 2)
        off = (gloss_x + tilt_x) ** 2 + (gloss_y + tilt_y) ** 2
        image = image + (np.exp(-off / rng.uniform(0.002, 0.03)) * np.float32(rng.uniform(0.1, 1.2)))[..., None]
    return image


MATTE_PARTS = ((_with_vessels, 0.6), (_with_fat, 0.15), (_with_blood, 0.3), (_with_fibers, 0.1))
"""What lies on the organs and is shaded with them, and its share of the images."""
LIT_PARTS = ((_with_ligaments, 0.15), (_with_dark_corner, 0.1), (_with_cavity, 0.35), (_with_debris, 0.12))
"""What brings its own light, or takes it."""
