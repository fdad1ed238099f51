"""Phantoms of the benchmark: each family of instruments over two kinds of tissue, with exact masks.

The phantom is rendered in three dimensions and shares nothing with the painted instruments of the training, so all of
it is new to the network.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from endoprior.data.images import read_color, read_tool_mask
from endoprior.phantom import PhantomConfig, write_phantom

from .benchmark import TestFrame

FAMILIES = ("gray_blue", "black", "white_plastic", "steel", "gold", "green", "blue", "mixed")
TISSUES = ("bowel", "pale", "fat", "purple", "liver", "warm", "smoke", "blood")
FRAMES = 6
SIZE = (320, 256)
"""(width, height), px."""


def phantom_sets() -> dict[str, tuple[PhantomConfig, ...]]:
    """The phantoms of each line of the table: two for each family; every tissue occurs twice."""
    sets = {}
    for i, family in enumerate(FAMILIES):
        sets[f"phantom: {family}"] = tuple(
            PhantomConfig(
                frames=FRAMES,
                width=SIZE[0],
                height=SIZE[1],
                seed=i,
                side_views=False,
                instruments=family,
                tissue=TISSUES[(i + shift) % len(TISSUES)],
            )
            for shift in (0, 3)
        )
    return sets


def phantom_frames(folder: Path, phantoms: tuple[PhantomConfig, ...]) -> Iterator[TestFrame]:
    """The frames of some phantoms; written to `folder` once."""
    for config in phantoms:
        place = folder / f"{config.instruments}_{config.tissue}"
        if not place.exists():
            write_phantom(place, config)
        for i in range(config.frames):
            tools = read_tool_mask(place / "masks" / f"{i:06d}.png")
            whole = np.ones_like(tools)
            image = read_color(place / "images" / f"{i:06d}.png")
            yield TestFrame(f"{config.instruments} on {config.tissue} {i}", image, whole, tools, whole)
