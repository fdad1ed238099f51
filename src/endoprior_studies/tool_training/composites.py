"""Examples for the network that finds tools: tissue, instruments over it, seen through a camera; and what is what.

`h, w` is `SIZE`. Labels: 0 tissue and everything that is no tool, 1 tool, `IGNORED` where it cannot be told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from .camera import motion_kernel, photographed, random_view, shadowed
from .foreign_bodies import gauze, needle, ribbed_tube
from .instruments import NEAR_WIDTH_PX, WIDTH_PX, instrument
from .noise import Field, fractal_field, log_uniform
from .parts import Canvas
from .scope_tools import cap, catheter, clips
from .tissue import tissue

SIZE = (160, 192)
"""(h, w) of an example."""
IGNORED = 255
REAL = 0.45
"""Share of the examples on real frames, where there are any."""
NUMBER = (0.32, 0.36, 0.24, 0.08)
"""Probability of 0 to 3 instruments."""
NEAR = 0.08
"""Share of the instruments that are close to the camera: wide and out of focus."""
UNTOLD = 0.35
"""Share of the borders of which the network is not told: not every border is found, and what is dark is no tool."""

SMALL = ((needle, 0.04), (clips, 0.04), (catheter, 0.1), (cap, 0.12))
"""What else is painted, in this order, and its share of the examples; a cap is in front of all."""


@dataclass(frozen=True)
class LabeledFrame:
    """One real frame with its labels."""

    rgb_u8: NDArray[np.uint8]
    """(H, W, 3), 0..255."""
    label: NDArray[np.uint8]
    """(H, W) 0, 1 or `IGNORED`."""


Frames = Sequence[Sequence[LabeledFrame]]
"""The real frames of each set that may be used."""
LabeledImage = tuple[Field, NDArray[np.uint8]]
"""(h, w, 3) colors and (h, w) labels."""


@dataclass(frozen=True)
class Example:
    """One image and what it shows."""

    rgb_u8: NDArray[np.uint8]
    """(h, w, 3), 0..255."""
    view: NDArray[np.bool_]
    """(h, w) True inside the endoscope's image, as far as the network is told."""
    label: NDArray[np.uint8]
    """(h, w) 0, 1 or `IGNORED`."""


def examples(rng: Generator, frames: Frames, number: int = 2) -> list[Example]:
    """Paint one scene and photograph it `number` times, with another camera, mirrored or not.

    Without any real frames, all tissue is procedural.
    """
    scene, label, view = _scene(rng, frames)
    made = []
    for _ in range(number):
        flip = (slice(None, None, int(rng.choice((-1, 1)))), slice(None, None, int(rng.choice((-1, 1)))))
        rgb_u8 = photographed(rng, np.ascontiguousarray(scene[flip]), view[flip])
        told, beyond = view[flip], IGNORED
        if rng.random() < UNTOLD:
            told, beyond = np.ones(SIZE, bool), 0
        made.append(Example(rgb_u8, told, np.where(view, label, beyond).astype(np.uint8)[flip]))
    return made


def _scene(rng: Generator, frames: Frames) -> tuple[Field, NDArray[np.uint8], NDArray[np.bool_]]:
    """(h, w, 3) tissue with bodies over it, its labels, and the view."""
    real = bool(frames) and rng.random() < REAL
    if real:
        scene, label, view = _real_scene(rng, frames)
    else:
        scene, label, view = tissue(rng, SIZE), np.zeros(SIZE, np.uint8), random_view(rng, SIZE)
    if real and rng.random() < 0.15:  # as it is: real tools, or tissue without any
        return scene, label, view
    if rng.random() < 0.08:
        scene, tube = ribbed_tube(rng, scene)
        scene, label = _placed(rng, scene, label, tube)
    if rng.random() < 0.04:
        scene, label = _placed(rng, scene, label, gauze(rng, scene, view))
    if frames and rng.random() < 0.25:
        scene, label = _transferred(rng, scene, label, frames)
    for _ in range(rng.choice(4, p=NUMBER)):
        near = bool(rng.random() < NEAR)
        body = instrument(rng, scene, view, NEAR_WIDTH_PX if near else WIDTH_PX)
        scene, label = _placed(rng, scene, label, body, near=near)
    for paint, often in SMALL:
        if rng.random() < often:
            scene, label = _placed(rng, scene, label, paint(rng, scene, view))
    return scene, label, view


def _real_scene(rng: Generator, frames: Frames) -> tuple[Field, NDArray[np.uint8], NDArray[np.bool_]]:
    """A part of a real frame, mirrored and turned."""
    scene, label = _cropped(rng, any_frame(rng, frames))
    view = random_view(rng, SIZE) if rng.random() < 0.3 else np.ones(SIZE, bool)
    dark = cv2.erode((scene.max(-1) < 0.1).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return scene, np.where(view, label, IGNORED).astype(np.uint8), view & ~(dark & (label == IGNORED))


def any_frame(rng: Generator, frames: Frames) -> LabeledFrame:
    """A frame of any set; of a set with four times the frames, twice as often: four frames are soon known by heart."""
    often = np.sqrt([len(each) for each in frames])
    chosen = frames[int(rng.choice(len(frames), p=often / often.sum()))]
    return chosen[int(rng.integers(len(chosen)))]


def _cropped(rng: Generator, frame: LabeledFrame) -> LabeledImage:
    height, width = frame.label.shape
    turned = rng.random() < 0.3
    aspect = (SIZE[0] / SIZE[1]) ** (-1 if turned else 1) * log_uniform(rng, 0.8, 1.25)
    w = min(width, height / aspect) * rng.uniform(0.45, 1) ** 0.7
    h = w * aspect
    x, y = rng.uniform(0, width - w), rng.uniform(0, height - h)
    box = np.s_[int(y) : int(y + h), int(x) : int(x + w)]
    image, label = frame.rgb_u8[box], frame.label[box]
    if turned:
        image, label = np.rot90(image), np.rot90(label)
    if rng.random() < 0.5:
        image, label = image[:, ::-1], label[:, ::-1]
    if rng.random() < 0.5:
        image, label = image[::-1], label[::-1]
    image = cv2.resize(np.ascontiguousarray(image), SIZE[::-1], interpolation=cv2.INTER_AREA)
    label = cv2.resize(np.ascontiguousarray(label), SIZE[::-1], interpolation=cv2.INTER_NEAREST)
    return image.astype(np.float32) / 255, np.asarray(label, np.uint8)


def _transferred(rng: Generator, scene: Field, label: NDArray[np.uint8], frames: Frames) -> LabeledImage:
    """Tools of a real frame cut out and put over the scene, in another light."""
    image, tools = _cropped(rng, any_frame(rng, frames))
    if not (tools == 1).any():
        return scene, label
    image = image * np.exp(rng.normal(0, 0.25) + rng.normal(0, 0.08, 3)).astype(np.float32)
    if rng.random() < 0.3:
        gray = image.mean(-1, keepdims=True)
        image = gray * np.exp(rng.normal(0, 0.3, 3)).astype(np.float32)  # colored or gray instruments of that shape
    share = (tools == 1).astype(np.float32)
    canvas = Canvas(scene, share, image, share, share)
    return _placed(rng, scene, label, canvas, blurred=False)


def _placed(
    rng: Generator, scene: Field, label: NDArray[np.uint8], canvas: Canvas, blurred: bool = True, near: bool = False
) -> LabeledImage:
    """The painted body over the scene: behind tissue in places, with its shadow, blurred by focus and motion."""
    covered, outline, color = canvas.covered, canvas.outline, canvas.color
    if rng.random() < 0.12:  # tissue in front of a part of it
        field = fractal_field(rng, SIZE, log_uniform(rng, 25, 90), 4)
        hidden = np.clip((field - rng.uniform(0.3, 1.2)) * 8, 0, 1)
        covered, outline = covered * (1 - hidden), outline * (1 - hidden)
    if rng.random() < 0.15:  # blood and tissue on it
        spots = np.clip(fractal_field(rng, SIZE, log_uniform(rng, 5, 25), 3) - rng.uniform(0.5, 1.5), 0, 1)
        red = np.array([rng.uniform(0.2, 0.7), rng.uniform(0, 0.25), rng.uniform(0, 0.25)], np.float32)
        color = color + (spots * np.float32(rng.uniform(0.3, 1)))[..., None] * (red - color)
    if rng.random() < 0.5:
        scene = shadowed(rng, scene, covered)
    image = color * covered[..., None]
    if blurred:
        focus = (rng.uniform(0.3, 0.9), rng.uniform(0.9, 3), rng.uniform(3, 7))[
            rng.choice(3, p=[0.1, 0.4, 0.5] if near else [0.72, 0.22, 0.06])
        ]
        image, covered, outline = (cv2.GaussianBlur(x, (0, 0), focus) for x in (image, covered, outline))
        if rng.random() < 0.1:
            path = motion_kernel(rng)
            image, covered, outline = (cv2.filter2D(x, -1, path) for x in (image, covered, outline))
    else:
        soft = rng.uniform(0.5, 1.2)
        wide = cv2.GaussianBlur(covered, (0, 0), soft)
        image, covered = color * wide[..., None], wide
    scene = scene * (1 - covered[..., None]) + image
    label = np.where(covered > 0.5, 1, np.where(outline > 0.5, IGNORED, label)).astype(np.uint8)
    return scene, label
