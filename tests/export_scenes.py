"""Small scenes and splats for the tests of the exports, with nothing symmetric about them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from endoprior.cli import main
from endoprior.core.types import Camera, Splats
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.presets import preset
from endoprior.model.scene import Scene, SingleScene

NUM_FRAMES = 10


def random_splats(num: int = 50, degree: int = 3, seed: int = 0) -> Splats:
    """Gaussians of three different scales, turned anyhow, with quaternions that are not of length 1."""
    rng = np.random.default_rng(seed)
    values = {
        "means": rng.uniform([-30, -20, 40], [25, 35, 90], (num, 3)),
        "quats": rng.normal(size=(num, 4)) * rng.uniform(0.5, 2, (num, 1)),
        "scales": np.exp(rng.uniform(-3, 1.5, (num, 3))),
        "opacities": rng.uniform(0.02, 0.99, num),
        "sh": rng.uniform(-0.9, 0.9, (num, (degree + 1) ** 2, 3)),
    }
    return Splats(**{name: torch.from_numpy(value.astype(np.float32)) for name, value in values.items()})


def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """(N, 3, 3) from quaternions (w, x, y, z), by turning vectors with q v q*: nothing of the program is used."""
    q = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    w, v = q[:, :1], q[:, 1:]
    axes = []
    for k in range(3):
        e = np.zeros_like(v)
        e[:, k] = 1
        axes.append((e + 2 * np.cross(v, np.cross(v, e) + w * e)) * scales[:, k : k + 1])
    m = np.stack(axes, -1)
    return m @ m.transpose(0, 2, 1)


def plane_camera(width: int = 64, height: int = 48, shift: float = 0.0) -> Camera:
    """A camera with an off-center principal point, `shift` mm to the right, that looks along z."""
    pose = np.eye(4)
    pose[0, 3] = -shift
    return Camera(width, height, 80.0, 80.0, 30.0, 26.0, pose)


def moving_scene(sh_degree: int = 0, moving_camera: bool = False) -> Scene:
    """A slanted wall of overlapping opaque Gaussians that moves at random, seen in ten frames."""
    cfg = preset("default").fitted(20)
    cfg = replace(cfg, schedule=replace(cfg.schedule, sh_degree=sh_degree))
    rng = np.random.default_rng(1)
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-16, 16, 33), np.linspace(-13, 13, 27)))
    points = np.column_stack([x, y, 60 + 0.2 * x]).astype(np.float32)
    num = len(points)
    gaussians = create_gaussians(points, rng.random((num, 3), np.float32), np.zeros(num, np.float32), cfg)
    with torch.no_grad():
        gaussians["opacity_logits"].fill_(4.0)
        for name in ("motion", "changes", "frame_motion"):
            gaussians[name].copy_(torch.from_numpy(rng.normal(size=gaussians[name].shape) * 0.1))
        gaussians["sh_rest"].copy_(torch.from_numpy(rng.normal(size=gaussians["sh_rest"].shape) * 0.1))
        gaussians["color_slopes"].copy_(torch.from_numpy(rng.normal(size=gaussians["color_slopes"].shape) * 0.1))
    cameras = tuple(plane_camera(shift=i if moving_camera else 0.0) for i in range(NUM_FRAMES))
    return SingleScene(gaussians, None, cfg, cameras, 25.0, torch.zeros(num), torch.zeros(num))


def moving_run(folder: Path) -> Path:
    """A run folder with a scene whose Gaussians and camera move."""
    moving_scene(sh_degree=1, moving_camera=True).save(folder / "scene.safetensors")
    return folder


def export(run: Path, out: Path, *options: str) -> int:
    """Exit status of `endoprior export RUN OUT --format ...`."""
    return main(["export", str(run), str(out), "--format", *options])
