"""What the released methods share: how their configs are made, and points on the surface that frames show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from endoprior.core.checks import input_error
from endoprior.core.config import Config
from endoprior.core.geometry import back_project
from endoprior.core.types import Frame
from endoprior.initialization.sampling import MIN_POINTS, PointCloud, concatenated, has_surface
from endoprior.model.motion import Motion
from endoprior.model.presets import paper
from endoprior.training.gaussian_method import GaussianMethod
from endoprior.training.trainer import Stage


class Released(GaussianMethod):
    """A method as its authors released it: without the texture prior and the temporal term."""

    uses_prior = False
    name: ClassVar[str]
    changes: ClassVar[Mapping[str, Any]]
    """What its preset changes in `paper` besides."""
    way: ClassVar[Motion]
    """How its Gaussians move."""
    growth_ends, last_reset = 0.0, 0.0
    """Shares of the published fine stage after which growth ends and opacities are lowered last; 0: not before its end,
    never. `fit_to_clip` takes them of the stage that is trained, and lowers opacities once."""
    first_reset, reset_every = 0, 0
    """Iterations after which the release lowers opacities while Gaussians grow: the first one, which belongs to a white
    background, and every n-th; 0: never."""

    def config(self) -> Config:
        """What its preset starts from."""
        common = {"method": self.name, "temporal.weight": 0.0, "density.min_densify_weight": 1.0}
        return paper().replace(common | dict(self.changes))

    @override
    def fitted(self, cfg: Config, num_frames: int) -> Config:
        cfg = super().fitted(cfg, num_frames)
        if not (cfg.fit_to_clip and self.growth_ends):
            return cfg
        stop = round(self.growth_ends * cfg.schedule.fine_iterations)
        return replace(cfg, density=replace(cfg.density, stop_iteration=stop))

    @override
    def motion(self, cfg: Config) -> Motion:
        return self.way

    @override
    def reset_due(self, stage: Stage, iteration: int, cfg: Config) -> bool:
        if cfg.fit_to_clip:
            return stage is Stage.FINE and iteration == round(self.last_reset * cfg.schedule.fine_iterations)
        inside = self.reset_every and iteration < cfg.density.stop_iteration
        return bool(inside and (iteration == self.first_reset or iteration % self.reset_every == 0))


def grid_points(frames: Sequence[Frame], every_px: int, first_px: int) -> PointCloud:
    """A point at every n-th pixel along both axes, from the first frame that shows tissue with depth there.

    Args:
        frames: in order. every_px: n. first_px: row and column of the first pixel.
    Raises:
        InputError: fewer than 4 points.
    """
    grid = np.zeros_like(frames[0].tissue_mask)
    grid[first_px::every_px, first_px::every_px] = True
    clouds = []
    for position, frame in enumerate(frames):
        pixels = grid & frame.tissue_mask & has_surface(frame)
        grid &= ~pixels
        clouds.append(surface_points(frame, position, pixels))
    return enough(concatenated(clouds), " on tissue with depth")


def surface_points(frame: Frame, position: int, pixels: NDArray[np.bool_]) -> PointCloud:
    """World points and colors of some pixels (H, W) of the frame at `position`, row by row."""
    v, u = np.nonzero(pixels)
    points = back_project(np.stack([u, v], -1) + 0.5, frame.depth[v, u].astype(np.float64), frame.camera)
    colors = frame.rgb_u8[v, u].astype(np.float32) / np.float32(255)
    return PointCloud(points.astype(np.float32), colors, np.full(len(v), position, np.int32))


def enough(cloud: PointCloud, what: str) -> PointCloud:
    """The cloud; InputError if it has fewer than 4 points."""
    if len(cloud) < MIN_POINTS:
        fix = "Check masks and depth: `endoprior check DATA`."
        raise input_error("initialization", f"at least {MIN_POINTS} points{what}", str(len(cloud)), fix)
    return cloud
