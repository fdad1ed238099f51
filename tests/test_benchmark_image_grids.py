"""What the figures of a benchmark show, against closed forms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from endoprior.core.types import Camera, Frame
from endoprior.model.scene import Scene
from endoprior_studies.figures import (
    center_density,
    frames_grid,
    instability_map,
    prior_grid,
    sides_grid,
    zoom_windows,
)

WIDTH, HEIGHT = 80, 60


def frame(index: int = 0) -> Frame:
    """Gray tissue with a highlight at (20, 10), a dark spot at (60, 45), and a tool in the lower left corner."""
    rgb = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    rgb[8:13, 18:23] = 255
    rgb[40:50, 52:68] = 5
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[45:, :10] = False
    rgb[~mask] = 250
    camera = Camera(WIDTH, HEIGHT, 100.0, 100.0, WIDTH / 2, HEIGHT / 2, np.eye(4))
    depth = np.full((HEIGHT, WIDTH), 50, np.float32)
    return Frame(index, index / 4, camera, rgb, mask, depth, np.ones_like(mask))


@Scene.register
@dataclass
class Still:
    """Stands in for a scene: centers that rest, depth that grows by `step` a frame."""

    centers: np.ndarray
    step: float = 0.0
    shift_mm: float = 0.0
    """How far to the left the scene's own cameras stand."""

    @property
    def cameras(self) -> list[Camera]:
        pose = np.eye(4)
        pose[0, 3] = self.shift_mm
        return [replace(frame(i).camera, world_to_camera=pose) for i in range(4)]

    def at(self, time: float) -> SimpleNamespace:
        return SimpleNamespace(means=torch.from_numpy(self.centers))

    def render(self, time: float, camera: Camera) -> SimpleNamespace:
        depth = torch.full((HEIGHT, WIDTH), 50 + self.step * 4 * time)
        depth[:, -5:] = 0
        shade = 0.5 + camera.world_to_camera[0, 3] / 100
        return SimpleNamespace(depth=depth, color=torch.full((HEIGHT, WIDTH, 3), shade))


def test_windows_hold_what_they_are_named_for():
    windows = zoom_windows(frame())

    def holds(name: str, x: int, y: int) -> bool:
        rows, cols = windows[name]
        return rows.start <= y < rows.stop and cols.start <= x < cols.stop

    assert holds("highlight", 20, 10) and holds("dark", 60, 45)
    assert holds("boundary", 9, 50) or holds("boundary", 5, 45)
    for rows, cols in windows.values():
        assert (rows.stop - rows.start, cols.stop - cols.start) == (HEIGHT // 4, WIDTH // 4)
        assert 0 <= rows.start and rows.stop <= HEIGHT and 0 <= cols.start and cols.stop <= WIDTH


def test_instability_is_the_mean_change_where_both_show_rendered_tissue():
    frames = [frame(i) for i in range(4)]
    frames[2].tissue_mask[:5] = False
    found = instability_map(Still(np.zeros((1, 3)), 0.25), frames)
    rendered = np.ones((HEIGHT, WIDTH), bool)
    rendered[:, -5:] = False
    rendered[45:, :10] = False
    assert np.isnan(found[~rendered]).all()
    assert found[rendered] == pytest.approx(0.25, abs=1e-5)  # float32 depths near 50


def test_density_counts_centers_in_front_and_inside():
    centers = np.array([[0, 0, 50], [0, 0, -50], [500, 0, 50]], np.float64)
    found = center_density(Still(centers), frame())
    assert found.sum() == pytest.approx(1, rel=1e-3)
    assert np.unravel_index(found.argmax(), found.shape) == (HEIGHT // 2, WIDTH // 2)


class FrameSequence:
    """Stands in for a sequence of two frames, of which one is held out."""

    def frames(self, split):
        return [frame(1)]

    def frame(self, index):
        return frame(index)


def test_scenes_are_shown_from_their_own_poses():
    rest, moved = (Still(np.array([[0.0, 0, 50]]), shift_mm=shift) for shift in (0, 5))
    found = center_density(moved, frame())
    assert np.unravel_index(found.argmax(), found.shape) == (HEIGHT // 2, WIDTH // 2 + 10)  # 100 px * 5 mm / 50 mm
    both = frames_grid(FrameSequence(), {"rest": rest, "moved": moved})
    first, second = both[200, 480 + 240], both[200, 2 * 480 + 240]
    assert (second.astype(int) - first > 5).all()


def test_grids_have_a_column_for_each_method():
    scenes = {name: Still(np.array([[0.0, 0, 50]])) for name in "ab"}
    width, height = 6 * WIDTH, 6 * HEIGHT  # enlarged to 480 px
    assert frames_grid(FrameSequence(), scenes).shape == (4 * height, 3 * width, 3)
    assert prior_grid(FrameSequence(), scenes).shape == (height, 4 * width, 3)


def test_the_prior_is_shown_without_any_scene_of_gaussians():
    """Radiance fields have no centers; a benchmark of them alone has its figures all the same."""
    assert prior_grid(FrameSequence(), {"field": object()}).shape == (6 * HEIGHT, 12 * WIDTH, 3)


def test_sides_look_from_left_front_and_right():
    height = 6 * HEIGHT
    scenes = {"a": Still(np.zeros((1, 3))), "b": Still(np.zeros((1, 3)), shift_mm=2)}
    found = sides_grid(FrameSequence(), scenes)
    assert found.shape == (3 * height, 12 * WIDTH, 3)
    # `Still` is brighter the further its camera stands to the left: 50 mm sin 15 degrees = 12.9 mm. Two roundings.
    column = found[height // 2 :: height, 240, 0].astype(int)
    assert column[1] == 128 and column[0] - column[1] == pytest.approx(255 * 0.129, abs=2)
    assert column[2] - column[1] == pytest.approx(-255 * 0.129, abs=2)
