"""How close rendered color is to the true one: PSNR and SSIM, as the published protocol defines them.

Shared letters: `H, W` image size. `image` and `target` are (H, W, 3) rendered and true color in [0, 1];
`scored_mask` is (H, W) True = the pixel counts: the tissue, or a part of the image. A frame without any scores NaN.
Sums are in float64. The protocol measures 8-bit images: round rendered color with `to_uint8` first. ValueError
is raised where shapes differ, the mask is not bool, or an image is not finite floating point. Sources: the evaluation
of EndoGaussian and EndoPrior-GS (docs/paper_map.md), Wang et al. 2004 for SSIM.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape
from ...core.ranges import evenly_spaced
from ...footage.image_operations import Mask
from ..score import Score, ScoreUnavailable

if TYPE_CHECKING:
    from ..context import EvaluationContext

TRAINING_FRAMES = 8  # Of these the PSNR is that of training
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5  # Side and standard deviation of the Gaussian window, px
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""Stabilizers of the luminance term, and of that of contrast and structure, for images in [0, 1]."""
SCORES = (
    Score(
        "psnr", "PSNR", "dB", True, 2,
        "The published one: both images are multiplied by the tissue mask, the mean squared error is over the frame.",
        compare="absolute", group="image", hint="as published: tools count as equal",
    ),
    Score(
        "psnr_tissue", "tissue PSNR", "dB", True, 2,
        "PSNR over the tissue pixels alone.",
        compare="absolute", group="image", hint="above 35 dB hard to tell from the frame",
    ),
    Score(
        "psnr_train", "training PSNR", "dB", True, 2,
        "Tissue PSNR of up to 8 training frames; far above that of held-out ones, what lies between is left to chance.",
        compare="absolute", group="image", in_summary=False,
    ),
    Score(
        "ssim", "SSIM", "", True, 4,
        "Structural similarity of the masked images over the frame.",
        compare="absolute", group="image", hint="1 is identical",
    ),
    Score(
        "strict_psnr", "strict PSNR", "dB", True, 2,
        "PSNR over the tissue pixels of rendered color that is not rounded to 8 bits.",
        compare="absolute", group="image", in_summary=False,
    ),
    Score(
        "strict_ssim", "strict SSIM", "", True, 4,
        "SSIM averaged over the tissue pixels, of rendered color that is not rounded to 8 bits.",
        compare="absolute", group="image", in_summary=False,
    ),
    Score(
        "seam_psnr", "seams", "dB", True, 2,
        "Tissue PSNR of frames in which two windows overlap, minus that of the others; scenes of several windows only.",
        group="image", hint="0: the borders do not show",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split; of several windows also their borders."""
    rows = []
    for frame in context.frames:
        rendered, true = context.rendered[frame.index], (frame.rgb, frame.tissue_mask)
        image, color = rendered.rgb, rendered.color
        row = {"psnr": psnr(image, *true), "psnr_tissue": psnr_tissue(image, *true), "ssim": ssim(image, *true)}
        rows.append(row | {"strict_psnr": psnr_tissue(color, *true), "strict_ssim": ssim_tissue(color, *true)})
    context.add_frames(rows, "no tissue in the split")
    with context.skip_if_unavailable("psnr_train"):
        if context.split == "train":
            raise ScoreUnavailable("the split is that of training")
        context.reject_slow_frames()
        trained = context.sequence.frames("train")
        chosen = [trained[k] for k in evenly_spaced(len(trained), TRAINING_FRAMES)]
        values = [psnr_tissue(context.rendered[f.index].rgb, f.rgb, f.tissue_mask) for f in chosen]
        context.add_mean("psnr_train", values, "no tissue in training frames")
    with context.skip_if_unavailable("seam_psnr"):
        scene = context.scene
        if len(scene.windows) == 1:
            return
        scored = [(row["time"], row["psnr_tissue"]) for row in context.result.per_frame if "psnr_tissue" in row]
        values = np.array([value for _, value in scored])
        at_seam = np.array([len(scene.shown_at(time)) > 1 for time, _ in scored], bool)
        some = at_seam.any() and not at_seam.all()
        difference = float(values[at_seam].mean() - values[~at_seam].mean()) if some else np.nan
        context.add("seam_psnr", difference, "no frame of the split lies in an overlap of windows, or all do")


@dataclass(frozen=True)
class SquaredErrors:
    """The squared color errors of one frame."""

    total: float  # Sum over the tissue pixels and the three channels
    of_tissue: int  # Number of values in the sum: 3 for each tissue pixel
    of_frame: int  # Number of values of the whole frame: 3 for each pixel


def squared_errors(image: NDArray, target: NDArray, scored_mask: Mask) -> SquaredErrors:
    """What a frame adds to `pooled_psnr`."""
    check_images(image, target, scored_mask)
    total = float(np.sum((image[scored_mask].astype(np.float64) - target[scored_mask].astype(np.float64)) ** 2))
    return SquaredErrors(total, 3 * int(scored_mask.sum()), image.size)


def pooled_psnr(frames: Sequence[SquaredErrors], *, over_frame: bool) -> float:
    """PSNR of all frames together, dB: -10 log10 of the sum of squared errors by the number of values. `over_frame`
    counts the whole frames, outside of the mask as correct: about 1 dB more where tissue fills 80 % of the frame.
    """
    total = sum(frame.total for frame in frames)
    if not sum(frame.of_tissue for frame in frames):
        return float("nan")
    count = sum(frame.of_frame if over_frame else frame.of_tissue for frame in frames)
    return float(-10 * np.log10(total / count)) if total > 0 else float("inf")


def psnr(image: NDArray, target: NDArray, scored_mask: Mask) -> float:
    """PSNR of the masked images over the whole frame, dB: the published one."""
    return pooled_psnr([squared_errors(image, target, scored_mask)], over_frame=True)


def psnr_tissue(image: NDArray, target: NDArray, scored_mask: Mask) -> float:
    """PSNR over the tissue pixels alone, dB."""
    return pooled_psnr([squared_errors(image, target, scored_mask)], over_frame=False)


def ssim(image: NDArray, target: NDArray, scored_mask: Mask) -> float:
    """Structural similarity of the masked images, averaged over all pixels and channels, in [-1, 1].

    Gaussian window of 11 px and sigma 1.5 px, zeros outside the frame, C1 = 0.01^2, C2 = 0.03^2. Windows that lie
    entirely outside the mask score 1, as in the published protocol.
    """
    return _mean(_ssim_map(image, target, scored_mask), scored_mask)


def ssim_tissue(image: NDArray, target: NDArray, scored_mask: Mask) -> float:
    """`ssim` averaged over the tissue pixels alone; within windows at their border the others are black."""
    return _mean(_ssim_map(image, target, scored_mask)[scored_mask], scored_mask)


def ssim_valid(image: NDArray, target: NDArray, scored_mask: Mask) -> float:
    """`ssim` over the windows that lie completely inside the frame; NaN for a frame smaller than the window."""
    border = SSIM_WINDOW // 2
    return _mean(_ssim_map(image, target, scored_mask)[border:-border, border:-border], scored_mask)


def _mean(values: NDArray[np.float64], scored_mask: Mask) -> float:
    return float(values.mean()) if scored_mask.any() and values.size else float("nan")


def _ssim_map(image: NDArray, target: NDArray, scored_mask: Mask) -> NDArray[np.float64]:
    """(H, W, 3) structural similarity of the masked images."""
    check_images(image, target, scored_mask)
    a = np.where(scored_mask[..., None], image, 0).astype(np.float64)
    b = np.where(scored_mask[..., None], target, 0).astype(np.float64)
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    variance_a = _window_mean(a * a) - mean_a * mean_a
    variance_b = _window_mean(b * b) - mean_b * mean_b
    covariance = _window_mean(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a * mean_a + mean_b * mean_b + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)
    return luminance * structure


def _window_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W, 3) Gaussian-weighted mean around each pixel; the frame is continued with zeros."""
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    kernel = np.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    kernel /= kernel.sum()
    mean = cv2.sepFilter2D(values, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(mean, np.float64)


def check_images(image: NDArray, target: NDArray, scored_mask: Mask) -> None:
    """Raise ValueError unless the three arrays fit together and both images are finite floating point."""
    counted = checked_mask(scored_mask)
    check_shape("image:H,W,3 target:H,W,3 scored_mask:H,W", image=image, target=target, scored_mask=counted)
    check_finite_float("image", image)
    check_finite_float("target", target)


def checked_mask(scored_mask: Mask) -> Mask:
    """The mask itself, or ValueError: `~` and indexing mean something else for integers."""
    if scored_mask.dtype != np.bool_:
        raise ValueError(f"scored_mask must be bool, True = score the pixel; got {scored_mask.dtype}")
    return scored_mask


def check_finite_float(name: str, values: NDArray) -> None:
    """Raise ValueError unless the values are floating point and all finite."""
    if not np.issubdtype(values.dtype, np.floating):
        raise ValueError(f"{name} must be floating point; got {values.dtype}. Divide 8-bit color by 255")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite; got {np.count_nonzero(~np.isfinite(values))} values that are not")
