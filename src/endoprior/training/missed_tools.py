"""Tool pixels that a mask misses, found while training: a tool is what the scene cannot explain.

Found masks miss jaws, blurred ends, and tools that are there for a moment. Trained as tissue, they become a ghost. The
scene is shared by all frames, so a few frames of a tool do not change it much at first: the error of the rendered
image shows the tool. Where the error stays far above that of the frame, in a region that continues a masked tool or
enters from the border as tools do, and of which the tool network is not sure of tissue, pixels do not count in this
iteration. The decision is made anew each time a frame is drawn: no state, and what the scene learns to explain counts
again.

`H, W` image size, `h, w` size of the resized image, 160 px on its longer side.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..tool_masks.regions import disk, entering_regions, filled

WORK_PX = 160
"""Longer side of the resized image, px: a shaft is about 12 px wide, a jaw 3."""
START = 0.1
"""Share of the fine stage after which the scene explains resting tissue."""
SMOOTH_PX = 3.0
"""Standard deviation of the window over which the error is averaged, px."""
SURE, POSSIBLE = (3.0, 0.02), (1.5, 0.01)
"""Errors of a missed tool, as a multiple of the frame's median error plus a constant (colors are 0..1): a pixel on its
own, and a pixel near such pixels (hysteresis)."""
NEAR_PX = 8
"""A possible pixel counts within this distance of a sure one."""
GAP_PX = 6
"""Gaps up to twice this width are closed: the middle of a shaft is often explained by its own color."""
HIGHLIGHT = (0.5, 0.7)
"""Smallest color channel from which, and up to which, an error counts less: highlights move on tissue too."""
SURELY_TISSUE = -3.0
"""Log-odds of a tool below which a pixel always counts."""


def missed_tools(
    rendered: NDArray[np.float32],
    rgb: NDArray[np.float32],
    tissue_mask: NDArray[np.bool_],
    view: NDArray[np.bool_],
    surely_tissue: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """(h, w) True on pixels of `tissue_mask` that show a tool rather than tissue.

    Args:
        rendered, rgb: (h, w, 3) color in [0, 1].
        tissue_mask: (h, w) True on tissue, as the mask has it.
        view: (h, w) True inside the endoscope's image.
        surely_tissue: (h, w) True where the tool network is sure of tissue.
    """
    if not tissue_mask.any():
        return np.zeros_like(tissue_mask)
    shine = cv2.dilate(np.clip((rgb.min(-1) - HIGHLIGHT[0]) / (HIGHLIGHT[1] - HIGHLIGHT[0]), 0, 1), disk(2))
    weight = (tissue_mask * (1 - shine) + 1e-3).astype(np.float32)
    error = np.abs(rendered - rgb).mean(-1) * weight
    error = cv2.GaussianBlur(error, (0, 0), SMOOTH_PX) / cv2.GaussianBlur(weight, (0, 0), SMOOTH_PX)
    usual = float(np.median(error[tissue_mask]))
    open_to_doubt = tissue_mask & ~surely_tissue
    sure, possible = ((error > factor * usual + least) & open_to_doubt for factor, least in (SURE, POSSIBLE))
    seed = cv2.morphologyEx(sure.astype(np.uint8), cv2.MORPH_OPEN, disk(2))
    if not seed.any():
        return np.zeros_like(tissue_mask)
    body = (seed > 0) | (possible & (cv2.dilate(seed, disk(NEAR_PX)) > 0))
    tools = view & ~tissue_mask
    closed = cv2.morphologyEx((body | tools).astype(np.uint8), cv2.MORPH_CLOSE, disk(GAP_PX))
    closed = filled(closed, closed.size)
    added = closed & tissue_mask & (cv2.dilate(body.astype(np.uint8), disk(GAP_PX)) > 0)
    added = cv2.morphologyEx(added.astype(np.uint8), cv2.MORPH_OPEN, disk(2)) > 0
    entering = entering_regions((added | tools).astype(np.uint8), view) & added
    return (cv2.dilate(entering.astype(np.uint8), disk(1)) > 0) & tissue_mask
