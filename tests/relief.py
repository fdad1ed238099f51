"""A textured relief seen by a moving camera: frames for camera tracking, with true poses. No phantom, no disk."""

from __future__ import annotations

import cv2
import numpy as np

from endoprior.prepare.camera_path.tracks import FrameReader, PoseInput, TrackingCamera

WIDTH, HEIGHT = 160, 120
MATRIX = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])
"""The left-most pixel is centered at 0.5."""


def smooth(height, width, seed=0, sigma=2.0):
    """(height, width, 3) smooth noise, 0..255."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.random((height, width, 3), np.float32), (0, 0), sigma)
    return (255 * (noise - noise.min()) / np.ptp(noise)).astype(np.uint8)


TEXTURE = smooth(900, 900, sigma=2.5)


def camera(relative=False, baseline_mm=4.0):
    return TrackingCamera.centered_at_half(MATRIX, (WIDTH, HEIGHT), relative, None if relative else baseline_mm)


def reader(frames):
    """Reads frames that are there."""
    return FrameReader(
        lambda i: frames[i].rgb_u8, lambda i: frames[i].tissue_mask, lambda i: frames[i].depth, len(frames)
    )


def height(x, y):
    """Depth of the relief, mm, at world x, y, mm."""
    return 80 + 8 * np.sin(x / 11) * np.cos(y / 9)


def pose(turn, shift):
    """(4, 4) camera-to-world from a rotation vector, rad, and a center, mm."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = cv2.Rodrigues(np.array(turn, np.float64))[0], shift
    return out


def path(count, speed=1.0):
    """(count, 4, 4) a smooth path, camera-to-world."""
    t = np.arange(count) * speed
    turns = np.stack([0.05 * np.sin(t / 9), -0.06 * np.sin(t / 11), 0.01 * t / 2], 1)
    shifts = np.stack([1.0 * t, 6 * np.sin(t / 8), 5 * (1 - np.cos(t / 10))], 1)
    return np.stack([pose(turn, shift) for turn, shift in zip(turns, shifts, strict=True)])


def view(camera_to_world, texture=TEXTURE, move=None):
    """What a camera sees; `move(x, y)` shifts the texture by (dx, dy) mm at rest position x, y."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(x - MATRIX[0, 2]) / MATRIX[0, 0], (y - MATRIX[1, 2]) / MATRIX[1, 1], np.ones_like(x)], -1)
    rays = rays @ camera_to_world[:3, :3].T
    center, z = camera_to_world[:3, 3], np.full((HEIGHT, WIDTH), 80.0)
    for _ in range(25):
        hit = center + rays * z[..., None]
        z = z + 0.7 * (height(hit[..., 0], hit[..., 1]) - hit[..., 2])
    hit = center + rays * z[..., None]
    at = hit[..., :2] if move is None else hit[..., :2] - move(hit[..., 0], hit[..., 1])
    at = (at * 4 + 450).astype(np.float32) - 0.5
    rgb = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    return PoseInput(rgb, np.ones((HEIGHT, WIDTH), bool), z.astype(np.float32))
