"""A sample clip: the phantom as a stereo endoscope would record it, to try what is meant for one's own video.

Two lenses bend the image, the right camera is turned against the left one, a round stop leaves the corners dark, and
the video processor burns a label and a clock into both images. Matrices are OpenCV's here: the first pixel's center is
at 0, as in calibration files.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import AT_ORIGIN, CameraPose
from .config import PhantomConfig
from .scene import SceneState, build_scene
from .sensor import develop, expose, exposure_gain, vignette
from .views import render_view

RECORDED = Path(__file__).with_name("sample.mp4")
"""The clip of `SampleConfig()`, written by `write_sample`: drawing it takes a minute."""
_FOCAL = 0.9
"""Focal length, as a share of the image width."""
_BASELINE_MM = 4.2, 0.06, -0.04
_TURN = 0.006, -0.018, 0.008
"""Position of the right camera in the axes of the left one, mm, and rotation vector of R, rad: they squint."""
_STOP = 0.50
"""Radius of the round stop, as a share of the image width: it cuts the corners."""
_SOFT_PX = 3.0
_ROUNDS = 12
"""Rounds in which the distortion is undone; each leaves less than half of the error."""
_LABEL, _START_S = "DEMO", 9 * 3600 + 41 * 60 + 7
"""Burnt-in label, and time of day of the first frame, s."""


@dataclass(frozen=True)
class SampleLens:
    """One camera of the pair."""

    matrix: NDArray[np.float64]  # (3, 3) K, px
    distortion: NDArray[np.float64]  # (5,) k1 k2 p1 p2 k3
    stop: tuple[float, float]  # center of the round stop, px


@dataclass(frozen=True)
class SampleConfig:
    """What is recorded; tests make it small."""

    seed: int = 0
    frames: int = 60
    width: int = 480
    height: int = 384
    """px of each camera's image, even."""
    frames_per_second: float = 15.0

    def __post_init__(self) -> None:
        PhantomConfig(seed=self.seed)  # InputError for one out of range

    @property
    def lenses(self) -> tuple[SampleLens, SampleLens]:
        """The left and the right lens: of one kind, not quite alike."""
        focal, x, y = _FOCAL * self.width, (self.width - 1) / 2, (self.height - 1) / 2
        left = SampleLens(
            _matrix(focal, x + 0.011 * focal, y - 0.007 * focal), np.array([-0.23, 0.07, 6e-4, -4e-4, 0]), (x, y)
        )
        right = _matrix(1.004 * focal, x - 0.009 * focal, y + 0.006 * focal)
        stop = x - 0.006 * self.width, y + 0.005 * self.width
        return left, SampleLens(right, np.array([-0.22, 0.06, -5e-4, 7e-4, 0]), stop)

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) R of x_right = R x_left + T."""
        return np.asarray(cv2.Rodrigues(np.array(_TURN))[0], np.float64)

    @property
    def translation_mm(self) -> NDArray[np.float64]:
        """(3,) T of x_right = R x_left + T."""
        return -self.rotation @ np.array(_BASELINE_MM)


def _matrix(focal: float, x: float, y: float) -> NDArray[np.float64]:
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])


def rays_of(cfg: SampleConfig, right: int) -> NDArray[np.float64]:
    """(H, W, 2) x / z and y / z, in the axes of the left camera, of the viewing ray of each pixel of one lens."""
    lens = cfg.lenses[right]
    center, focal = lens.matrix[:2, 2], lens.matrix[0, 0]
    pixels = np.stack(np.meshgrid(np.arange(cfg.width), np.arange(cfg.height)), -1).reshape(-1, 2).astype(np.float64)
    rays = np.column_stack([(pixels - center) / focal, np.ones(len(pixels))])
    for _ in range(_ROUNDS):
        seen = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)[0][:, 0]
        rays[:, :2] += (pixels - seen) / focal
    if right:
        rays = rays @ cfg.rotation
    return (rays[:, :2] / rays[:, 2:]).reshape(cfg.height, cfg.width, 2)


def _stop(cfg: SampleConfig, right: int) -> NDArray[np.float32]:
    """(H, W) share of the light that passes the round stop, 0..1."""
    x, y = cfg.lenses[right].stop
    distance = np.hypot(np.arange(cfg.width) - x, (np.arange(cfg.height) - y)[:, None])
    return np.clip((_STOP * cfg.width - distance) / _SOFT_PX, 0, 1).astype(np.float32)


def phantom_of(cfg: SampleConfig, rays: Sequence[NDArray[np.float64]]) -> PhantomConfig:
    """The phantom in images without distortion, which hold all `rays` (H, W, 2) of both lenses that pass the stop."""
    focal = _FOCAL * cfg.width
    reach = np.max([np.abs(rays[right][_stop(cfg, right) > 0]).max(0) for right in (0, 1)], 0)
    across, down = (2 * math.ceil(focal * most + 2) for most in reach)
    options = {"seed": cfg.seed, "frames": cfg.frames, "baseline_mm": _BASELINE_MM[0]}
    return PhantomConfig(width=across, height=down, focal_per_width=focal / across, **options)


def sample_frames(cfg: SampleConfig) -> Iterator[NDArray[np.uint8]]:
    """(H, 2 W, 3) RGB, the left camera left: each frame as the video processor puts it out."""
    rays = [rays_of(cfg, right) for right in (0, 1)]
    phantom = phantom_of(cfg, rays)
    places = [(phantom.focal * seen + phantom.center - 0.5).astype(np.float32) for seen in rays]
    maps = [(np.ascontiguousarray(each[..., 0]), np.ascontiguousarray(each[..., 1])) for each in places]
    light = [vignette(cfg.width, cfg.height) * _stop(cfg, right)[..., None] for right in (0, 1)]
    poses = AT_ORIGIN, CameraPose(np.array(_BASELINE_MM), np.eye(3))
    scene, gain = build_scene(phantom), 0.0
    for index in range(cfg.frames):
        now, images = SceneState.of(scene, index / (cfg.frames - 1)), []
        for right, pose in enumerate(poses):
            view = render_view(scene, now, pose)
            gain = gain or exposure_gain(view.tissue) * scene.look.exposure
            bent = cv2.remap(view.image, *maps[right], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            rng = np.random.default_rng([cfg.seed, 9 + right, index])
            image = expose(develop(np.maximum(bent, 0), gain, light[right]), phantom.noise, rng)
            images.append(_labeled(image, index / cfg.frames_per_second))
        yield np.concatenate(images, 1)


def _labeled(image: NDArray[np.uint8], seconds: float) -> NDArray[np.uint8]:
    """The image with a label over the tissue, and a clock in a dark corner."""
    height, width = image.shape[:2]
    now = _START_S + int(seconds)
    clock = f"{now // 3600:02d}:{now // 60 % 60:02d}:{now % 60:02d}"
    for text, x, y in ((_LABEL, 0.44, 0.965), (clock, 0.01, 0.05)):
        at = round(x * width), round(y * height)
        for thick, level in ((3, 0), (1, 255)):
            cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, width / 1200, (level,) * 3, thick, cv2.LINE_AA)
    return image


def calibration_text(cfg: SampleConfig) -> str:
    """The calibration of the pair as a YAML file of OpenCV; T in mm."""
    left, right = cfg.lenses
    values = {"K1": left.matrix, "D1": left.distortion[None], "K2": right.matrix, "D2": right.distortion[None]}
    file = cv2.FileStorage("calibration.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.write("image_width", cfg.width)
    file.write("image_height", cfg.height)
    for name, value in (values | {"R": cfg.rotation, "T": cfg.translation_mm[:, None]}).items():
        file.write(name, value)
    return file.releaseAndGetString()
