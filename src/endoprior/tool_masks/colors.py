"""Color features of a frame in units of its clip, and a first guess from them of where tools are.

Two facts separate tools from tissue in most clips: blood makes tissue red, while metal and plastic are mostly neutral;
and metal mirrors the lamp, so that bright and dark lie next to each other. Both are measured relative to the clip: its
white is the level of its highlights, and its typical chroma is the median over matte pixels. A clip of pale tissue so
gives the same features as one of red tissue. The guess is coarse (yellow fat and pale organs pass as tools), but good
enough to say which pixels are surely tissue.

`H, W` image size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape

DARK = 0.04
"""Added to every channel before the logarithm: about the noise of dark pixels, which have no reliable color."""
MATTE = (0.08, 0.6)
"""A pixel whose largest channel is above the first and whose smallest is below the second shows a surface's color, not
noise and not a highlight."""
FEATURES_PX = 384
"""Longer side of the images that the radii of the features are made for: a shaft is about 30 px wide, a jaw 6."""
NEUTRAL = 0.45
"""Chroma, as a share of that of the surroundings, at which neutrality has dropped to 1/e."""
SURROUNDINGS_PX = 30
"""Standard deviation of the window that gives the chroma of the surroundings, px."""
LEAST_CHROMA = 0.05
"""Smallest typical chroma: in a clip of gray images the noise of the colors is not divided by nearly 0."""
WEIGHTS = {
    "redness": -0.6,
    "blueness": -6.7,
    "yellowness": 3.5,
    "neutrality": 6.4,
    "neutral_edges": 7.0,
    "contrast": 16.2,
}
"""Logistic regression of tool against tissue on pixels of `bowel_lift` (also paler and enlarged), the tool-free part of
`mono_endo` (also with pasted tools) and a phantom. Fitted without one of the three, it separates the tools of the
third with an area under the curve of 0.89 to 0.93, 0.77 to 0.88, and 0.996 (docs/log.md)."""
OFFSET = -3.3
MOST_LOG_ODDS = 5.0


@dataclass(frozen=True)
class ClipColors:
    """What the colors of one clip are measured by."""

    white: float
    """Brightness of the highlights, 0..255."""
    redness: float
    """Median of log(red / green) over matte pixels."""
    blueness: float
    """Median of log(blue / green) over matte pixels."""
    chroma: float
    """Median of the length of (log(red / green), log(blue / green)) over matte pixels."""

    @staticmethod
    def of(images: Sequence[NDArray[np.uint8]], views: Sequence[NDArray[np.bool_]]) -> ClipColors:
        """Measure a few frames.

        Args:
            images: (H, W, 3) each, 0..255.
            views: (H, W) each, True inside the endoscope's image.
        """
        levels = []
        for image, view in zip(images, views, strict=True):
            check_shape("image:H,W,3 view:H,W", image=image, view=view)
            levels.append(image[::4, ::4].max(-1)[view[::4, ::4]])
        level = np.concatenate(levels)
        white = max(float(np.percentile(level, 99.5)), 1.0) if level.size else 255.0
        parts = []
        for image, view in zip(images, views, strict=True):
            color = image.astype(np.float32) / np.float32(white)
            matte = view & (color.max(-1) > MATTE[0]) & (color.min(-1) < MATTE[1])
            parts.append(np.stack([x[matte] for x in log_ratios(color)]))
        red, blue = np.concatenate(parts, 1)
        if not red.size:
            return ClipColors(white, LEAST_CHROMA, 0.0, LEAST_CHROMA)
        redness, chroma = (max(float(np.median(x)), LEAST_CHROMA) for x in (red, np.hypot(red, blue)))
        return ClipColors(white, redness, float(np.median(blue)), chroma)


def log_ratios(color: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """log(red / green) and log(blue / green), (H, W) each, of `color` (H, W, 3), where 1 is the clip's white."""
    log_color = np.log(color + np.float32(DARK))
    return log_color[..., 0] - log_color[..., 1], log_color[..., 2] - log_color[..., 1]


def first_guess(rgb_u8: NDArray[np.uint8], view: NDArray[np.bool_], clip: ClipColors) -> NDArray[np.float32]:
    """Log-odds of a tool at each pixel, from color and contrast alone.

    Args:
        rgb_u8: (H, W, 3), 0..255; its longer side is `FEATURES_PX`.
        view: (H, W) True inside the endoscope's image.
    Returns:
        (H, W), in [-5, 5].
    """
    weight = view.astype(np.float32)

    def mean(x: NDArray[np.float32], px: float) -> NDArray[np.float32]:
        """Gaussian mean over the pixels of the view."""
        return cv2.GaussianBlur(x * weight, (0, 0), px) / np.maximum(cv2.GaussianBlur(weight, (0, 0), px), 1e-3)

    color = cv2.GaussianBlur(rgb_u8, (0, 0), 0.8).astype(np.float32) / np.float32(clip.white)
    red, blue = log_ratios(color)
    chroma = np.hypot(red, blue)
    neutral = np.exp(-((chroma / (NEUTRAL * np.maximum(mean(chroma, SURROUNDINGS_PX), 0.3 * clip.chroma))) ** 2))
    tone = np.sqrt(color.mean(-1) + np.float32(0.01))
    edges = np.hypot(cv2.Sobel(tone, cv2.CV_32F, 1, 0), cv2.Sobel(tone, cv2.CV_32F, 0, 1))
    shift = (blue - clip.blueness) / clip.chroma
    features = {
        "redness": np.clip(red / clip.redness, -1, 3),
        "blueness": np.clip(shift, 0, 3),
        "yellowness": np.clip(-shift, 0, 3),
        "neutrality": mean(neutral, 8),
        "neutral_edges": mean(neutral * edges, 6),
        "contrast": np.sqrt(np.maximum(mean(tone * tone, 4) - mean(tone, 4) ** 2, 0)),
    }
    log_odds = OFFSET + sum(np.float32(WEIGHTS[name]) * feature for name, feature in features.items())
    return np.clip(log_odds, -MOST_LOG_ODDS, MOST_LOG_ODDS).astype(np.float32)
