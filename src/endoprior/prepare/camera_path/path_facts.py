"""What is known of a camera path: how it moves the image, and how it shapes relative depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Kind = Literal["static", "turning", "translating", "forward", "backward", "unknown"]
MIN_CAMERA_SHIFT_PX = 1.5
"""A camera whose way shifts the image by less over such a gap (median) is at rest, px at a width of 640."""
OFF_PX, OFF_SHARE = 4.0, 0.5  # a step contradicts the images if its shift is off by more than both, px at 640
WAY = 0.2  # share of the shift that a way causes, below which the camera only turns
AXIAL = 0.7  # share of the length of the way along the optical axis, above which the camera drives along it
CONTRADICTED = 0.3  # share of such steps above which a path is wrong
TURN = 0  # column of `PathMotion.parts_px`
REACHES, LIKE = (1 / 8, 1 / 18, 1 / 36), 0.1
"""A point speaks for pixels within this distance, as a share of the width, and of this difference of log depth. What is
left at the points after one reach is spread over the next (successive corrections)."""
DOUBT = 0.05  # weight of no change beside that of one point at its place
SMALL_WIDTH = 160  # the change is computed at this width, px
MAX_DEPTH_RATIO = 6.0  # a distance is clipped to this ratio of the middle: the dark end of a tube has no measured one


@dataclass(frozen=True)
class PathMotion:
    """What a path does to the image."""

    shift_px: NDArray  # (T - 1,) mean shift from frame to frame; NaN where one of them is unexplained
    parts_px: NDArray  # (N, 3) shift over `GAP` frames by turning, sideways and along the axis
    axial: float  # length of the way along the optical axis, as a share of the length of all ways, 0..1
    ahead: float  # way along the optical axis, -1..1: its sum as a share of its length, > 0 forward
    px: float  # length of a pixel of an image 640 px wide

    @property
    def shares(self) -> NDArray:
        """(3,) shares of turning, sideways and along the axis."""
        total = self.parts_px.sum(0)
        return total / max(float(total.sum()), 1e-9)

    @property
    def kind(self) -> Kind:
        """Where its way leads; turning if it has hardly any."""
        if not len(self.parts_px):
            return "unknown"
        if np.median(self.parts_px.max(1)) < MIN_CAMERA_SHIFT_PX * self.px:
            return "static"
        if 1 - self.shares[TURN] < WAY:
            return "turning"
        return "translating" if self.axial < AXIAL else "forward" if self.ahead > 0 else "backward"

    @property
    def drives(self) -> bool:
        """Whether it drives along the optical axis."""
        return self.kind in ("forward", "backward")

    @property
    def reason(self) -> str:
        """The measurements in a few words."""
        words = "turning", "moving sideways", "moving forward" if self.ahead > 0 else "moving back"
        return ", ".join(f"{share:.0%} {word}" for share, word in zip(self.shares, words, strict=True))

    def contradicts(self, measured_px: NDArray) -> bool:
        """Whether the images shift otherwise than the path says. Args: measured_px: (T - 1,) NaN where unknown."""
        known = np.isfinite(self.shift_px) & np.isfinite(measured_px)
        off = np.abs(self.shift_px[known] - measured_px[known])
        wrong = (off > OFF_PX * self.px) & (off > OFF_SHARE * np.maximum(measured_px[known], self.shift_px[known]))
        return bool(known.any() and wrong.mean() > CONTRADICTED)


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
