"""What happens between tissue and file: smoke, lens, exposure, white balance, border, noise, compression, overlays.

`h, w` image size. Colors in [0, 1], sRGB. Lengths in px of an image whose longer side is 256 px.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from .noise import Field, fractal_field, log_uniform, smooth_field

MAX_SMOKE = 0.85
"""Largest share of smoke in a color: through more of it, a tool cannot be told."""


def random_view(rng: Generator, size: tuple[int, int]) -> NDArray[np.bool_]:
    """(h, w) True inside the endoscope's image: whole, round, oval, octagonal, cut off, or between black strips."""
    h, w = size
    y, x = np.mgrid[:h, :w].astype(np.float32)
    kind = rng.choice(4, p=[0.55, 0.22, 0.13, 0.1])
    view = np.ones(size, bool)
    if kind == 0:
        return view
    middle_x, middle_y = w / 2 + rng.normal(0, 0.06) * w, h / 2 + rng.normal(0, 0.06) * h
    radius = rng.uniform(0.42, 0.72) * max(h, w)
    dx, dy = np.abs(x - middle_x), np.abs(y - middle_y) * np.float32(rng.uniform(0.85, 1.2))
    if kind == 1:
        return np.hypot(dx, dy) < radius
    if kind == 2:
        wide, high = rng.uniform(0.42, 0.6, 2) * (w, h)
        return (dx < wide) & (dy < high) & (dx / wide + dy / high < rng.uniform(1.3, 1.8))
    strip = int(rng.uniform(0.02, 0.15) * w)
    view[:, :strip] = view[:, w - strip :] = False
    if rng.random() < 0.4:
        view &= dy < h * rng.uniform(0.35, 0.5)
    return view


def photographed(rng: Generator, scene: Field, view: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(h, w, 3), 0..255: the scene (h, w, 3) as a file shows it; black beyond the view."""
    size = scene.shape[:2]
    image = scene.astype(np.float32)
    if rng.random() < 0.35:
        image = smoked(rng, image)
    if rng.random() < 0.5:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.8))
    if rng.random() < 0.08:
        image = cv2.filter2D(image, -1, motion_kernel(rng))
    if rng.random() < 0.3:
        small = rng.uniform(0.5, 0.85)
        image = cv2.resize(cv2.resize(image, None, fx=small, fy=small, interpolation=cv2.INTER_AREA), size[::-1])
    image = _toned(rng, np.maximum(image, 0))
    if rng.random() < 0.4:
        radius = rng.uniform(0.7, 2.5)
        image = image + rng.uniform(0.3, 2) * (image - cv2.GaussianBlur(image, (0, 0), radius))
    if rng.random() < 0.6:
        noise = rng.standard_normal(image.shape, np.float32)
        image = image + np.float32(log_uniform(rng, 0.003, 0.05)) * noise
    image_u8 = (np.clip(image, 0, 1) * 255).astype(np.uint8)
    if rng.random() < 0.1:
        _label(rng, image_u8)
    image_u8 = _bordered(rng, image_u8, view)
    if rng.random() < 0.6:
        quality = int(rng.uniform(25, 95))
        stored = cv2.imencode(".jpg", image_u8, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image_u8 = np.asarray(cv2.imdecode(stored, cv2.IMREAD_COLOR), np.uint8)
    return image_u8


def _bordered(rng: Generator, image_u8: NDArray[np.uint8], view: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(h, w, 3) black, gray or the room beside the view; its rim may be soft and dark."""
    if view.all():
        return image_u8
    inside = view.astype(np.float32)
    if rng.random() < 0.5:
        distance = cv2.distanceTransform(view.astype(np.uint8), cv2.DIST_L2, 3)
        inside *= np.clip(distance / rng.uniform(1, 14), 0, 1) ** rng.uniform(0.4, 1.5)
    beyond = np.full(3, rng.integers(0, 12) if rng.random() < 0.8 else rng.integers(12, 60), np.float32)
    if rng.random() < 0.15:  # the room, or light that the lens scatters
        glow = np.clip(smooth_field(rng, view.shape, log_uniform(rng, 10, 60)) - rng.uniform(0, 1.5), 0, 2)
        beyond = beyond + glow[..., None] * rng.uniform(10, 90, 3).astype(np.float32)
    return (beyond + inside[..., None] * (image_u8 - beyond)).clip(0, 255).astype(np.uint8)


def smoked(rng: Generator, image: Field) -> Field:
    """Smoke in front of all, as a haze or as plumes; tools stay tools under it, and smoke alone is none."""
    size = image.shape[:2]
    dense = rng.uniform(0.05, 0.7) if rng.random() < 0.7 else rng.uniform(0.5, 0.85)
    share = dense * (1 + 0.6 * fractal_field(rng, size, log_uniform(rng, 40, 200), 4))
    if rng.random() < 0.4:
        share = share * rng.uniform(0, 0.6) + rng.uniform(0.3, 0.85) * _plume(rng, size)
    share = np.clip(share, 0, MAX_SMOKE)
    tint = np.array([1, rng.uniform(0.75, 1.04), rng.uniform(0.6, 1.15)], np.float32)
    tint *= np.float32(rng.uniform(0.35, 0.95))
    return image + share[..., None] * (tint - image)


def _plume(rng: Generator, size: tuple[int, int]) -> Field:
    """(h, w) in [0, 1]: a billow of smoke with soft and hard edges, in a part of the view."""
    h, w = size
    y, x = np.mgrid[:h, :w].astype(np.float32)
    wide = log_uniform(rng, 0.15, 0.8) * w
    off = np.hypot(x - rng.uniform(0, w), (y - rng.uniform(0, h)) * rng.uniform(0.5, 2)) / wide
    billows = 0.35 * fractal_field(rng, size, log_uniform(rng, 15, 70), 4, 0.6)
    return np.clip((1 - off + billows) * log_uniform(rng, 0.8, 5), 0, 1)


def motion_kernel(rng: Generator) -> Field:
    """The path of a moving camera or tool: a line of 3 to 12 px."""
    size = int(rng.integers(3, 13))
    path = np.zeros((size, size), np.float32)
    cv2.line(path, (0, int(rng.integers(size))), (size - 1, int(rng.integers(size))), 1.0)
    return (path if rng.random() < 0.5 else path.T) / path.sum()


def _toned(rng: Generator, image: Field) -> Field:
    """Exposure, white balance, saturation, hue, contrast, vignette, and how the sensor saturates."""
    h, w = image.shape[:2]
    gray = image.mean(-1, keepdims=True)
    image = gray + np.float32(rng.uniform(0.6, 1.4)) * (image - gray)
    balance = rng.normal(0, 0.08 if rng.random() < 0.75 else 0.18, 3)
    balance -= balance.mean()
    image = np.maximum(image, 0) * np.exp(rng.normal(0, 0.22) + balance).astype(np.float32)
    if rng.random() < 0.04:  # narrow-band light, a failed white balance
        image = np.ascontiguousarray(image[..., rng.permutation(3)])
    if rng.random() < 0.3:  # a color matrix: other primaries, a shift of hue
        matrix = np.eye(3) + rng.normal(0, 0.05, (3, 3))
        image = np.maximum(image @ (matrix / matrix.sum(1, keepdims=True)).T.astype(np.float32), 0)
    if rng.random() < 0.6:
        y, x = np.mgrid[:h, :w].astype(np.float32)
        off = ((x / w - rng.uniform(0.35, 0.65)) ** 2 + (y / h - rng.uniform(0.35, 0.65)) ** 2) * 4
        image = image * (1 - rng.uniform(0, 0.7) * np.clip(off, 0, 1.35))[..., None]
    if rng.random() < 0.3:  # a spot in which the lamp overexposes
        y, x = np.mgrid[:h, :w].astype(np.float32)
        radius = log_uniform(rng, 12, 110)
        off = ((x - rng.uniform(0, w)) ** 2 + (y - rng.uniform(0, h)) ** 2) / radius**2
        image = image * np.exp(rng.uniform(0.4, 2.2) * np.exp(-off / 2))[..., None]
    image = image ** np.float32(np.exp(rng.normal(0, 0.15)))
    knee = np.float32(rng.uniform(0.6, 1))
    above = np.maximum(image - knee, 0) / np.maximum(1 - knee, np.float32(1e-3))
    return np.where(image > knee, knee + (1 - knee) * (1 - np.exp(-above)), image)


def _label(rng: Generator, image_u8: NDArray[np.uint8]) -> None:
    """Draw text, a frame or a ruler of the recorder into the image: no tool."""
    h, w = image_u8.shape[:2]
    color = ((255, 255, 255), (50, 255, 50), (255, 255, 25), (50, 125, 255))[rng.integers(4)]
    for _ in range(rng.integers(1, 4)):
        at = int(rng.uniform(0, 0.8) * w), int(rng.uniform(0.05, 1) * h)
        if rng.random() < 0.6:
            text = "".join(rng.choice(list("0123456789:/.ABCDEFLRTX ")) for _ in range(rng.integers(2, 14)))
            cv2.putText(image_u8, text, at, cv2.FONT_HERSHEY_SIMPLEX, rng.uniform(0.25, 0.6), color, 1, cv2.LINE_AA)
        else:
            end = int(at[0] + rng.integers(10, 90)), int(at[1] + rng.integers(10, 90))
            cv2.rectangle(image_u8, at, end, color, int(rng.integers(1, 3)))


def shadowed(rng: Generator, tissue: Field, covered: Field) -> Field:
    """(h, w, 3) tissue in the shadow of an instrument that covers (h, w)."""
    shift = np.array([[1, 0, rng.normal(0, 8)], [0, 1, rng.normal(0, 8)]], np.float32)
    shadow = cv2.warpAffine(covered, shift, covered.shape[::-1])
    width = int(log_uniform(rng, 2, 20))
    shadow = cv2.blur(cv2.blur(shadow, (width, width)), (width, width))
    uneven = np.clip(1 + 0.4 * smooth_field(rng, covered.shape, 50), 0, 1.5)
    return tissue * (1 - np.clip(rng.uniform(0.2, 0.8) * shadow * uneven, 0, 0.95))[..., None]
