"""Kinds of tissue: colors, vessels, fat, gloss and texture, the light, and what is in the way.

The shapes are those of `bowel`, but a liver has no narrow folds. Colors are display values in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Color = tuple[float, float, float]


@dataclass(frozen=True)
class TissueLook:
    """How one kind of tissue looks; the defaults are `bowel`."""

    loop: Color = (0.74, 0.40, 0.38)
    loop_pale: Color = (0.86, 0.60, 0.53)
    loop_dusky: Color = (0.56, 0.25, 0.31)
    """A loop's color, and those between which it varies."""
    floor: Color = (0.74, 0.46, 0.45)
    """Color of the mesentery between the loops."""
    fat: Color = (0.88, 0.70, 0.46)
    liver: Color = (0.40, 0.16, 0.14)
    trunk: Color = (0.38, 0.10, 0.16)
    twig: Color = (0.56, 0.13, 0.14)
    """Colors of thick and thin vessels."""
    vessels: tuple[float, float] = (0.62, 0.80)
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
        loop=(0.86, 0.70, 0.63),
        loop_pale=(0.93, 0.84, 0.77),
        loop_dusky=(0.80, 0.58, 0.55),
        floor=(0.88, 0.74, 0.66),
        fat=(0.93, 0.84, 0.66),
        liver=(0.52, 0.30, 0.25),
        trunk=(0.55, 0.32, 0.40),
        twig=(0.74, 0.40, 0.38),
        vessels=(0.40, 0.55),
        creases=0.7,
        wet=0.8,
        exposure=1.15,
    ),
    "fat": TissueLook(
        loop=(0.90, 0.73, 0.40),
        loop_pale=(0.94, 0.83, 0.56),
        loop_dusky=(0.84, 0.59, 0.32),
        floor=(0.86, 0.63, 0.40),
        fat=(0.92, 0.78, 0.44),
        trunk=(0.52, 0.15, 0.13),
        twig=(0.72, 0.30, 0.16),
        vessels=(0.50, 0.70),
        cover="fat",
        wet=1.25,
    ),
    "purple": TissueLook(
        loop=(0.42, 0.23, 0.29),
        loop_pale=(0.55, 0.33, 0.36),
        loop_dusky=(0.27, 0.14, 0.22),
        floor=(0.46, 0.27, 0.31),
        fat=(0.62, 0.46, 0.36),
        liver=(0.32, 0.14, 0.14),
        trunk=(0.16, 0.07, 0.14),
        twig=(0.27, 0.09, 0.14),
        vessels=(0.70, 0.88),
        creases=0.75,
        wet=1.2,
        exposure=0.50,
    ),
    "liver": TissueLook(
        loop=(0.42, 0.22, 0.16),
        floor=(0.42, 0.23, 0.17),
        liver=(0.42, 0.22, 0.16),
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
