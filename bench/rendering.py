"""Rendering a scene at one time, deformation included, beside plain torch, with the share of each part.

`python bench/rendering.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import plain
import scenes
import torch

from endoprior.core.config import Config
from endoprior.core.types import Camera, RenderOutput, Splats
from endoprior.model.hexplane_field import HexPlaneField, HexPlaneMotion
from endoprior.model.motion import BasisMotion
from endoprior.model.playback import Playback
from endoprior.model.presets import preset
from endoprior.model.scene import Scene
from endoprior.model.single_scene import SingleScene
from endoprior.render import numba as numba_backend

PRESETS = ("default", "paper")
TIME = 0.4
TORCH_MOST = 20_000
"""Gaussians; with more, torch takes many seconds."""
PARTS = {
    "deformation": [(HexPlaneMotion, "offsets"), (BasisMotion, "offsets")],
    "projection + SH": [(numba_backend, "project_forward")],
    "binning + sort": [(numba_backend.tiles, "build")],
    "compositing": [(numba_backend, "composite_forward")],
}


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """For each preset and size one row for the whole, then one for each part; last, frames kept for playing."""
    measured = []
    for name in PRESETS:
        cfg, field = preset(name).fitted(68), None
        for size in sizes:
            splats, camera = scenes.splats(size)
            if cfg.deformation.kind == "hexplane" and field is None:  # the volume is the same at all sizes
                field = HexPlaneField.from_points(splats.means, cfg.deformation, torch.Generator().manual_seed(0))
            scene = make_scene(splats, camera, cfg, field)
            ours = {"": lambda _, s=scene: s.render(TIME)}
            theirs = torch_steps(scene) if size.num <= TORCH_MOST else None
            image = (size.width, size.height)
            measured += common.rows(f"rendering {name}", common.race(ours, theirs), size.num, image)
            measured += common.part_rows(f"rendering {name}", ours, PARTS, size)
    for size in sizes:
        measured += kept_rows(size)
    return measured


def make_scene(splats: Splats, camera: Camera, cfg: Config, field: HexPlaneField | None) -> Scene:
    """A scene of one frame."""
    nothing = torch.zeros(len(splats))
    return SingleScene(scenes.gaussians(splats, cfg), field, cfg, (camera,), 25.0, nothing, nothing)


def kept_rows(size: common.Size) -> list[common.Row]:
    """One row: a frame that was deformed before. What deformed it does not matter."""
    splats, camera = scenes.splats(size)
    playback, background = Playback(make_scene(splats, camera, preset("default").fitted(68), None)), torch.zeros(3)

    @torch.no_grad()
    def step(_: object) -> RenderOutput:
        return plain.rasterize(playback.splats(0), camera, background=background)

    theirs = {"": step} if size.num <= TORCH_MOST else None
    result = common.race({"": lambda _: playback.render(0)}, theirs)
    return common.rows("rendering kept frame", result, size.num, (size.width, size.height))


def torch_steps(scene: Scene) -> common.Steps:
    """The same in plain torch."""
    gaussians, cfg = scene.gaussians, scene.config
    field, background = scene.field and plain.Field(scene.field), torch.zeros(3)

    @torch.no_grad()
    def step(_: object) -> RenderOutput:
        if field is not None:
            offsets = field.offsets(gaussians["means"], TIME)
        else:
            offsets = plain.basis_offsets(gaussians["motion"], TIME, cfg.deformation)
        splats = gaussians.splats(offsets, cfg.schedule.sh_degree)
        return plain.rasterize(splats, scene.cameras[0], background=background)

    return {"": step}


if __name__ == "__main__":
    common.main(measure, __doc__)
