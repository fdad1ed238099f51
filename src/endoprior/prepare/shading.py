"""Depth from the shading of one picture, without a network: the light sits at the camera.

Linear brightness falls with the square of distance, I = exposure * vignetting * albedo * cos(slope) / z^2, so that
log z = (constants - log I) / 2 (T. Okatani and K. Deguchi, CVIU 1997, for endoscopes). Albedo, slope and light that
bounces between folds are not known, and tissue seen obliquely is dark without being far. Only `RELIEF` of the formula's
relief is therefore believed: a guess at the shape, good enough to start from, not a measurement.

Shared letters: `H, W` image size, `h, w` that of the small pictures on which everything is computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, check_range, check_shape
from ..priors.specular import specular_likelihood

SMALL_WIDTH = 160
"""w: shading says nothing about finer detail, which is texture."""
GAMMA = 2.2
"""Exponent of the tone curve that is undone."""
DARKEST = 1e-3
"""Linear brightness below which pixels are not told apart."""
RELIEF = 0.25
"""Share of the formula's log depth that is believed: least squares gave 0.2 to 0.4 on phantom and real clip."""
VIGNETTING_SHARE = 0.5
"""Share of the darkening towards the corners put down to lens and light; the rest may be the scene's own shape."""
MAX_VIGNETTING = 3.0
"""Largest darkening of the corners that is believed, in log units."""
SMOOTH_SIGMA_PX, SMOOTH_LOG = 8.0, 1.0
"""Bilateral smoothing of log brightness: standard deviations in small px and in log units."""
MAX_RATIO = 2.0
"""Depth stays within this ratio of the working distance."""


@dataclass(frozen=True)
class ShadingModel:
    """What brightness means in one clip; the same for all of its frames."""

    size: tuple[int, int]
    """(W, H) of the pictures, px."""
    reference: NDArray[np.float32]
    """(h, w) usual log brightness, which tells exposure from change of the scene; NaN where never usable."""
    level: float
    """Log brightness, vignetting taken out, of tissue at the working distance."""
    vignetting: float
    """Log units by which corners are darker; falls with the square of the distance from the middle."""
    working_distance_mm: float
    """Median depth over the samples, mm."""

    def depth(self, rgb_u8: NDArray[np.uint8], usable: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Depth of one picture, whose exposure is found by the median change against the usual brightness.

        A change of exposure therefore moves nothing, and neither does one of less than half of the picture; a camera
        that approaches everything at once looks like a change of exposure and is not seen.

        Args:
            rgb_u8: (H, W, 3) of the size the model was fitted to, 0..255.
            usable: (H, W) False on tools and outside the picture; filled from around, as highlights are.
        Returns:
            (H, W) depth, mm, within a factor of `MAX_RATIO` of the working distance; the working distance everywhere
            where nothing is usable.
        Raises:
            ValueError: another size or type.
        """
        check_shape(f"rgb_u8:{self.size[1]},{self.size[0]},3", rgb_u8=rgb_u8)
        brightness, weight = _log_brightness(rgb_u8, usable)
        compared = (weight > 0.5) & np.isfinite(self.reference)
        if not (weight > 0.5).any():
            return np.full(rgb_u8.shape[:2], self.working_distance_mm, np.float32)
        # With nothing in common with the samples, the picture's own middle stands for the working distance.
        known = self.reference if compared.any() else np.full_like(self.reference, self.level)
        exposure = np.median((brightness - known)[compared if compared.any() else weight > 0.5])
        flat = brightness - exposure + self.vignetting * _square_radius(brightness.shape)
        smooth = cv2.bilateralFilter(_fill(flat, weight), 0, SMOOTH_LOG, SMOOTH_SIGMA_PX)
        log_ratio = np.float32(RELIEF / 2) * (np.float32(self.level) - smooth)
        limit = np.float32(np.log(MAX_RATIO))
        full = cv2.resize(np.clip(log_ratio, -limit, limit), self.size, interpolation=cv2.INTER_LINEAR)
        return np.float32(self.working_distance_mm) * np.exp(full)


def fit_shading(
    pictures: Sequence[NDArray[np.uint8]],
    usable: Sequence[NDArray[np.bool_]],
    working_distance_mm: float = 70.0,
) -> ShadingModel:
    """Find the constants of a clip from a few pictures spread over it.

    Args:
        pictures: (H, W, 3) each, 0..255.
        usable: (H, W) each, True on tissue.
        working_distance_mm: median depth to scale to, mm.
    Raises:
        ValueError: none, or of different sizes or types.
        InputError: no picture has a usable pixel.
    """
    check_range("working_distance_mm", working_distance_mm, 1, 1000)
    if not pictures or len(pictures) != len(usable):
        raise ValueError(f"pictures must come with one mask each; got {len(pictures)} and {len(usable)}")
    height, width = pictures[0].shape[:2]
    stack = []
    for rgb_u8, mask in zip(pictures, usable, strict=True):
        check_shape(f"rgb_u8:{height},{width},3", rgb_u8=rgb_u8)
        brightness, weight = _log_brightness(rgb_u8, mask)
        stack.append(np.where(weight > 0.5, brightness, np.nan))
    values = np.stack(stack)
    seen = np.isfinite(values).any(0)
    if not seen.any():
        raise InputError(
            "sample pictures: expected some usable tissue; got none. Check the masks, or choose other frames."
        )
    # Exposure first: otherwise the median over pictures would mix levels wherever masks differ.
    values -= np.array([np.nanmedian(v) if np.isfinite(v).any() else 0 for v in values], np.float32)[:, None, None]
    reference = np.full(seen.shape, np.nan, np.float32)
    reference[seen] = np.nanmedian(values[:, seen], 0)
    square = _square_radius(reference.shape)
    slope = np.polyfit(square[seen].astype(np.float64), reference[seen], 1)[0] if np.ptp(square[seen]) > 0.05 else 0.0
    vignetting = VIGNETTING_SHARE * float(np.clip(-slope, 0, MAX_VIGNETTING))
    level = float(np.median((reference + vignetting * square)[seen]))
    return ShadingModel((width, height), reference, level, vignetting, float(working_distance_mm))


def _log_brightness(
    rgb_u8: NDArray[np.uint8], usable: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) mean log of linear red over usable pixels without highlights, and (h, w) the share of such pixels.

    Red, because blood absorbs it least: vessels and hue change it less than they change green, blue or luminance.
    """
    check_shape("rgb_u8:H,W,3 usable:H,W", rgb_u8=rgb_u8, usable=usable)
    if rgb_u8.dtype != np.uint8:
        raise ValueError(f"rgb_u8 must be 8-bit; got {rgb_u8.dtype}")
    height, width = usable.shape
    size = (min(SMALL_WIDTH, width), max(round(height * min(SMALL_WIDTH, width) / width), 1))
    rgb = rgb_u8 * np.float32(1 / 255)
    counts = (usable & (specular_likelihood(rgb) < 0.5)).astype(np.float32)
    log_red = np.log(np.maximum(rgb[..., 0] ** np.float32(GAMMA), np.float32(DARKEST)))
    weight = cv2.resize(counts, size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(log_red * counts, size, interpolation=cv2.INTER_AREA)
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 0), weight


def _fill(values: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) values, those with little weight replaced by the mean around them, as far as it takes."""
    trust = np.where(weight > 0.5, weight, 0)
    filled, open_ = values.copy(), trust == 0
    sigma = 2.0
    while open_.any() and sigma < 4 * max(values.shape):
        share = cv2.GaussianBlur(trust, (0, 0), sigma)
        reached = open_ & (share > 0.02)
        filled[reached] = (cv2.GaussianBlur(values * trust, (0, 0), sigma)[reached]) / share[reached]
        open_ &= ~reached
        sigma *= 2
    filled[open_] = np.average(values, weights=trust)
    return filled


def _square_radius(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """(h, w) squared distance from the middle: 0 there, 1 in the corners."""
    height, width = shape
    x = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 - 1
    y = ((np.arange(height, dtype=np.float32) + 0.5) / height * 2 - 1)[:, None]
    # In px, so that the falloff is round.
    return (x * x * width * width + y * y * height * height) / np.float32(width * width + height * height)
