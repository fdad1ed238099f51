"""Measure the borders around the endoscope image: where they are, and how the masks mark them.

Shared letters: `H, W` image size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..footage.border import Circle, Outline, Strips
from ..footage.overlays import find_static_overlays

LABEL_ON_TISSUE = 0.75
"""Least share of a text box that the masks mark as tissue; of the rim of a masked round border it is half."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class BorderFacts:
    """Borders around the endoscope image, and how much of them the masks mark as tissue."""

    strips: Strips
    """Static or black strips at the sides, px."""
    strips_as_tissue: float
    """Share of the strips' pixels that are marked as tissue; 0 without strips."""
    circle: Circle | None
    """Round border of the endoscope image."""
    outside_as_tissue: float
    """Share of the pixels outside the circle that are marked as tissue; 0 without a circle."""
    overlays: tuple[tuple[int, int, int, int], ...]
    """x, y, width, height of burned-in labels that are marked as tissue, px."""
    masked: Mask
    """(H, W) True on the pixels that the masks exclude as border, not as tool: see `footage.border.masked_border`."""


def measure_border(
    outline: Outline, images: list[NDArray[np.uint8]], tissue_masks: list[Mask], masked: Mask
) -> BorderFacts:
    """Measure how the masks mark the outline and the labels.

    Args:
        images, tissue_masks: of the samples; inverted masks are corrected.
        masked: from `footage.border.masked_border`.
    """
    tissue = np.mean(tissue_masks, axis=0)
    return BorderFacts(
        outline.strips,
        _mean(tissue[outline.in_strip]),
        outline.circle,
        _mean(tissue[outline.outside]),
        tuple(b for b in find_static_overlays(images) if _is_label(b, tissue, outline.in_strip | outline.outside)),
        masked,
    )


def _is_label(box: tuple[int, int, int, int], tissue: NDArray[np.floating], border: Mask) -> bool:
    """Whether a text box lies inside the border, and the masks mark most of it as tissue."""
    x, y, width, height = box
    inside = slice(y, y + height), slice(x, x + width)
    return _mean(tissue[inside]) > LABEL_ON_TISSUE and _mean(border[inside]) < 0.5


def _mean(values: NDArray) -> float:
    return float(values.mean()) if values.size else 0.0
