"""Depth of one camera, which has no unit: from shading, or by a network, and scaled. `H, W` image size.

Shading assumes that the light source is at the camera. Linear brightness falls with the square of distance,
I = exposure * vignetting * albedo * cos(slope) / z^2, so that log z = (constants - log I) / 2 (T. Okatani and
K. Deguchi, CVIU 1997, for endoscopes). Albedo, slope and interreflections are unknown, and oblique tissue is dark
without being far. The relief of the formula is therefore scaled down by `RELIEF`: a rough shape, not a measurement.

Networks predict depth up to an unknown scale, and inverse depth ("disparity") up to an unknown scale and shift.
Both are set once per clip from sample frames, so that the scaling adds no flicker.

`h, w` size of the small images used for shading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..priors.specular import specular_likelihood

NEAR_PERCENT = 98.0  # percentile of disparity that represents the nearest tissue ...
NEAR_RATIO = 1.5  # ... assumed this many times nearer than the median: its unknown shift does not determine it
MAX_RATIO = 4.0  # depth is clipped to this ratio of the working distance
SMALL_WIDTH = 160  # w: finer detail is texture, not shading
GAMMA = 2.2  # exponent of the display gamma, which is inverted
DARKEST = 1e-3  # smallest linear brightness; darker pixels are clamped to it
RELIEF = 0.25  # share of the formula's log depth to use; least squares gave 0.2 to 0.4 on the phantom and a real clip
VIGNETTING_SHARE = 0.5  # of the darkening towards the corners; the rest may be the shape of the scene
MAX_VIGNETTING = 3.0  # largest vignetting in the corners, log units
SMOOTH_SIGMA_PX, SMOOTH_LOG = 8.0, 1.0  # bilateral smoothing of log brightness: standard deviations, small px and log
MAX_SHADING_RATIO = 2.0  # depth is clipped to this ratio of the working distance
Image, Mask = NDArray[np.uint8], NDArray[np.bool_]


@dataclass(frozen=True)
class ShadingModel:
    """Mapping from brightness to depth, the same for all frames of a clip."""

    size: tuple[int, int]  # (W, H) of the images, px
    reference: NDArray  # (h, w) median log brightness, for the exposure of a frame; NaN where never usable
    level: float  # log brightness of tissue at the working distance, corrected for vignetting
    vignetting: float  # log units by which the corners are darker; proportional to the squared distance from the center
    working_distance_mm: float  # median depth over the samples, mm

    def depth(self, rgb_u8: Image, usable: Mask) -> NDArray:
        """(H, W) depth, mm, of one image (H, W, 3), within `MAX_SHADING_RATIO` times the working distance.

        Its exposure is the median change of brightness against the reference. Exposure changes therefore do not change
        depth, nor do changes of less than half of the image. A camera that moves closer to everything looks like an
        exposure change and is not detected.

        Args:
            usable: (H, W) False on tools and outside the field of view; like highlights, these are filled in.
        """
        brightness, weight = _log_brightness(rgb_u8, usable)
        seen = weight > 0.5
        if not seen.any():
            return np.full(rgb_u8.shape[:2], self.working_distance_mm, np.float32)
        known, compared = self.reference, seen & np.isfinite(self.reference)
        if not compared.any():  # without pixels in common with the samples, the median maps to the working distance
            known, compared = np.full_like(self.reference, self.level), seen
        exposure = np.median((brightness - known)[compared])
        flat = brightness - exposure + self.vignetting * _square_radius(brightness.shape)
        smooth = cv2.bilateralFilter(_fill(flat, weight), 0, SMOOTH_LOG, SMOOTH_SIGMA_PX)
        log_ratio = np.float32(RELIEF / 2) * (np.float32(self.level) - smooth)
        limit = np.float32(np.log(MAX_SHADING_RATIO))
        full = cv2.resize(np.clip(log_ratio, -limit, limit), self.size, interpolation=cv2.INTER_LINEAR)
        return np.float32(self.working_distance_mm) * np.exp(full)


def fit_shading(images: Sequence[Image], usable: Sequence[Mask], working_distance_mm: float = 70.0) -> ShadingModel:
    """Fit the constants of a clip to a few images (H, W, 3) spread over it; InputError if no pixel is usable (H, W)."""
    height, width = images[0].shape[:2]
    small = [_log_brightness(rgb_u8, mask) for rgb_u8, mask in zip(images, usable, strict=True)]
    values = np.stack([np.where(weight > 0.5, brightness, np.nan) for brightness, weight in small])
    seen = np.isfinite(values).any(0)
    if not seen.any():
        fix = "Check masks and exposure, or choose other frames."
        raise input_error("sample images", "tissue that is neither masked nor white", "none", fix)
    # Remove exposure first: otherwise the median over images would mix brightness levels where masks differ.
    values -= np.array([np.nanmedian(v) if np.isfinite(v).any() else 0 for v in values], np.float32)[:, None, None]
    reference = np.full(seen.shape, np.nan, np.float32)
    reference[seen] = np.nanmedian(values[:, seen], 0)
    square = _square_radius(reference.shape)
    slope = np.polyfit(square[seen].astype(np.float64), reference[seen], 1)[0] if np.ptp(square[seen]) > 0.05 else 0.0
    vignetting = VIGNETTING_SHARE * float(np.clip(-slope, 0, MAX_VIGNETTING))
    level = float(np.median((reference + vignetting * square)[seen]))
    return ShadingModel((width, height), reference, level, vignetting, float(working_distance_mm))


def _log_brightness(rgb_u8: Image, usable: Mask) -> tuple[NDArray, NDArray]:
    """(h, w) mean log of linear red over usable pixels without highlights, and (h, w) the share of such pixels.

    Red, because blood absorbs it least: vessels change it less than they change green, blue or luminance.
    """
    height, width = usable.shape
    size = (min(SMALL_WIDTH, width), max(round(height * min(SMALL_WIDTH, width) / width), 1))
    rgb = rgb_u8 * np.float32(1 / 255)
    counts = (usable & (specular_likelihood(rgb) < 0.5)).astype(np.float32)
    log_red = np.log(np.maximum(rgb[..., 0] ** np.float32(GAMMA), np.float32(DARKEST)))
    weight = cv2.resize(counts, size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(log_red * counts, size, interpolation=cv2.INTER_AREA)
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 0), weight


def _fill(values: NDArray, weight: NDArray) -> NDArray:
    """(h, w) values; those with low weight are replaced by the mean of their neighborhood, which grows as needed."""
    trust = np.where(weight > 0.5, weight, 0)
    filled, open_, sigma = values.copy(), trust == 0, 2.0
    while open_.any() and sigma < 4 * max(values.shape):
        share = cv2.GaussianBlur(trust, (0, 0), sigma)
        reached = open_ & (share > 0.02)
        filled[reached] = (cv2.GaussianBlur(values * trust, (0, 0), sigma)[reached]) / share[reached]
        open_ &= ~reached
        sigma *= 2
    filled[open_] = np.average(values, weights=trust)
    return filled


def _square_radius(shape: tuple[int, ...]) -> NDArray:
    """(h, w) squared distance from the image center in px, so that it is circular; 1 in the corners."""
    height, width = shape
    x = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 - 1
    y = ((np.arange(height, dtype=np.float32) + 0.5) / height * 2 - 1)[:, None]
    return (x * x * width * width + y * y * height * height) / np.float32(width * width + height * height)


@dataclass(frozen=True)
class RelativeScale:
    """How relative values of one clip map to mm."""

    kind: Literal["depth", "disparity"]  # in `depth` near is small, in `disparity` near is large
    middle: float  # median over the samples; maps to the working distance
    near: float  # percentile `NEAR_PERCENT` over the samples; used for disparity
    working_distance_mm: float

    @classmethod
    def fit(
        cls, kind: Literal["depth", "disparity"], samples: Sequence[NDArray], usable: Sequence[Mask],
        working_distance_mm: float = 70.0,
    ) -> RelativeScale:  # fmt: skip
        """Fit the mapping to a few frames (H, W) spread over the clip, where they are usable, (H, W), and valid.

        Raises:
            InputError: no usable value, or constant disparity.
        """
        values = np.concatenate([s[mask & _is_valid(s, kind)] for s, mask in zip(samples, usable, strict=True)])
        if not values.size:
            raise input_error(f"relative {kind}", "values on tissue", "none", "Check the masks and the depth files.")
        middle, near = (float(v) for v in np.percentile(values.astype(np.float64), [50, NEAR_PERCENT]))
        if kind == "disparity" and not near > middle:
            got = f"{middle:g} almost everywhere"
            raise input_error("relative disparity", "values that vary", got, "Check the depth files.")
        return cls(kind, middle, near, float(working_distance_mm))

    def mm(self, relative: NDArray) -> NDArray:
        """(H, W) depth, within a factor of `MAX_RATIO` of the working distance; 0 where `relative` (H, W) is invalid.

        It is proportional to relative depth; 1 / z is linear in disparity.
        """
        valid = _is_valid(relative, self.kind)
        value = np.where(valid, relative, self.middle).astype(np.float64)
        if self.kind == "depth":
            ratio = value / self.middle
        else:
            share = (value - self.middle) / (self.near - self.middle)
            ratio = 1 / np.maximum(1 + share * (NEAR_RATIO - 1), 1 / MAX_RATIO)
        depth = self.working_distance_mm * np.clip(ratio, 1 / MAX_RATIO, MAX_RATIO)
        return np.where(valid, depth, 0).astype(np.float32)


def _is_valid(relative: NDArray, kind: str) -> Mask:
    return np.isfinite(relative) & ((relative > 0) | (kind == "disparity"))
