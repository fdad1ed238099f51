"""Kinds of tissue, and their material maps: color, fine relief, wetness and ambient occlusion.

The shapes of all kinds are those of `bowel`, but a liver has no narrow folds. Colors of kinds are display values in
[0, 1]. Letters: (TH, TW) texels; texel (i, j) is at g_u = (j + 0.5) / TW, g_v = (i + 0.5) / TH.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .noise import cells, fractal
from .surface import FLOOR, LIVER, Anatomy, Organs, Plane, organs_at, soften

TREES = 1000
"""Number of trees, over the whole tissue of a camera that stands still."""
_TISSUE_MM2 = 30_000
"""Its usual size."""
_STEP_MM = 0.7
_SUBPIXEL_BITS = 4


class _Branch(NamedTuple):
    """One vessel to be grown: start (a, b) mm, heading rad, caliber and length mm."""

    start: NDArray[np.float64]
    heading: float
    caliber: float
    length: float


def vessel_maps(
    plane: Plane, a: NDArray, b: NDArray, organs: Organs, rng: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """Grow trees from random points; each stays on its own organ and splits into thinner branches.

    Returns:
        two float32 maps in [0, 1] on the material grid a, b (TH, TW): trunks (caliber above 0.3 mm) and twigs.
    """
    shape = a.shape
    mm_per_texel = float(np.abs(np.diff(a[shape[0] // 2])).mean())
    trunks, twigs = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    low, high = np.array([a.min(), b.min()]), np.array([a.max(), b.max()])
    trees = round(TREES * np.prod(high - low) / _TISSUE_MM2) if plane.metric else TREES
    pending = []
    for _ in range(trees):
        start, heading = rng.uniform(low, high), rng.uniform(0, 2 * np.pi)
        caliber = 0.16 + 0.34 * rng.uniform() ** 4
        pending.append(_Branch(start, heading, caliber, rng.uniform(10, 26)))
    while pending:
        branch = pending.pop()
        points, children = _grow(branch, plane, organs, rng)
        pending.extend(children)
        texels = np.stack(plane.grid(points[:, 0], points[:, 1]), -1) * [shape[1], shape[0]] - 0.5
        fixed = np.round(texels * 2**_SUBPIXEL_BITS).astype(np.int32).reshape(-1, 1, 2)
        target = trunks if branch.caliber > 0.3 else twigs
        # Pieces of four steps taper to half the caliber, so that no vessel ends bluntly.
        for k in range(0, len(fixed) - 1, 4):
            caliber = branch.caliber * (1 - 0.5 * k * _STEP_MM / branch.length)
            width = caliber / mm_per_texel
            # Lines are at least one texel wide; thinner vessels are fainter instead.
            strength = int(255 * min(1.0, width) * (0.55 + 0.45 * min(1.0, caliber / 0.35)))
            piece = fixed[k : k + 5]
            cv2.polylines(target, [piece], False, strength, max(1, round(width)), cv2.LINE_AA, _SUBPIXEL_BITS)
    # Vessels lie under the serosa, trunks deeper than twigs.
    blurred = (
        cv2.GaussianBlur(drawn, (0, 0), max(depth_mm / mm_per_texel, 0.4)).astype(np.float32) / 255
        for drawn, depth_mm in ((trunks, 0.11), (twigs, 0.06))
    )
    return next(blurred), next(blurred)


def _grow(branch: _Branch, plane: Plane, organs: Organs, rng: np.random.Generator) -> tuple[NDArray, list[_Branch]]:
    """Walk one branch until it is long enough or leaves its organ; return its points (n, 2) and its children."""
    count = max(2, int(branch.length / _STEP_MM))
    # A slow oscillation gives the winding course, white noise the small kinks.
    turns = rng.normal(0, 0.16, count) + 0.16 * np.sin(np.arange(count) * rng.uniform(0.2, 0.5) + rng.uniform(0, 6.3))
    headings = branch.heading + np.cumsum(turns)
    points = branch.start + np.cumsum(_STEP_MM * np.stack([np.cos(headings), np.sin(headings)], -1), 0)
    grid_u, grid_v = plane.grid(points[:, 0], points[:, 1])
    height, width = organs.owner.shape
    row = np.clip((grid_v * height).astype(int), 0, height - 1)
    column = np.clip((grid_u * width).astype(int), 0, width - 1)
    owner = organs.owner[row, column]
    inside = (grid_u >= 0) & (grid_u < 1) & (grid_v >= 0) & (grid_v < 1)
    stays = inside & (owner == owner[0]) & (owner != LIVER)
    length = count if stays.all() else int(stays.argmin())
    children = []
    if branch.caliber > 0.10:
        for k in np.flatnonzero(rng.uniform(size=length) < 0.17):
            heading = headings[k] + rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.1)
            caliber = branch.caliber * rng.uniform(0.5, 0.72)
            left = (branch.length - k * _STEP_MM) * rng.uniform(0.5, 0.8) + 1
            children.append(_Branch(points[k], heading, caliber, left))
    return points[:length], children


CHANNELS = 7
"""Red, green, blue (linear albedo in [0, 1]), relief slope along a and b, wetness and openness in [0, 1]."""

SMOOTHED = 0.92
"""Share of the color detail and of the fine relief that a smooth patch lacks."""
PATCH_BLUR_MM = 6.0
"""Color detail smaller than this is taken out of smooth patches."""
_INK = np.array([0.125, 0.0045, 0.0035], np.float32)
"""Linear color of deep blood."""
_POOLED = 0.72
"""Share of the blood that lies in pools; the rest is in streaks."""


Color = tuple[float, float, float]


@dataclass(frozen=True)
class TissueLook:
    """How one kind of tissue looks; the defaults are `bowel`."""

    loops: tuple[Color, Color, Color] = ((0.74, 0.40, 0.38), (0.86, 0.60, 0.53), (0.56, 0.25, 0.31))
    """A loop's color, and the pale and the dusky one between which it varies."""
    ground: tuple[Color, Color, Color] = ((0.74, 0.46, 0.45), (0.88, 0.70, 0.46), (0.40, 0.16, 0.14))
    """Colors of the mesentery between the loops, of fat and of the liver."""
    vessels: tuple[Color, Color] = ((0.56, 0.13, 0.14), (0.38, 0.10, 0.16))
    """Colors of thin and thick vessels."""
    opacity: tuple[float, float] = (0.62, 0.80)
    """Opacity of thin and thick vessels, 0..1."""
    cover: Literal["serosa", "fat", "liver"] = "serosa"
    """What the loops are covered with: their texture and relief."""
    creases: float = 1.0
    """Factor of the depth of fine creases, and of the contrast of the liver's lobules."""
    wet: float = 1.0
    """Factor of the highlights of the wet film."""
    blurred_mm: float = 0.7
    """Radius within which shapes are smoothed, mm; at least 0.7."""
    blood: float = 0.0
    """Share of the tissue under blood, 0..1."""
    smoke: float = 0.0
    """Share of the light that the densest smoke takes away at 80 mm, 0..1."""
    light: Color = (1.0, 1.0, 1.0)
    """Color of the light, linear."""
    exposure: float = 1.0
    """Brightness of the image beside that of `bowel`."""


_BOWEL = TissueLook()
LOOKS = {
    "bowel": _BOWEL,
    "pale": TissueLook(
        loops=((0.86, 0.70, 0.63), (0.93, 0.84, 0.77), (0.80, 0.58, 0.55)),
        ground=((0.88, 0.74, 0.66), (0.93, 0.84, 0.66), (0.52, 0.30, 0.25)),
        vessels=((0.74, 0.40, 0.38), (0.55, 0.32, 0.40)),
        opacity=(0.40, 0.55),
        creases=0.7,
        wet=0.8,
        exposure=1.15,
    ),
    "fat": TissueLook(
        loops=((0.90, 0.73, 0.40), (0.94, 0.83, 0.56), (0.84, 0.59, 0.32)),
        ground=((0.86, 0.63, 0.40), (0.92, 0.78, 0.44), _BOWEL.ground[2]),
        vessels=((0.72, 0.30, 0.16), (0.52, 0.15, 0.13)),
        opacity=(0.50, 0.70),
        cover="fat",
        wet=1.25,
    ),
    "purple": TissueLook(
        loops=((0.42, 0.23, 0.29), (0.55, 0.33, 0.36), (0.27, 0.14, 0.22)),
        ground=((0.46, 0.27, 0.31), (0.62, 0.46, 0.36), (0.32, 0.14, 0.14)),
        vessels=((0.27, 0.09, 0.14), (0.16, 0.07, 0.14)),
        opacity=(0.70, 0.88),
        creases=0.75,
        wet=1.2,
        exposure=0.50,
    ),
    "liver": TissueLook(
        loops=((0.42, 0.22, 0.16), *_BOWEL.loops[1:]),
        ground=((0.42, 0.23, 0.17), _BOWEL.ground[1], (0.42, 0.22, 0.16)),
        cover="liver",
        creases=0.5,
        wet=1.1,
        blurred_mm=4.0,
        exposure=0.55,
    ),
    "warm": replace(_BOWEL, light=(1.12, 0.80, 0.46)),
    "smoke": replace(_BOWEL, smoke=0.66),
    "blood": replace(_BOWEL, blood=0.38, exposure=0.92),
}
"""By the values of `PhantomConfig.tissue`."""


def _linear(display: tuple[float, float, float]) -> NDArray:
    """(3,) linear light of a display color in [0, 1]."""
    return np.array(display, np.float32) ** np.float32(2.2)


def _step(low: float, high: float, x: NDArray) -> NDArray:
    """Smooth 0..1 transition of x between low and high."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def smooth_patches(a: NDArray, b: NDArray, seed: int, share: float) -> NDArray:
    """In [0, 1]: how little texture the tissue has at plane points `a, b`, mm; above 0.5 on `share` of the tissue."""
    rows, columns = np.mgrid[-60:60:1.0, -70:70:1.0].astype(np.float32)
    level = float(np.quantile(_patch_noise(columns, rows, seed), 1 - share))
    return _step(level - 0.12, level + 0.12, _patch_noise(a, b, seed)).astype(np.float32)


def _patch_noise(a: NDArray, b: NDArray, seed: int) -> NDArray:
    return fractal(a.astype(np.float32) / 19, b.astype(np.float32) / 19, 1, seed + 130)


def build_texture(
    plane: Plane,
    anatomy: Anatomy,
    width: int,
    height: int,
    smooth_share: float = 0.0,
    look: TissueLook = LOOKS["bowel"],
) -> NDArray:
    """(TH, TW, CHANNELS) material maps for a grid of `height` x `width` texels."""
    grid_v, grid_u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    a, b = plane.coordinates(grid_u, grid_v)
    a, b = a.astype(np.float32), b.astype(np.float32)
    mm_per_texel = float(np.diff(a[height // 2]).mean())
    organs = organs_at(anatomy, a, b)
    if look.blurred_mm > LOOKS["bowel"].blurred_mm:  # otherwise the mesh alone is smoothed, by less than matters here
        organs = replace(organs, height=soften(organs.height, mm_per_texel, look.blurred_mm))
    if look.cover == "liver":
        organs = replace(organs, owner=np.full_like(organs.owner, LIVER))
    rng = np.random.default_rng([anatomy.seed, 3])
    trunks, twigs = vessel_maps(plane, a, b, organs, rng)
    seed = anatomy.seed + 100
    # Patches with hardly any texture: pale, vessel-free serosa.
    plain = _step(0.12, 0.42, fractal(a / 21, b / 21, 1, seed))
    wrinkles = _wrinkles(organs, a, b, seed)
    albedo = _albedo(look, organs, a, b, plain, wrinkles, trunks, twigs, seed, rng, len(anatomy.paths))
    relief = _relief(look, organs, a, b, wrinkles, trunks, seed) * (1 - 0.6 * plain)
    if smooth_share > 0:
        patches = smooth_patches(a, b, anatomy.seed, smooth_share)
        albedo += (SMOOTHED * patches)[..., None] * (_blurred(albedo, mm_per_texel) - albedo)
        relief = relief * (1 - SMOOTHED * patches)
    wet = look.wet * np.clip(0.75 + 0.7 * fractal(a / 9, b / 9, 2, seed + 1), 0.25, 1)
    if look.blood > 0:
        albedo, relief, wet = bled(albedo, relief, wet, _blood_depth(organs, a, b, mm_per_texel, seed, look.blood))
    smooth = soften(relief.astype(np.float32), mm_per_texel, 0.09)
    texture = np.zeros((height, width, CHANNELS), np.float32)
    texture[..., :3] = albedo
    # Texel spacing in b is that of a to within the plane's foreshortening, which np.gradient gets from b itself.
    texture[..., 3] = np.gradient(smooth, axis=1) / np.gradient(a, axis=1)
    texture[..., 4] = np.gradient(smooth, axis=0) / np.gradient(b, axis=0)
    texture[..., 5] = wet
    texture[..., 6] = _openness(organs.height, mm_per_texel)
    return texture


def _coarse(values: NDArray, mm_per_texel: float) -> tuple[NDArray, float]:
    """A map at about half a mm per texel, and how many mm that is."""
    step = max(1, round(0.5 / mm_per_texel))
    return cv2.resize(values, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA), mm_per_texel * step


def _blurred(albedo: NDArray, mm_per_texel: float) -> NDArray:
    """(TH, TW, 3) color without detail smaller than `PATCH_BLUR_MM`."""
    small = soften(*_coarse(albedo, mm_per_texel), PATCH_BLUR_MM)
    return cv2.resize(small, albedo.shape[1::-1], interpolation=cv2.INTER_LINEAR)


def _wrinkles(organs: Organs, a: NDArray, b: NDArray, seed: int) -> NDArray:
    """Fine creases in [-1, 1]: across the axis on loops, in every direction elsewhere."""
    offset = 37.0 * organs.owner
    along = organs.along + 0.8 * fractal(a / 4, b / 4, 2, seed + 2)
    rings = fractal(along / 0.95 + offset, organs.across / 4.2, 3, seed + 3)
    crumpled = fractal(a / 1.5 + fractal(a / 3, b / 3, 1, seed + 5), b / 1.5, 3, seed + 4)
    return np.where(organs.owner >= 0, 0.6 * rings + 0.4 * crumpled, crumpled)


def _relief(
    look: TissueLook, organs: Organs, a: NDArray, b: NDArray, wrinkles: NDArray, trunks: NDArray, seed: int
) -> NDArray:
    """Fine height in mm that bends normals only: creases, grain, raised vessels, liver lobules."""
    strength = 0.55 + 0.9 * np.clip(fractal(a / 13, b / 13, 2, seed + 6) + 0.35, 0, 1)
    grain = fractal(a / 0.62, b / 0.62, 2, seed + 7)
    swell = fractal(a / 4.5, b / 4.5, 2, seed + 8)
    serosa = 0.34 * look.creases * strength * wrinkles + 0.030 * grain + 0.3 * swell + 0.10 * trunks
    lobules = 0.06 * np.minimum(cells(a / 1.25, b / 1.25, seed + 9), 0.5) + 0.02 * grain + 0.1 * swell
    if look.creases < 1:
        lobules = look.creases * lobules
    if look.cover == "fat":
        serosa = 0.36 * _lumps(a, b, seed) + 0.45 * serosa
    return np.where(organs.owner == LIVER, lobules, serosa).astype(np.float32)


def _lumps(a: NDArray, b: NDArray, seed: int) -> NDArray:
    """In [0, 1]: 0 in the seams between lumps of fat about 4 mm wide, 1 inside them."""
    bent = 1.2 * fractal(a / 5, b / 5, 2, seed + 30)
    return _step(-0.1, 0.8, cells((a + bent) / 4.2, (b - bent) / 4.2, seed + 31)).astype(np.float32)


def _albedo(
    look: TissueLook,
    organs: Organs,
    a: NDArray,
    b: NDArray,
    plain: NDArray,
    wrinkles: NDArray,
    trunks: NDArray,
    twigs: NDArray,
    seed: int,
    rng: np.random.Generator,
    loops: int,
) -> NDArray:
    """(TH, TW, 3) linear color in [0, 1]."""
    mottle = fractal(a / 6, b / 6, 4, seed + 20)
    fine = fractal(a / 1.1, b / 1.1, 3, seed + 21)
    loop, pale, dusky = map(_linear, look.loops)
    mesentery, fat, liver_color = map(_linear, look.ground)
    # Each loop has its own complexion between dusky and pale.
    complexion = np.concatenate([rng.uniform(-0.45, 0.35, max(64, loops)), [0, 0]]).astype(np.float32)[organs.owner]
    tone = np.clip(complexion - 0.12 + 0.95 * mottle, -1, 1)[..., None]
    color = loop + np.maximum(tone, 0) * (pale - loop) + np.maximum(-tone, 0) * (dusky - loop)
    fat_amount = _step(0.02, 0.34, fractal(a / 10, b / 10, 3, seed + 22)) * 0.85
    floor = mesentery + fat_amount[..., None] * (fat - mesentery)
    floor = floor * (1 + 0.25 * mottle[..., None])
    lobule = _step(0.0, 0.32, cells(a / 1.25, b / 1.25, seed + 9))
    if look.creases < 1:
        lobule = 1 - look.creases * (1 - lobule)
    liver = liver_color * (0.72 + 0.38 * lobule + 0.35 * mottle)[..., None]
    color = np.where((organs.owner == FLOOR)[..., None], floor, color)
    serosa = 1 + (1 - 0.75 * plain) * (0.26 * fine + 0.38 * wrinkles)
    color = color * serosa[..., None] + (0.25 * plain)[..., None] * (pale - color)
    shown = 1 - 0.8 * plain
    if look.cover == "fat":
        seams = 1 - _lumps(a, b, seed)
        color = color + (0.55 * seams)[..., None] * (dusky - color)
    for map_, ink, opacity in zip((twigs, trunks), look.vessels, look.opacity, strict=True):
        color = color + (opacity * shown * map_)[..., None] * (_linear(ink) - color)
    color = np.where((organs.owner == LIVER)[..., None], liver, color)
    return np.clip(color, 0.004, 1).astype(np.float32)


def _openness(height: NDArray, mm_per_texel: float) -> NDArray:
    """In (0, 1]: how much of the light reaches a point; small in the creases between organs."""
    small, spacing = _coarse(height, mm_per_texel)
    near, middle, far = (np.maximum(soften(small, spacing, radius) - small, 0) for radius in (1.5, 4.0, 9.0))
    buried = 0.55 * near + 0.25 * middle + 0.10 * far
    return cv2.resize(np.exp(-buried).astype(np.float32), height.shape[::-1], interpolation=cv2.INTER_LINEAR)


def _blood_depth(organs: Organs, a: NDArray, b: NDArray, mm_per_texel: float, seed: int, share: float) -> NDArray:
    """(TH, TW) in [0, 1]: how deep the blood is; above 0 on about `share` of the tissue."""
    sunken = soften(organs.height, mm_per_texel, 5.0) - organs.height
    pools = fractal(a / 13, b / 13, 3, seed + 40) + 0.16 * np.clip(sunken, -3, 4)
    # Streaks run down the image, winding.
    aside = a + 4 * fractal(a / 15, b / 15, 2, seed + 41)
    streaks = fractal(aside / 3.2, b / 26, 2, seed + 42) + 0.5 * fractal(a / 22, b / 22, 1, seed + 43)

    def above(field: NDArray, part: float, width: float) -> NDArray:
        # 0 below the level that `part` of the field exceeds, rising to 1 within `width` above it.
        return np.clip((field - np.quantile(field[::4, ::4], 1 - part)) / width, 0, 1)

    return np.maximum(above(pools, _POOLED * share, 0.34), 0.6 * above(streaks, (1 - _POOLED) * share, 0.30)).astype(
        np.float32
    )


def bled(albedo: NDArray, relief: NDArray, wet: NDArray, depth: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Linear color (TH, TW, 3), fine height (TH, TW), mm, and wetness (TH, TW) under blood of `depth` (TH, TW)."""
    covered = np.minimum(3 * depth, 1)
    # A film stains what is below it; depth hides it.
    stained = albedo * np.array([0.80, 0.22, 0.20], np.float32)
    color = albedo + covered[..., None] * (stained - albedo)
    color = color + (1 - np.exp(-3.5 * depth))[..., None] * (_INK - color)
    # The surface is smooth, and rises from its rim.
    smooth = relief * (1 - 0.85 * covered) + 0.35 * np.sqrt(depth)
    return color.astype(np.float32), smooth, wet + covered * (1.35 - wet)
