"""Highlights taken out of a scene: the tissue below comes back where another frame shows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config_deformation import BasisConfig
from endoprior.core.geometry import back_project
from endoprior.core.types import Camera, Frame
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.gaussians import SH_C0, change_layout
from endoprior.model.highlights import without_highlights
from endoprior.model.presets import preset
from endoprior.model.scene import Scene, SingleScene

WIDTH, HEIGHT, NUM_FRAMES, NUM_BASES = 96, 64, 24, 17
CAMERA = Camera(WIDTH, HEIGHT, 120.0, 120.0, WIDTH / 2, HEIGHT / 2, np.eye(4))
TISSUE = np.array([0.6, 0.25, 0.2], np.float32)


def wall(shine: Callable[[np.ndarray], np.ndarray]) -> Scene:
    """A red plane with a Gaussian for every second px; `shine` of the pixels (N, 2) says how white they are, (N, B)."""
    cfg = preset("default").fitted(NUM_FRAMES)
    cfg = replace(cfg, deformation=replace(cfg.deformation, basis=BasisConfig(41, NUM_FRAMES)))
    x, y = np.meshgrid(np.arange(-8, WIDTH + 8, 2) + 0.5, np.arange(-8, HEIGHT + 8, 2) + 0.5)
    pixels = np.column_stack([x.ravel(), y.ravel()])
    points = back_project(pixels, np.full(len(pixels), 60.0), CAMERA).astype(np.float32)
    gaussians = create_gaussians(points, np.tile(TISSUE, (len(points), 1)), np.full(len(points), -0.5), cfg)
    with torch.no_grad():
        gaussians["opacity_logits"].fill_(6.0)
        part = change_layout(cfg)["sh_dc"]
        white = torch.from_numpy((1.05 - TISSUE) / SH_C0)
        gaussians["changes"][:, :, part] = torch.from_numpy(shine(pixels)).float()[..., None] * white
    num = len(points)
    return SingleScene(gaussians, None, cfg, (CAMERA,) * NUM_FRAMES, 25.0, torch.zeros(num), torch.zeros(num))


def frames_of(scene: Scene, hidden: slice | None = None) -> list[Frame]:
    """What the camera sees of it; a tool hides the columns `hidden`."""
    found = []
    for i in range(NUM_FRAMES):
        rgb = np.rint(scene.render(i / NUM_FRAMES).color.numpy() * 255).astype(np.uint8)
        tissue = np.ones((HEIGHT, WIDTH), bool)
        if hidden is not None:
            tissue[:, hidden] = False
        depth = np.full((HEIGHT, WIDTH), 60, np.float32)
        found.append(Frame(i, i / NUM_FRAMES, CAMERA, rgb, tissue, depth, tissue))
    return found


def moving(pixels: np.ndarray) -> np.ndarray:
    """A band of light 16 px wide that moves to the right, one band per basis function."""
    start = np.linspace(0, WIDTH - 16, NUM_BASES)
    return (np.abs(pixels[:, :1] - start - 8) < 8).astype(np.float32)


def resting(pixels: np.ndarray) -> np.ndarray:
    """A spot of light that never leaves."""
    inside = np.hypot(pixels[:, 0] - 40, pixels[:, 1] - 30) < 6
    return np.repeat(inside[:, None], NUM_BASES, 1).astype(np.float32) * 2.5


@pytest.mark.parametrize("light", [moving, resting])
def test_the_tissue_below_comes_back(light):
    """A moving light: from other frames. One that rests: from the tissue around it."""
    lit, plain = wall(light), wall(lambda pixels: np.zeros((len(pixels), NUM_BASES), np.float32))
    found = without_highlights(lit, lambda window: frames_of(lit))
    for i in range(NUM_FRAMES):
        want = plain.render(i / NUM_FRAMES).color
        before = (lit.render(i / NUM_FRAMES).color - want).abs()
        after = (found.render(i / NUM_FRAMES).color - want).abs()
        assert before.max() > 0.3 and after.mean() < 0.3 * before.mean() and after.max() < 0.4 * before.max()


def test_all_else_stays_as_it_is():
    """Geometry and motion to the last bit; colors where no frame shows a highlight."""
    lit = wall(moving)
    found = without_highlights(lit, lambda window: frames_of(lit))
    for name in ("means", "quats", "log_scales", "opacity_logits", "color_slopes"):
        assert torch.equal(found.gaussians[name], lit.gaussians[name])
    part = change_layout(lit.config)["sh_dc"]
    assert torch.equal(found.gaussians["changes"][:, :, : part.start], lit.gaussians["changes"][:, :, : part.start])
    dull = wall(lambda pixels: 0.1 * moving(pixels))
    same = without_highlights(dull, lambda window: frames_of(dull))
    assert torch.equal(same.gaussians["changes"], dull.gaussians["changes"])
    assert torch.equal(same.gaussians["sh_dc"], dull.gaussians["sh_dc"])


def test_what_no_frame_shows_is_left_alone():
    lit = wall(moving)
    found = without_highlights(lit, lambda window: frames_of(lit, hidden=slice(0, WIDTH)))
    assert torch.equal(found.gaussians["changes"], lit.gaussians["changes"])


def test_colors_that_never_change_have_no_highlights_to_find():
    lit = wall(moving)
    cfg = lit.config.replace({"deformation.kind": "hexplane", "init.motion": "rest"})
    with pytest.raises(InputError, match="expected a scene whose colors change with time"):
        without_highlights(replace(lit, config=cfg), lambda window: [])


def test_a_sequence_has_no_highlights_to_hide(tmp_path, capsys):
    assert main(["view", str(tmp_path), "--no-highlights"]) == 2
    assert "--no-highlights: expected a run folder, got" in capsys.readouterr().err
