"""Fixed colors: a carried grid moves by the known px or stays; the share of the change that color makes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from endoprior.core.config_deformation import BasisConfig
from endoprior.core.geometry import back_project, project
from endoprior.core.types import Camera, Frame
from endoprior.data import FrameSequence
from endoprior.evaluation.context import Evaluation, EvaluationContext, SceneFrames
from endoprior.evaluation.score import ScoreUnavailable
from endoprior.evaluation.scorers import motion
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.basis import spline_weights
from endoprior.model.colors import with_fixed_color
from endoprior.model.gaussians import Gaussians, change_layout
from endoprior.model.presets import preset
from endoprior.model.scene import Scene, SingleScene
from endoprior.visualization.tissue_layers import SQUARES, PaintedTissue

WIDTH, HEIGHT, FOCAL, DEPTH, NUM_FRAMES = 160, 96, 200.0, 60.0, 10
CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, np.eye(4))
SQUARE = WIDTH // SQUARES
MIDDLE = NUM_FRAMES // 2


def wall(shift_mm: float = 0.0, shade: float = 0.0) -> Scene:
    """A plane with 1 Gaussian for every px that has moved to the right, or is brighter, in the middle frame.

    It reaches 30 px beyond the image. Nothing moves or changes at time 0.
    """
    cfg = preset("default").fitted(20)
    cfg = replace(cfg, deformation=replace(cfg.deformation, basis=BasisConfig(12, NUM_FRAMES)))
    x, y = np.meshgrid(np.arange(-30, WIDTH + 30) + 0.5, np.arange(-30, HEIGHT + 30) + 0.5)
    pixels = np.column_stack([x.ravel(), y.ravel()])
    points = back_project(pixels, np.full(len(pixels), DEPTH), CAMERA).astype(np.float32)
    rng = np.random.default_rng(0)
    colors = np.repeat(rng.uniform(0.3, 0.5, (len(points), 1)), 3, 1)
    scales = np.full(len(points), np.log(0.4 * DEPTH / FOCAL), np.float32)
    gaussians = create_gaussians(points, colors.astype(np.float32), scales, cfg)
    # Functions 5 of 12 and 3 of 6 have a weight in the middle and none at the start.
    moves, shines = spline_weights(MIDDLE / NUM_FRAMES, 12)[5], spline_weights(MIDDLE / NUM_FRAMES, 6)[3]
    with torch.no_grad():
        gaussians["opacity_logits"].fill_(6.0)
        gaussians["motion"][:, 5, 0] = shift_mm / moves
        shades = torch.from_numpy(shade * rng.uniform(0, 1, (len(points), 1)) / shines)
        gaussians["changes"][:, 3, change_layout(cfg)["sh_dc"]] = shades.float()
    num = len(points)
    return SingleScene(gaussians, None, cfg, (CAMERA,) * NUM_FRAMES, 25.0, torch.zeros(num), torch.zeros(num))


def seen(scene: Scene, frame: int) -> np.ndarray:
    """(H, W, 3) color of a frame."""
    return scene.render(frame / NUM_FRAMES).color.numpy()


def color_share(scene: Scene) -> float:
    """The score over all frames."""
    mask, rgb = np.ones((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    depth = np.full((HEIGHT, WIDTH), DEPTH, np.float32)
    sequence = FrameSequence(
        Path("none"), [CAMERA] * NUM_FRAMES, lambda i: Frame(i, i / NUM_FRAMES, CAMERA, rgb, mask, depth, mask)
    )  # fmt: skip
    context = EvaluationContext(SceneFrames(scene, sequence), sequence, "video", False, None, Evaluation({}))
    return motion.color_share(context)


def painted(scene: Scene, frame: int) -> np.ndarray:
    """(H, W) how blue a frame of the painted scene is; the wall itself is gray: 0."""
    color = PaintedTissue(scene).render(frame / NUM_FRAMES, CAMERA)
    return color[..., 2] - color[..., 0]


def test_the_grid_is_sharp_on_the_first_frame():
    blue = painted(wall(), 0)[SQUARE // 2 :: SQUARE, 2 * SQUARE : -2 * SQUARE]  # rows between two lines
    lines = blue.reshape(len(blue), -1, SQUARE)
    assert np.abs(lines[..., 1:-1]).max() < 1e-4, "there is color between the lines"
    assert lines[..., [0, -1]].min() > 0.1


def test_tissue_that_moves_carries_the_grid_by_as_many_pixels():
    shift = 4.5 * SQUARE  # without motion every line would be where there is none
    scene = wall(shift_mm=shift * DEPTH / FOCAL, shade=0.5)
    first, middle, shift = painted(scene, 0), painted(scene, MIDDLE), round(shift)
    inside = slice(2, -2)
    assert np.abs(middle[inside, shift + 4 :] - first[inside, 4:-shift]).max() < 0.02  # Gaussians of different gray
    assert np.abs(middle - first)[inside, shift + 4 :].max() > 0.1
    assert np.abs(middle[:, : shift - 4]).max() < 1e-3, "what came in from outside is painted"


def test_color_that_changes_does_not_move_the_grid():
    scene = wall(shade=0.5)
    assert np.abs(seen(scene, MIDDLE) - seen(scene, 0)).mean() > 0.05
    assert np.array_equal(painted(scene, MIDDLE), painted(scene, 0))


def test_what_the_first_frame_hides_is_not_painted():
    # A strip in front of the wall moves away in the middle frame.
    scene = wall()
    pixels, _ = project(scene.gaussians["means"].detach().numpy(), CAMERA)
    strip = torch.from_numpy((pixels[:, 0] > 60) & (pixels[:, 0] < 100))
    behind = wall().gaussians.tensors
    tensors = {name: torch.cat([value, behind[name][strip]]) for name, value in scene.gaussians.tensors.items()}
    front = slice(len(scene), None)
    tensors["means"], tensors["motion"] = tensors["means"].detach(), tensors["motion"].detach()
    tensors["means"][front] *= 0.8
    tensors["motion"][front, 5, 0] = 100
    blue = painted(replace(scene, gaussians=Gaussians(tensors)), MIDDLE)
    assert np.abs(blue[:, 64:96]).max() < 1e-3 and blue[:, 4:56].max() > 0.1


def test_fixed_color_is_the_mean_over_the_given_times():
    scene, times = wall(shade=0.5), [0.1, 0.4, 0.5]
    fixed = with_fixed_color(scene, times)
    mean = torch.stack([scene.at(time).sh for time in times]).mean(0)
    for time in (0.0, 0.5):
        assert torch.allclose(fixed.at(time).sh, mean, atol=1e-6)
        assert torch.equal(fixed.at(time).means, scene.at(time).means)


def test_the_share_of_color_is_one_without_motion_and_zero_with_motion_alone():
    assert color_share(wall(shade=0.5)) == pytest.approx(1, abs=1e-3)
    assert color_share(wall(shift_mm=3)) < 1e-6
    assert 0.05 < color_share(wall(shift_mm=3, shade=0.2)) < 0.95


def test_without_color_over_time_or_without_change_there_is_no_share():
    with pytest.raises(ScoreUnavailable, match="nothing changes"):
        color_share(wall())
    scene = wall()
    config = scene.config.replace({"deformation.kind": "hexplane", "init.motion": "rest"})
    with pytest.raises(ScoreUnavailable, match="do not change with time"):
        color_share(replace(scene, config=config))
