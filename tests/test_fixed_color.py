"""Fixed colors: a carried pattern moves by the known px or stays; the share of the change that color makes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from endoprior.core.geometry import back_project
from endoprior.core.presets import preset
from endoprior.core.types import Camera, Frame
from endoprior.data import FrameSequence
from endoprior.evaluation.context import Evaluation, EvaluationContext
from endoprior.evaluation.metrics import ScoreUnavailable
from endoprior.evaluation.rendered import SceneFrames
from endoprior.evaluation.scorers import color
from endoprior.model.attributes import motion_layout
from endoprior.model.basis import basis_weights
from endoprior.model.fixed_color import with_fixed_color
from endoprior.model.gaussians import create_gaussians
from endoprior.model.scene import Scene
from endoprior.visualization.carried_texture import COLORS, SQUARES, paint_texture

WIDTH, HEIGHT, FOCAL, DEPTH, NUM_FRAMES = 160, 96, 200.0, 60.0, 10
CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, np.eye(4))
SQUARE = WIDTH // SQUARES
MIDDLE = NUM_FRAMES // 2


def wall(shift_mm: float = 0.0, shade: float = 0.0) -> Scene:
    """A plane with 1 Gaussian for every px that has moved to the right, or is brighter, in the middle frame.

    It reaches 30 px beyond the image. Nothing moves or changes at time 0.
    """
    cfg = preset("default").fitted(20)
    cfg = replace(cfg, deformation=replace(cfg.deformation, basis=replace(cfg.deformation.basis, num_bases=9)))
    x, y = np.meshgrid(np.arange(-30, WIDTH + 30) + 0.5, np.arange(-30, HEIGHT + 30) + 0.5)
    pixels = np.column_stack([x.ravel(), y.ravel()])
    points = back_project(pixels, np.full(len(pixels), DEPTH), CAMERA).astype(np.float32)
    rng = np.random.default_rng(0)
    colors = np.repeat(rng.uniform(0.3, 0.5, (len(points), 1)), 3, 1)
    scales = np.full(len(points), np.log(0.4 * DEPTH / FOCAL), np.float32)
    gaussians = create_gaussians(points, colors.astype(np.float32), scales, cfg)
    layout, weight = motion_layout(cfg.deformation), basis_weights(MIDDLE / NUM_FRAMES, cfg.deformation.basis)[4]
    with torch.no_grad():
        gaussians["opacity_logits"].fill_(6.0)
        gaussians["motion"][:, 4, layout["means"].start] = shift_mm / weight
        shades = torch.from_numpy(shade * rng.uniform(0, 1, (len(points), 1)) / weight)
        gaussians["motion"][:, 4, layout["sh_dc"]] = shades.float()
    num = len(points)
    return Scene(gaussians, None, cfg, (CAMERA,) * NUM_FRAMES, 25.0, torch.zeros(num), torch.zeros(num))


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
    color.compute(context)
    return context.result.scores["color_share"]


def test_the_pattern_is_a_checkerboard_on_the_first_frame():
    # The plane is gray below 0.5, so that half of it and half of a square's color are on either side of 0.4 in green.
    green = seen(paint_texture(wall()), 0)[..., 1]
    center = slice(SQUARE // 2, None, SQUARE)
    squares = green[center, center] > 0.5 * COLORS[:, 1].mean() + 0.2
    row, column = np.indices(squares.shape)
    assert np.array_equal(squares, (row + column) % 2 == 1)


def test_tissue_that_moves_carries_the_pattern_by_as_many_pixels():
    shift = 5 * SQUARE  # an odd number of squares: without motion every square would have the other color
    painted = paint_texture(wall(shift_mm=shift * DEPTH / FOCAL, shade=0.5))
    first, middle = seen(painted, 0), seen(painted, MIDDLE)
    assert np.abs(middle[:, shift:] - first[:, :-shift]).max() < 0.01  # rays that are more oblique widen Gaussians
    assert np.abs(middle - first).mean() > 0.1
    entered = middle[4:-4, : shift - 4]  # it was outside of the first frame, and so it is gray
    assert np.abs(entered - entered.mean(-1, keepdims=True)).max() < 1e-3


def test_color_that_changes_does_not_move_the_pattern():
    scene = wall(shade=0.5)
    painted = paint_texture(scene)
    assert np.abs(seen(scene, MIDDLE) - seen(scene, 0)).mean() > 0.05
    assert np.array_equal(seen(painted, MIDDLE), seen(painted, 0))


def test_what_the_first_frame_does_not_show_is_not_painted():
    scene = wall()
    hidden = scene.gaussians["means"].detach().clone()
    hidden[::2, 2] *= 1.1  # every second Gaussian lies 10 % deeper on its ray, behind the others
    hidden[::2, :2] *= 1.1
    scene.gaussians.tensors["means"] = hidden
    with torch.no_grad():
        scene.gaussians["log_scales"].add_(np.log(2))
    painted = paint_texture(scene).gaussians["sh_dc"] - scene.gaussians["sh_dc"]
    assert not painted[::2].any() and painted[1::2].abs().sum() > 100


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
    basis = replace(scene.config.deformation.basis, deform_color=False)
    config = replace(scene.config, deformation=replace(scene.config.deformation, basis=basis))
    with pytest.raises(ScoreUnavailable, match="do not change with time"):
        color_share(replace(scene, config=config))
