"""Depth of one camera, which has no unit: from shading, or by a network, and scaled. `H, W` image size.

Shading assumes that the light source is at the camera. Linear brightness falls with the square of distance,
I = exposure * vignetting * albedo * cos(slope) / z^2, so that log z = (constants - log I) / 2 (T. Okatani and
K. Deguchi, CVIU 1997, for endoscopes). Albedo, slope and interreflections are unknown, and oblique tissue is dark
without being far. The relief of the formula is therefore scaled down by `RELIEF`: a rough shape, not a measurement.

The network is Depth Anything (L. Yang et al., NeurIPS 2024), run on this machine through the transformers library.
Such networks predict depth up to an unknown scale, and inverse depth ("disparity") up to an unknown scale and shift.
Both are set once per clip from sample frames, so that the scaling adds no flicker.

`h, w` size of the small images used for shading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..priors.specular import specular_likelihood
from .hub_model import load_network

Kind = Literal["depth", "disparity"]  # meaning of the values: in `depth` near is small, in `disparity` near is large
DEFAULT_MODEL = "depth-anything/Depth-Anything-V2-Small-hf"  # name on the hub; about 100 MB, Apache-2.0
SHORT_SIDE_PX = 518  # the image is resized so that its shorter side has this length, as in the training of the network
MEAN, STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)
"""ImageNet statistics that normalize the input, colors in [0, 1]."""
NEAR_PERCENT = 98.0  # percentile of disparity that represents the nearest tissue ...
NEAR_RATIO = 1.5
"""... assumed this many times nearer than the median. A disparity with unknown shift does not determine it."""
MAX_RATIO = 4.0  # depth is clipped to this ratio of the working distance
SMALL_WIDTH = 160  # w: finer detail is texture, not shading
GAMMA = 2.2  # exponent of the display gamma, which is inverted
DARKEST = 1e-3  # smallest linear brightness; darker pixels are clamped to it
RELIEF = 0.25  # share of the formula's log depth to use; least squares gave 0.2 to 0.4 on the phantom and a real clip
VIGNETTING_SHARE = 0.5
"""Share of the darkening towards the corners attributed to lens and light; the rest may be the shape of the scene."""
MAX_VIGNETTING = 3.0  # largest vignetting in the corners, log units
SMOOTH_SIGMA_PX, SMOOTH_LOG = 8.0, 1.0
"""Bilateral smoothing of log brightness: standard deviations in small px and in log units."""
MAX_SHADING_RATIO = 2.0  # depth is clipped to this ratio of the working distance


@dataclass(frozen=True)
class ShadingModel:
    """Mapping from brightness to depth, the same for all frames of a clip."""

    size: tuple[int, int]  # (W, H) of the images, px
    reference: NDArray[np.float32]
    """(h, w) median log brightness, used to estimate the exposure of a frame; NaN where never usable."""
    level: float  # log brightness of tissue at the working distance, corrected for vignetting
    vignetting: float  # log units by which the corners are darker; proportional to the squared distance from the center
    working_distance_mm: float  # median depth over the samples, mm

    def depth(self, rgb_u8: NDArray[np.uint8], usable: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Depth of one image. Its exposure is the median change of brightness against the reference.

        Exposure changes therefore do not change depth, nor do changes of less than half of the image. A camera that
        moves closer to everything looks like an exposure change and is not detected.

        Args:
            rgb_u8: (H, W, 3) of the size the model was fitted to, 0..255.
            usable: (H, W) False on tools and outside the field of view; like highlights, these are filled in.
        Returns:
            (H, W) depth, mm, within a factor of `MAX_SHADING_RATIO` of the working distance, which is everywhere if no
            pixel is usable.
        """
        brightness, weight = _log_brightness(rgb_u8, usable)
        compared = (weight > 0.5) & np.isfinite(self.reference)
        if not (weight > 0.5).any():
            return np.full(rgb_u8.shape[:2], self.working_distance_mm, np.float32)
        # Without pixels in common with the samples, the median of the image maps to the working distance.
        known = self.reference if compared.any() else np.full_like(self.reference, self.level)
        exposure = np.median((brightness - known)[compared if compared.any() else weight > 0.5])
        flat = brightness - exposure + self.vignetting * _square_radius(brightness.shape)
        smooth = cv2.bilateralFilter(_fill(flat, weight), 0, SMOOTH_LOG, SMOOTH_SIGMA_PX)
        log_ratio = np.float32(RELIEF / 2) * (np.float32(self.level) - smooth)
        limit = np.float32(np.log(MAX_SHADING_RATIO))
        full = cv2.resize(np.clip(log_ratio, -limit, limit), self.size, interpolation=cv2.INTER_LINEAR)
        return np.float32(self.working_distance_mm) * np.exp(full)


def fit_shading(
    images: Sequence[NDArray[np.uint8]],
    usable: Sequence[NDArray[np.bool_]],
    working_distance_mm: float = 70.0,
) -> ShadingModel:
    """Fit the constants of a clip to a few images spread over it.

    Args:
        images: (H, W, 3) each, 0..255.
        usable: (H, W) each, True on tissue.
        working_distance_mm: median depth to scale to, mm.
    Raises:
        InputError: no image has a usable pixel.
    """
    height, width = images[0].shape[:2]
    small = [_log_brightness(rgb_u8, mask) for rgb_u8, mask in zip(images, usable, strict=True)]
    values = np.stack([np.where(weight > 0.5, brightness, np.nan) for brightness, weight in small])
    seen = np.isfinite(values).any(0)
    if not seen.any():
        raise input_error("sample images", "usable tissue", "none", "Check the masks, or choose other frames.")
    # Remove exposure first: otherwise the median over images would mix brightness levels where masks differ.
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


def _fill(values: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) values; those with low weight are replaced by the mean of their neighborhood, which grows as needed."""
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
    """(h, w) squared distance from the image center: 0 at the center, 1 in the corners."""
    height, width = shape
    x = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 - 1
    y = ((np.arange(height, dtype=np.float32) + 0.5) / height * 2 - 1)[:, None]
    # In px, so that the falloff is circular.
    return (x * x * width * width + y * y * height * height) / np.float32(width * width + height * height)


@dataclass(frozen=True)
class Reference:
    """How relative values of one clip map to mm."""

    middle: float  # median over the samples; maps to the working distance
    near: float  # percentile `NEAR_PERCENT` over the samples; used for disparity
    working_distance_mm: float  # mm


def fit_reference(
    samples: Sequence[NDArray[np.floating]],
    usable: Sequence[NDArray[np.bool_]],
    kind: Kind,
    working_distance_mm: float = 70.0,
) -> Reference:
    """Fit the mapping to a few frames spread over the clip.

    Args:
        samples: (H, W) each, relative depth or disparity; values that are not finite, and depth <= 0, are ignored.
        usable: (H, W) each, True on tissue.
        working_distance_mm: median depth to scale to, mm.
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
    return Reference(middle, near, float(working_distance_mm))


def relative_to_mm(relative: NDArray[np.floating], kind: Kind, reference: Reference) -> NDArray[np.float32]:
    """Depth in mm: proportional to relative depth, or 1 / z linear in disparity.

    Args:
        relative: (H, W) values of one frame.
        reference: from `fit_reference` with the same kind.
    Returns:
        (H, W) depth, mm, within a factor of `MAX_RATIO` of the working distance; 0 where `relative` is invalid.
    """
    valid = _is_valid(relative, kind)
    value = np.where(valid, relative, reference.middle).astype(np.float64)
    if kind == "depth":
        ratio = value / reference.middle
    else:
        share = (value - reference.middle) / (reference.near - reference.middle)
        ratio = 1 / np.maximum(1 + share * (NEAR_RATIO - 1), 1 / MAX_RATIO)
    depth = reference.working_distance_mm * np.clip(ratio, 1 / MAX_RATIO, MAX_RATIO)
    return np.where(valid, depth, 0).astype(np.float32)


def _is_valid(relative: NDArray[np.floating], kind: Kind) -> NDArray[np.bool_]:
    """(H, W) True where a value is finite, and positive if it is a depth."""
    return np.isfinite(relative) & ((relative > 0) | (kind == "disparity"))


class DepthNetwork:
    """A Depth Anything network in memory."""

    def __init__(self, name_or_folder: str | Path = DEFAULT_MODEL) -> None:
        """Load it from a folder, from the library's cache, or from the hub.

        Raises:
            InputError: transformers is not installed, the files cannot be had, or they hold another network.
        """
        self._network = load_network(
            str(name_or_folder), DEFAULT_MODEL, "DepthAnythingForDepthEstimation", "a Depth Anything model",
            option="--depth depth-anything", extra="mono",
        )  # fmt: skip
        self._patch = int(self._network.config.patch_size)

    def inverse_depth(self, rgb_u8: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Relative inverse depth: near is large, scale and shift are unknown (`fit_reference` sets them).

        Args:
            rgb_u8: (H, W, 3) 0..255.
        Returns:
            (H, W), >= 0.
        """
        import torch

        height, width = rgb_u8.shape[:2]
        scale = SHORT_SIDE_PX / min(height, width)
        size = [max(round(side * scale / self._patch), 1) * self._patch for side in (width, height)]
        image = cv2.resize(rgb_u8.astype(np.float32) / np.float32(255), size, interpolation=cv2.INTER_CUBIC)
        pixels = np.ascontiguousarray(((image - MEAN) / STD).transpose(2, 0, 1)[None])
        with torch.inference_mode():
            inverse = self._network(pixel_values=torch.from_numpy(pixels)).predicted_depth[0].numpy()
        return cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR)
