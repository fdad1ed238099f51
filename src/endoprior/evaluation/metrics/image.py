"""How close one rendered frame is to its target: PSNR, SSIM and depth RMSE, as the published protocol defines them.

Shared letters: `H, W` image size. Masks are positive: True = tissue, the pixel counts. Sums are in float64. The
protocol measures 8-bit images: round rendered color with `to_uint8` first. Sources: the evaluation of EndoGaussian and
EndoPrior-GS (docs/paper_map.md), Wang et al. 2004 for SSIM.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape

SSIM_WINDOW = 11
"""Side of the Gaussian window, px."""
SSIM_SIGMA = 1.5
"""Standard deviation of the Gaussian window, px."""
SSIM_C1 = 0.01**2
"""Stabilizer of the luminance term for images in [0, 1]."""
SSIM_C2 = 0.03**2
"""Stabilizer of the contrast and structure term for images in [0, 1]."""


def to_uint8(image: NDArray) -> NDArray[np.uint8]:
    """(H, W, 3) color as an 8-bit file stores it: clipped to [0, 1], times 255, halves rounded up.

    Raises:
        ValueError: the image is not a finite floating-point array.
    """
    _check_finite_float("image", image)
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def psnr(image: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> float:
    """PSNR of the masked images over the whole frame, dB: the published one.

    Pixels outside the mask are black in both images and count as correct, so the value exceeds `psnr_tissue` by
    -10 log10(masked fraction of the frame), about 1 dB where tissue fills 80 % of it.

    Args:
        image: (H, W, 3) rendered color in [0, 1].
        target: (H, W, 3) true color in [0, 1].
        mask: (H, W) True = tissue.
    Returns:
        dB; infinity for equal images, NaN for an empty mask.
    Raises:
        ValueError: shapes differ, the mask is not bool, or an image is not finite floating point.
    """
    _check_images(image, target, mask)
    return _psnr_from_mse(_squared_error(image, target, mask).sum() / image.size) if mask.any() else float("nan")


def psnr_tissue(image: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> float:
    """PSNR over the tissue pixels alone, dB. Arguments, NaN and errors as `psnr`."""
    _check_images(image, target, mask)
    return _psnr_from_mse(_squared_error(image, target, mask).mean()) if mask.any() else float("nan")


def psnr_behind_tool(image: NDArray, tissue_truth: NDArray, mask: NDArray[np.bool_]) -> float:
    """PSNR of the pixels rendered behind the tool against the true tissue there, dB.

    Args:
        image: (H, W, 3) rendered color in [0, 1].
        tissue_truth: (H, W, 3) the same frame without the tool, in [0, 1].
        mask: (H, W) True = tissue; the pixels where it is False are scored.
    Returns:
        dB; infinity for equal images, NaN where the frame shows no tool.
    Raises:
        ValueError: as `psnr`.
    """
    return psnr_tissue(image, tissue_truth, ~_checked_mask(mask))


def ssim(image: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> float:
    """Structural similarity of the masked images, averaged over all pixels and channels.

    Gaussian window of 11 px and sigma 1.5 px, zeros outside the frame, C1 = 0.01^2, C2 = 0.03^2. Windows that lie
    entirely outside the mask score 1, as in the published protocol.

    Args:
        image: (H, W, 3) rendered color in [0, 1].
        target: (H, W, 3) true color in [0, 1].
        mask: (H, W) True = tissue.
    Returns:
        Value in [-1, 1]; 1 for equal images, NaN for an empty mask.
    Raises:
        ValueError: as `psnr`.
    """
    _check_images(image, target, mask)
    return float(_ssim_map(image, target, mask).mean()) if mask.any() else float("nan")


def ssim_tissue(image: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> float:
    """Structural similarity averaged over the tissue pixels alone. Window, constants, arguments and errors as `ssim`.

    Pixels outside the mask are black in both images, also within windows at its border.
    """
    _check_images(image, target, mask)
    return float(_ssim_map(image, target, mask)[mask].mean()) if mask.any() else float("nan")


def ssim_valid(image: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> float:
    """Structural similarity of the masked images over the windows that lie completely inside the frame.

    No zeros are added around the frame: 5 px at each border are no center of a window. Otherwise as `ssim`.

    Returns:
        Value in [-1, 1]; 1 for equal images, NaN for an empty mask or a frame smaller than the window.
    """
    _check_images(image, target, mask)
    border = SSIM_WINDOW // 2
    inside = _ssim_map(image, target, mask)[border:-border, border:-border]
    return float(inside.mean()) if mask.any() and inside.size else float("nan")


def _ssim_map(image: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(H, W, 3) structural similarity of the masked images."""
    a = np.where(mask[..., None], image, 0).astype(np.float64)
    b = np.where(mask[..., None], target, 0).astype(np.float64)
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    variance_a = _window_mean(a * a) - mean_a * mean_a
    variance_b = _window_mean(b * b) - mean_b * mean_b
    covariance = _window_mean(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a * mean_a + mean_b * mean_b + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)
    return luminance * structure


def depth_rmse(depth: NDArray, target: NDArray, valid: NDArray[np.bool_]) -> float:
    """Root mean square depth error over the valid pixels, in the unit of the depths (mm).

    A hole in the rendered depth (0) counts as an error of the full depth. Values outside `valid` may be anything.

    Args:
        depth: (H, W) rendered z, mm.
        target: (H, W) measured z, mm.
        valid: (H, W) True = score the pixel; the protocol uses tissue with measured depth > 0.
    Returns:
        mm; NaN where no pixel is valid.
    Raises:
        ValueError: shapes differ, `valid` is not bool, or a value at a valid pixel is not finite floating point.
            Ignoring such pixels would reward broken renders.
    """
    error = _valid_differences(depth, target, valid)
    return float(np.sqrt(np.mean(error * error))) if error.size else float("nan")


def depth_rmse_endogaussian(depth: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> float:
    """The depth figure that EndoGaussian's evaluation prints, only to compare with its published tables.

    Depths are truncated to 8 bits; differences and squares wrap modulo 256, so a 16 mm error counts as 0 and 20 mm as
    sqrt(144); the sum is divided by the whole frame. It is not an error in any unit: use `depth_rmse`.

    Args:
        depth: (H, W) rendered z, mm, >= 0.
        target: (H, W) measured z, mm, >= 0.
        mask: (H, W) True = tissue.
    Returns:
        A number without unit; NaN for an empty mask.
    Raises:
        ValueError: as `depth_rmse`.
    """
    return depth_rmse_8bit(depth, target, mask, mask.size)


def depth_rmse_8bit(depth: NDArray, target: NDArray, counted: NDArray[np.bool_], pixels: int) -> float:
    """A depth figure of 8-bit files: values, differences and squares wrap modulo 256. Not an error in any unit.

    Args:
        depth: (H, W) rendered z, mm, >= 0.
        target: (H, W) measured z, mm, >= 0.
        counted: (H, W) True = add the pixel's wrapped square.
        pixels: number that divides the sum: those of the frame, or the counted ones.
    Returns:
        A number without unit; NaN where no pixel counts.
    Raises:
        ValueError: as `depth_rmse`.
    """
    _valid_differences(depth, target, counted)
    if not counted.any():
        return float("nan")
    # The remainder first: casting a float above 255 straight to uint8 is undefined, one above 2^63 to any integer.
    a, b = (np.fmod(z[counted], 256).astype(np.int64).astype(np.uint8) for z in (depth, target))
    difference = a - b
    return float(np.sqrt(np.sum(difference * difference, dtype=np.int64) / pixels))


def _squared_error(image: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(num_masked, 3) squared color differences of the masked pixels."""
    return (image[mask].astype(np.float64) - target[mask].astype(np.float64)) ** 2


def _psnr_from_mse(mse: float) -> float:
    """-10 log10(mse), dB, for a peak of 1."""
    return float(-10 * np.log10(mse)) if mse > 0 else float("inf")


def _window_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W, 3) Gaussian-weighted mean around each pixel; the frame is continued with zeros."""
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    kernel = np.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    kernel /= kernel.sum()
    return cv2.sepFilter2D(values, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)


def _valid_differences(depth: NDArray, target: NDArray, valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(num_valid,) depth - target, mm, after the checks that `depth_rmse` promises."""
    check_shape("depth:H,W target:H,W valid:H,W", depth=depth, target=target, valid=_checked_mask(valid))
    _check_finite_float("depth at valid pixels", depth[valid])
    _check_finite_float("target at valid pixels", target[valid])
    return depth[valid].astype(np.float64) - target[valid].astype(np.float64)


def _check_images(image: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> None:
    """Raise ValueError unless the three arrays fit together and both images are finite floating point."""
    check_shape("image:H,W,3 target:H,W,3 mask:H,W", image=image, target=target, mask=_checked_mask(mask))
    _check_finite_float("image", image)
    _check_finite_float("target", target)


def _checked_mask(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask itself, or ValueError: `~mask` and `array[mask]` mean something else for integers."""
    if mask.dtype != np.bool_:
        raise ValueError(f"mask must be bool, True = score the pixel; got {mask.dtype}")
    return mask


def _check_finite_float(name: str, values: NDArray) -> None:
    """Raise ValueError unless the values are floating point and all finite."""
    if not np.issubdtype(values.dtype, np.floating):
        raise ValueError(f"{name} must be floating point; got {values.dtype}. Divide 8-bit color by 255")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite; got {np.count_nonzero(~np.isfinite(values))} values that are not")
