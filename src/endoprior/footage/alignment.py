"""Align two images directly by their brightness, where corners are few: coarse to fine, robust, with gain and bias.

A similarity transform is found by Gauss-Newton on images without shading, because the light moves with the camera. The
answer counts only where the images determine it, agree under it, and the way back is its inverse: a flat wall fits any
motion, and another scene none.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_operations import Image, Mask, components, regions_where, square

FINEST_PX, HALVINGS = 160, 2
"""Images are aligned at this width, after the halved ones. Finer detail is noise, or a pattern of sensor or fibers that
does not move with the view."""
FINE_SIGMA_PX, COARSE_SIGMA_PX = 1.5, 10.0  # detail between these scales is compared, px of the finest images
OUTLIER = 2.5  # residuals beyond this many standard deviations count little (Geman-McClure)
ROUNDS, CONVERGED_PX = 12, 0.02  # steps of Gauss-Newton on each level at most, and the step that ends them
MIN_OVERLAP_SHARE, MIN_OVERLAP_PX = 0.3, 100.0  # share of the usable pixels that both images show, and their number
MIN_GAIN = 0.2  # contrast of one image as a multiple of the other's
AGREEMENT = 0.6  # correlation of the aligned images; other scenes reach 0.45
SURE_PX = 0.5  # standard deviation of the mean shift, px of the finest images
ALIGNMENT_ROUND_TRIP_PX = 1.5  # distance between the way there and the way back, px of the finest images
BORDER_GRAY_LEVEL = 24  # gray level below which what touches the edge of both images is a border, which does not move
COARSEST_PX = 2  # least side of the coarsest images, px: OpenCV correlates none that are smaller
RIM_PX = 5  # what lies nearer to it than this is not used either, px of the finest images


def align(
    before: Image, now: Image, allowed_before: Image | Mask | None = None, allowed: Image | Mask | None = None
) -> NDArray | None:
    """(3, 3) similarity transform, px, from one gray image (h, w) to another; None if they do not determine one.

    Args:
        allowed_before, allowed: (h, w) True where the images show tissue; None: everywhere.
    """
    factor = min(1.0, FINEST_PX / before.shape[1])
    size = tuple(max(round(side * factor), 1) for side in before.shape[::-1])
    if min(size) < COARSEST_PX << HALVINGS:
        return None
    small = [np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8) for image in (before, now)]
    inside = ~_border(np.maximum(*small))
    pair = [_Level.of(image, mask, inside) for image, mask in zip(small, (allowed_before, allowed), strict=True)]
    shape = pair[0].detail.shape
    there = _similarity(*pair)
    back = None if there is None else _similarity(*pair[::-1])  # on its own: a wrong way there has no way back
    if there is None or back is None or mean_shift(back @ there, shape[1], shape[0]) > ALIGNMENT_ROUND_TRIP_PX:
        return None
    # Pixel centers count from 0, and images shrink about their corner.
    scale = np.array([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1]])
    return np.linalg.inv(scale) @ there @ scale


def mean_shift(matrix: NDArray, width: int, height: int) -> float:
    """Mean shift by a (3, 3) transform of 9 points spread over the image, px; also a zoom moves most of them."""
    x, y = np.meshgrid(np.array([1, 3, 5]) * width / 6, np.array([1, 3, 5]) * height / 6)
    grid = np.stack([x.ravel(), y.ravel()], 1)
    return float(np.hypot(*(grid @ matrix[:2, :2].T + matrix[:2, 2] - grid).T).mean())


class _Level:
    """An image as it is compared, at one size."""

    def __init__(self, detail: NDArray[np.float32], usable: NDArray[np.float32]) -> None:
        self.detail, self.usable = detail, usable  # (h, w) log brightness without shading; 1 on tissue, else 0

    @staticmethod
    def of(small: Image, mask: Image | Mask | None, inside: Mask) -> _Level:
        usable = inside.astype(np.float32)
        if mask is not None:
            shown = cv2.resize(mask.astype(np.uint8), small.shape[::-1], interpolation=cv2.INTER_NEAREST)
            usable *= cv2.erode(shown, np.ones((5, 5)), borderValue=(0,))
        usable *= small < 250  # saturated: neither color nor edges belong to the tissue
        bright = np.log(small.astype(np.float32) + 8)
        near, far = (_blurred(bright, usable, sigma) for sigma in (FINE_SIGMA_PX, COARSE_SIGMA_PX))
        return _Level((near - far) * usable, usable)

    def halved(self) -> _Level:
        size = (self.detail.shape[1] + 1) // 2, (self.detail.shape[0] + 1) // 2
        half = [cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (self.detail, self.usable)]
        return _Level(np.asarray(half[0], np.float32), (np.asarray(half[1]) > 0.9).astype(np.float32))


def _border(brighter: Image) -> Mask:
    """(h, w) True on the dark border of a clip and near it, from the brighter values of two images."""
    dark = brighter < BORDER_GRAY_LEVEL
    labels, boxes = components(dark)
    edge = np.zeros(len(boxes), bool)
    edge[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
    return cv2.dilate(regions_where(edge, labels).astype(np.uint8), square(RIM_PX)) > 0


def _blurred(values: NDArray, weight: NDArray, sigma: float) -> NDArray:
    """(h, w) mean of the neighborhood, by weight: what lies outside the tissue does not leak in."""
    total = cv2.GaussianBlur(values * weight, (0, 0), sigma)
    return total / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)


class _Fit(NamedTuple):
    """A transform between two images at one level."""

    agreement: float  # correlation of the aligned images, -1..1
    p: NDArray  # (4,) a, b, tx, ty: x -> center + (1 + a, b) (x - center) + t
    std: float  # standard deviation of the mean shift, px


def _similarity(before: _Level, now: _Level) -> NDArray | None:
    """(3, 3) transform between the finest levels; None if they do not determine one, or do not agree under it."""
    levels = [(before, now)]
    for _ in range(HALVINGS):
        levels.append((levels[-1][0].halved(), levels[-1][1].halved()))
    # Large motion: also start from where the coarsest images correlate best.
    shift, _ = cv2.phaseCorrelate(*(level.detail for level in levels[-1]))
    starts = [np.zeros(4), np.array([0, 0, *shift])]
    best = None
    for pair in reversed(levels):
        fits = [fit for start in starts if (fit := _refined(*pair, start)) is not None]
        if not fits:
            return None
        best = max(fits, key=lambda fit: fit.agreement)
        starts = [best.p * [1, 1, 2, 2]]
    assert best is not None
    sure = best.agreement > AGREEMENT and best.std < SURE_PX
    return _matrix(best.p, before.detail.shape) if sure else None


def _matrix(p: NDArray, shape: tuple[int, ...]) -> NDArray:
    """(3, 3) transform of the parameters of a fit. Args: shape: (h, w) of the image."""
    linear, center = np.array([[1 + p[0], -p[1]], [p[1], 1 + p[0]]]), np.array([shape[1] - 1, shape[0] - 1]) / 2
    out = np.eye(3)
    out[:2, :2], out[:2, 2] = linear, center + p[2:] - linear @ center
    return out


def _refined(before: _Level, now: _Level, p: NDArray) -> _Fit | None:
    """Gauss-Newton with robust weights, gain and bias; None if the images hardly overlap."""
    height, width = before.detail.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    u, v = x - (width - 1) / 2, y - (height - 1) / 2
    reach = float(np.sqrt((u * u + v * v).mean()))
    needed, best = max(MIN_OVERLAP_SHARE * float(before.usable.sum()), MIN_OVERLAP_PX), None
    for _ in range(ROUNDS):
        matrix, flags = _matrix(p, (height, width))[:2], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shown = cv2.warpAffine(now.detail, matrix, (width, height), flags=flags)
        used = (cv2.warpAffine(now.usable, matrix, (width, height), flags=flags) > 0.99) & (before.usable > 0)
        if used.sum() < needed:
            break
        gx, gy = (cv2.Scharr(shown, cv2.CV_32F, *axis, scale=1 / 32)[used] for axis in ((1, 0), (0, 1)))
        there, here, uu, vv = shown[used], before.detail[used], u[used], v[used]
        gain, bias = np.polyfit(there, here, 1) if np.ptp(there) > 0 else (1.0, 0.0)
        gain = max(float(gain), MIN_GAIN)
        error = gain * there + bias - here
        sigma = 1.4826 * float(np.median(np.abs(error))) + 1e-4
        weight = (1 / (1 + (error / (OUTLIER * sigma)) ** 2)) ** 2
        by = np.stack([gx * uu + gy * vv, gy * uu - gx * vv, gx, gy, there, np.ones_like(there)], 1)
        by[:, :4] *= gain
        normal, gradient = (by * weight[:, None]).T @ by, (by * weight[:, None]).T @ error
        normal += 1e-6 * np.diag(np.diag(normal)) + 1e-9 * np.eye(6)
        variance = np.diag(np.linalg.inv(normal)) * sigma**2
        std = float(np.sqrt(variance[2:4].sum() + reach**2 * variance[:2].sum()))
        # Neighboring pixels are blurred alike: they are no independent measurements.
        best = _Fit(_correlation(there, here, weight), p, 2 * FINE_SIGMA_PX * std)
        step = -np.linalg.solve(normal, gradient)[:4]
        p = p + step
        if max(np.abs(step[2:]).max(), reach * np.abs(step[:2]).max()) < CONVERGED_PX:
            break
    return best


def _correlation(a: NDArray, b: NDArray, weight: NDArray) -> float:
    """Weighted correlation of values (N,); 0 for those without variation."""
    a, b = a - np.average(a, weights=weight), b - np.average(b, weights=weight)
    norm = float(np.sqrt((weight * a * a).sum() * (weight * b * b).sum()))
    return float((weight * a * b).sum()) / norm if norm > 0 else 0.0
