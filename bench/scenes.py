"""Random scenes for the benchmarks, the same for equal sizes, in the order of memory that training keeps."""

from __future__ import annotations

import common
import numpy as np
import torch
from torch import Tensor

from endoprior.compute.morton import morton_order
from endoprior.core.config import Config
from endoprior.core.types import Camera, Splats
from endoprior.model.gaussians import Gaussians, temporal_shapes
from endoprior.model.hexplane_field import HexPlaneField
from endoprior.model.scene import SingleScene

FOCAL_PER_WIDTH = 0.9
"""Of an endoscope; also the phantom's."""
SIGMA_PX = 2.6
"""Median standard deviation of a Gaussian in the picture."""


def camera(width: int, height: int) -> Camera:
    focal = FOCAL_PER_WIDTH * width
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def splats(size: common.Size, seed: int = 0) -> tuple[Splats, Camera]:
    """Gaussians spread evenly over the image at 40-80 mm, about 2.6 px wide, opacity 0.2-0.95, SH degree 3."""
    rng, view = np.random.default_rng(seed), camera(size.width, size.height)
    z = rng.uniform(40, 80, size.num)
    x = (rng.uniform(0, size.width, size.num) - view.cx) / view.fx * z
    y = (rng.uniform(0, size.height, size.num) - view.cy) / view.fy * z
    means = np.stack([x, y, z], -1)
    means = means[morton_order(means)]
    scales = np.exp(rng.normal(np.log(SIGMA_PX), 0.4, (size.num, 3))) * (means[:, 2:] / view.fx)
    values = (
        means,
        rng.normal(size=(size.num, 4)),
        scales,
        rng.uniform(0.2, 0.95, size.num),
        rng.normal(size=(size.num, 16, 3)) * 0.2,
        np.zeros((size.num, 2, 3)),
    )
    return Splats(*(torch.tensor(v, dtype=torch.float32) for v in values)), view


def gaussians(drawn: Splats, cfg: Config) -> Gaussians:
    """Raw parameters that activate to `drawn` at every moment, color up to the degree of `cfg`."""
    num_rest = (cfg.schedule.sh_degree + 1) ** 2 - 1
    tensors = {
        "means": drawn.means,
        "quats": drawn.quats,
        "log_scales": drawn.scales.log(),
        "opacity_logits": drawn.opacities.logit(),
        "sh_dc": drawn.sh[:, :1],
        "sh_rest": drawn.sh[:, 1 : 1 + num_rest],
    }
    if cfg.render.color_slopes:
        tensors["color_slopes"] = drawn.color_slopes
    if cfg.deformation.kind == "basis":
        tensors |= {name: torch.zeros(len(drawn), *shape) for name, shape in temporal_shapes(cfg).items()}
    return Gaussians({name: value.clone() for name, value in tensors.items()})


def scene(drawn: Splats, cameras: tuple[Camera, ...], cfg: Config, field: HexPlaneField | None = None) -> SingleScene:
    """A scene that shows `drawn`; without a field it stands still, but deforming costs the same as if it moved."""
    nothing = torch.zeros(len(drawn))
    return SingleScene(gaussians(drawn, cfg), field, cfg, cameras, 25.0, nothing, nothing)


def sheet(num: int, seed: int = 0) -> Tensor:
    points = torch.rand(num, 3, generator=torch.Generator().manual_seed(seed)) * torch.tensor([60.0, 50.0, 0.5])
    points[:, 2] += 60 + 8 * torch.sin(points[:, 0] / 9) * torch.cos(points[:, 1] / 7)
    return points[torch.from_numpy(morton_order(points.numpy()))]
