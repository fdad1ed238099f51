"""Relative depth: that of a Depth Anything network (L. Yang et al., NeurIPS 2024), and its scale. `H, W` image size.

Monocular networks predict depth up to an unknown scale, and inverse depth ("disparity") up to an unknown scale and
shift. Both are set once per clip from sample frames, so that the scaling adds no flicker. The network runs on this
machine through the transformers library.
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
from .hub_model import load_network

Kind = Literal["depth", "disparity"]
"""Meaning of the values: in `depth` near is small, in `disparity` near is large."""
DEFAULT_MODEL = "depth-anything/Depth-Anything-V2-Small-hf"
"""Name on the hub; about 100 MB, Apache-2.0."""
SHORT_SIDE_PX = 518
"""The image is resized so that its shorter side has this length, as in the training of the network."""
MEAN, STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)
"""ImageNet statistics that normalize the input, colors in [0, 1]."""
NEAR_PERCENT = 98.0
"""Percentile of disparity that represents the nearest tissue ..."""
NEAR_RATIO = 1.5
"""... assumed this many times nearer than the median. A disparity with unknown shift does not determine it."""
MAX_RATIO = 4.0
"""Depth is clipped to this ratio of the working distance."""


@dataclass(frozen=True)
class Reference:
    """How relative values of one clip map to mm."""

    middle: float
    """Median over the samples; maps to the working distance."""
    near: float
    """Percentile `NEAR_PERCENT` over the samples; used for disparity."""
    working_distance_mm: float
    """mm."""


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
