"""The shape of relative depth, fixed by points that the camera's way triangulates, or by the light in a tube.

Depth from shading knows which tissue is far, not how far: brightness falls with the square of the distance r to the
lamp and with the cosine of the slope, and how much of either counts differs between a wall ahead and a tube. Where the
camera drives ahead, triangulated points say it: a power of the depth for the whole clip, log r = power * log d +
constant, and what is left at the points of each frame, spread over pixels of like depth around them. The lamp is at the
camera: r is the length of the ray, and z its part along the axis.

In a tube (colon, bronchus) where no points are triangulated, the light says it. A lamp at the camera lights a surface
with I = cos(slope) / r^2, and cos(slope) = D / r with the distance D of its tangent plane. D is the same for all of a
plane and of a straight tube around the camera: r = (D / I)^(1/3) gives both back; tissue that faces the lamp has r =
I^(-1/2). In a tube the wall recedes into one dark place and gets brighter in all directions from it; elsewhere a dark
place is a shadow or a hole, and its surroundings are of any brightness.

`h, w` size of the small images.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .follow import Follower
from .tracks import PoseInput, TrackingCamera

REACHES, LIKE = (1 / 8, 1 / 18, 1 / 36), 0.1
"""A point speaks for pixels within this distance, as a share of the width, and of this difference of log depth. What is
left at the points after one reach is spread over the next (successive corrections)."""
DOUBT = 0.05  # weight of no change beside that of one point at its place
SMALL_WIDTH = 160  # the change is computed at this width, px
MAX_DEPTH_RATIO = 6.0  # a distance is clipped to this ratio of the middle: the dark end of a tube has no measured one
PARALLAX_DEGREES = 2.0  # rays to a point differ by this, or its depth is that of the shading
MIN_OBSERVATIONS = 200  # observations of such points
MIN_POWER, MAX_POWER = 1.15, 6.0
CLEAR = 0.3  # share of the variance of log depth that the power explains
EXPONENT = 0.45  # of 1 / I, for r: between the two; phantoms of three seeds are best at 0.45 to 0.5
SHADED = 0.7  # share of the variance of log depth that brightness explains, if the depth is one from shading
LIGHT_WIDTH, BLUR_PX = 80, 1.5  # w where the light is looked at, and the smoothing, px: vessels and grain are no tube
DARK_PERCENT = 2.0  # of the tissue, for the dark place
DARKER = 0.8  # log by which it is darker than the median of the tissue; phantoms: 1.0 to 2.8
SECTORS, MIN_PX = 12, 30  # directions around the dark place, and px that one needs to count
RISES = 0.5  # correlation of log brightness and log distance from which on a direction gets brighter
MAX_RISE = 0.8  # share of the directions that do; phantoms of three seeds: 0.86 to 1
OFTEN = 0.5  # share of the frames that look so
Image, Mask = NDArray[np.uint8], NDArray[np.bool_]


@dataclass(frozen=True)
class DepthShape:
    """How relative depth d becomes z: `middle` (d / middle)^power `cosine`, and a change for each frame."""

    power: float
    middle: float
    cosine: NDArray[np.float32]  # (H, W) of the angle between the ray of a pixel and the axis
    pixels: list[NDArray]  # (N, 2) px of the points of each frame; an empty list without points ...
    change: list[NDArray]  # ... and (N,) the logarithm of their z as a multiple of that of the power and the scale

    def powered(self, depth: NDArray) -> NDArray[np.float32]:
        """Depth (H, W) with the power alone; 0 stays."""
        ratio = np.maximum(depth, 0) / self.middle
        clipped = np.clip(ratio**self.power, 1 / MAX_DEPTH_RATIO, MAX_DEPTH_RATIO)
        return np.asarray(np.where(ratio > 0, self.middle * clipped, 0) * self.cosine, np.float32)

    def shaped(self, index: int, depth: NDArray) -> NDArray[np.float32]:
        """(H, W) depth of a frame with the power and its change; 0 stays."""
        powered = self.powered(depth)
        if not self.pixels or not len(self.pixels[index]):
            return powered
        at, change = self.pixels[index], self.change[index]
        height, width = depth.shape
        size = SMALL_WIDTH, max(round(height * SMALL_WIDTH / width), 1)
        small = cv2.resize(powered, size, interpolation=cv2.INTER_NEAREST)
        log, px = np.log(np.maximum(small, 1e-3)), width / SMALL_WIDTH
        y, x = np.mgrid[: small.shape[0], : small.shape[1]].astype(np.float32) + 0.5
        spot = np.clip((at / px).astype(int), 0, np.array(small.shape[::-1]) - 1)
        left, field = change.astype(np.float32), np.zeros_like(log)
        for reach in REACHES:
            total, weight = np.zeros_like(log), np.full_like(log, DOUBT)
            for (u, v), (i, j), value in zip(at / px, spot, left, strict=True):
                near = ((x - u) ** 2 + (y - v) ** 2) / (reach * SMALL_WIDTH) ** 2 + ((log - log[j, i]) / LIKE) ** 2
                share = np.exp(-near / 2)
                total += share * value
                weight += share
            step = total / weight
            field, left = field + step, left - step[spot[:, 1], spot[:, 0]]
        factor = cv2.resize(np.exp(field), (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(powered * factor, np.float32)


def axial_cosine(camera: TrackingCamera) -> NDArray[np.float32]:
    """(H, W) cosine of the angle between the rays of the pixels and the axis."""
    x, y = np.meshgrid(*(np.arange(side, dtype=np.float64) for side in camera.size))
    k = camera.matrix
    return np.asarray(1 / np.sqrt(1 + ((x - k[0, 2]) / k[0, 0]) ** 2 + ((y - k[1, 2]) / k[1, 1]) ** 2), np.float32)


def fitted_shape(
    explained: NDArray[np.bool_], follower: Follower, cosine: NDArray[np.float32], before: DepthShape | None = None
) -> DepthShape | None:
    """The shape that triangulated points give the depth; `before` if there are too few, or they say little.

    Args:
        explained: (T,) frames whose points count.
        cosine: (H, W) of `axial_cosine`.
        before: what the depth that was followed has had applied already; None for nothing. One by light, without
            points, only gets another power: points that spoke too little at first rest on it now.
    """
    tracks, count = follower.tracks, len(explained)
    frame = np.repeat(np.arange(count), [len(ids) for ids in tracks.ids])
    ids, pixels = np.concatenate(tracks.ids), np.concatenate(tracks.pixels).astype(np.float64)
    depths = np.concatenate(tracks.depths).astype(np.float64)
    good = explained[frame] & tracks.adjusted[ids] & (tracks.weight[ids] > 0.3) & (depths > 0)
    frame, ids, pixels, depths = frame[good], ids[good], pixels[good], depths[good]
    if len(ids) < MIN_OBSERVATIONS:
        return before
    rays = tracks.points[ids] + np.einsum("nji,nj->ni", follower.poses[frame, :3, :3], follower.poses[frame, :3, 3])
    distance = np.linalg.norm(rays, axis=1)
    rays /= distance[:, None]
    order = np.lexsort((frame, ids))
    first = order[np.searchsorted(ids[order], ids, "left")]
    last = order[np.searchsorted(ids[order], ids, "right") - 1]
    z = np.einsum("nj,nj->n", follower.poses[frame, 2, :3], tracks.points[ids]) + follower.poses[frame, 2, 3]
    sure = (np.einsum("nj,nj->n", rays[first], rays[last]) < np.cos(np.deg2rad(PARALLAX_DEGREES))) & (z > 0)
    frame, pixels, depths, distance = frame[sure], pixels[sure], depths[sure], distance[sure]
    if len(distance) < MIN_OBSERVATIONS:
        return before
    if before is not None:
        column, row = np.clip(np.round(pixels).astype(int), 0, np.array(cosine.shape[::-1]) - 1).T
        depths = depths / cosine[row, column]
    x, y = (without_means(np.log(values), frame, count) for values in (depths, distance))
    slope, clear = robust_slope(x, y)
    power = slope * (before.power if before else 1.0)
    if not MIN_POWER < power < MAX_POWER or clear < CLEAR:
        return before
    if before is not None and not before.pixels:
        return replace(before, power=power)
    left = y - slope * x
    at = [np.flatnonzero(frame == f) for f in range(count)]
    middle = before.middle if before else float(np.exp(np.median(np.log(depths))))
    return DepthShape(power, middle, cosine, [pixels[k] for k in at], [left[k] for k in at])


def without_means(values: NDArray, frame: NDArray, count: int) -> NDArray:
    """(N,) values less the mean of their frame: each frame has a scale of its own."""
    total = np.bincount(frame, weights=values, minlength=count) / np.maximum(np.bincount(frame, minlength=count), 1)
    return values - total[frame]


def robust_slope(x: NDArray, y: NDArray) -> tuple[float, float]:
    """Slope of y by x through the origin, with robust weights, and the share of variance that it explains."""
    weight, slope = np.ones_like(x), 1.0
    for _ in range(10):
        slope = float((weight * x * y).sum() / max(float((weight * x * x).sum()), 1e-12))
        error = y - slope * x
        sigma = 1.4826 * float(np.median(np.abs(error))) + 1e-6
        weight = (1 / (1 + (error / (3 * sigma)) ** 2)) ** 2
    return slope, 1 - float((weight * error**2).sum() / max(float((weight * y**2).sum()), 1e-12))


def shape_by_light(frames: Iterable[PoseInput], cosine: NDArray[np.float32]) -> DepthShape | None:
    """The shape of depth from shading in a tube; None if at most half of the frames show one, or depth has another
    source. Depth that has the shape already stays. Args: cosine: (H, W) of `shape.axial_cosine`.
    """
    recedes, light, depth, number = [], [], [], []
    for k, seen in enumerate(frames):
        bright, usable = _brightness(seen.rgb_u8, seen.tissue_mask)
        recedes.append(_recedes(bright, usable))
        near = cv2.resize(seen.depth, usable.shape[::-1], interpolation=cv2.INTER_NEAREST)
        usable &= near > 0
        light.append(bright[usable])
        depth.append(near[usable])
        number.append(np.full(usable.sum(), k))
    if not recedes or np.mean(recedes) <= OFTEN:
        return None
    frame, depths = np.concatenate(number), np.concatenate(depth).astype(np.float64)
    x, y = (without_means(v, frame, len(recedes)) for v in (np.concatenate(light), np.log(depths)))
    slope, clear = robust_slope(x, y)
    power = -EXPONENT / slope if slope < 0 else 0.0
    if clear < SHADED or not MIN_POWER < power < MAX_POWER:
        return None
    return DepthShape(power, float(np.median(depths)), cosine, [], [])


def _brightness(rgb_u8: Image, tissue: Mask) -> tuple[NDArray, Mask]:
    """(h, w) smooth log of linear red, and where there is tissue to see it."""
    size = LIGHT_WIDTH, max(round(tissue.shape[0] * LIGHT_WIDTH / tissue.shape[1]), 1)
    share = cv2.resize(tissue.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    log_red = np.log(np.maximum((rgb_u8[..., 0] / np.float32(255)) ** np.float32(2.2), np.float32(1e-3)))
    total = cv2.resize(log_red * tissue, size, interpolation=cv2.INTER_AREA)
    total, weight = (cv2.GaussianBlur(image, (0, 0), BLUR_PX) for image in (total, share))
    return total / np.maximum(weight, 1e-3), share > 0.5


def _recedes(bright: NDArray, usable: Mask) -> bool:
    """Whether one frame gets brighter in nearly all directions from its dark place."""
    if usable.sum() < SECTORS * MIN_PX:
        return False
    limit, middle = np.percentile(bright[usable], [DARK_PERCENT, 50])
    if middle - limit < DARKER:
        return False
    dark = (usable & (bright <= limit)).astype(np.uint8)
    _, _, stats, centers = cv2.connectedComponentsWithStats(dark)
    x0, y0 = centers[1 + np.argmax(stats[1:, cv2.CC_STAT_AREA])]
    y, x = np.nonzero(usable)
    away = np.log(np.hypot(x - x0, y - y0) + BLUR_PX)
    sector = ((np.arctan2(y - y0, x - x0) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    parts = [at for k in range(SECTORS) if len(at := np.flatnonzero(sector == k)) > MIN_PX]
    rises = [_correlation(away[at], bright[y[at], x[at]]) > RISES for at in parts]
    return bool(rises) and float(np.mean(rises)) >= MAX_RISE


def _correlation(x: NDArray, y: NDArray) -> float:
    """Of two (N,), -1..1; 0 where one is constant, as overexposed tissue is."""
    return float(np.corrcoef(x, y)[0, 1]) if min(np.ptp(x), np.ptp(y)) > 1e-4 else 0.0
