"""Seen or guessed: which frames show a Gaussian, how far away the nearest is, and what the pictures say of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from export_scenes import moving_scene

from endoprior.core.geometry import project
from endoprior.core.types import Camera, Frame
from endoprior.model.scene import Scene
from endoprior.model.surface import WindowSupport, window_support
from endoprior.visualization.tissue_layers import SupportMap


def frames_of(scene: Scene, masks: list[np.ndarray]) -> list[Frame]:
    """One frame for each mask, at the times of the scene's frames."""
    found = []
    for k, mask in enumerate(masks):
        camera = scene.cameras[k]
        shape = (camera.height, camera.width)
        empty = np.zeros((*shape, 3), np.uint8)
        found.append(Frame(k, k / len(scene.cameras), camera, empty, mask, np.ones(shape, np.float32), mask))
    return found


def masks_of(camera: Camera, *hidden: slice | None) -> list[np.ndarray]:
    """Tissue everywhere but in the columns `hidden`, for each frame."""
    masks = []
    for columns in hidden:
        mask = np.ones((camera.height, camera.width), bool)
        if columns is not None:
            mask[:, columns] = False
        masks.append(mask)
    return masks


@pytest.fixture(scope="module")
def scene() -> Scene:
    return moving_scene()


def test_a_gaussian_is_seen_where_a_frame_shows_tissue_at_its_pixel(scene: Scene) -> None:
    camera = scene.cameras[0]
    everywhere = window_support(scene, frames_of(scene, masks_of(camera, None)))
    left_half = slice(0, camera.width // 2)
    found = window_support(scene, frames_of(scene, masks_of(camera, left_half)))
    x = project(scene.at(0.0).means.numpy().astype(np.float64), camera)[0][:, 0]
    assert everywhere.seen.any()
    np.testing.assert_array_equal(found.seen[:, 0], everywhere.seen[:, 0] & (x >= camera.width // 2))


def test_what_lies_behind_other_tissue_is_not_seen(scene: Scene) -> None:
    frames = frames_of(scene, masks_of(scene.cameras[0], None))
    seen = np.flatnonzero(window_support(scene, frames).seen[:, 0])
    moved = moving_scene()
    one = int(seen[len(seen) // 2])
    moved.gaussians["means"].detach()[one] *= 1.5  # along its ray: the camera of the first frame is at the origin
    assert not window_support(moved, frames).seen[one, 0]


def test_the_gap_is_counted_to_the_nearest_frame_that_saw_it() -> None:
    seen = np.array([[True, False, False], [False, True, True], [False, False, False]])
    support = WindowSupport(seen, np.array([0.0, 5.0, 10.0]), np.zeros(3, bool))
    np.testing.assert_allclose(support.gap(6.0), [6.0, 1.0, np.inf])
    np.testing.assert_array_equal(support.num_frames, [1, 2, 0])
    assert np.isinf(WindowSupport(np.zeros((2, 0), bool), np.zeros(0), np.zeros(2, bool)).gap(0.1)).all()


def test_the_picture_counts_frames_and_hatches_what_none_saw(scene: Scene) -> None:
    camera, width = scene.cameras[0], scene.cameras[0].width
    right_half = slice(width // 2, width)
    masks = masks_of(camera, right_half, right_half, right_half)
    shown = SupportMap(scene, lambda window: frames_of(scene, masks)).render(0.0, camera)
    plain = scene.render(0.0, camera).color.numpy()
    solid = np.isfinite(shown.num_frames)
    left, right = solid.copy(), solid.copy()
    left[:, width // 2 - 8 :], right[:, : width // 2 + 8] = False, False
    assert left.any() and right.any()
    assert np.median(shown.num_frames[left]) == pytest.approx(3, abs=0.5) and np.median(shown.num_frames[right]) == 0
    assert np.isinf(shown.gap_seconds[right]).mean() > 0.9 and np.median(shown.gap_seconds[left]) < 0.1
    assert np.isnan(shown.gap_seconds[~solid]).all()
    changed = np.abs(shown.color - plain).max(-1) > 0.02
    assert 0.1 < changed[right].mean() < 0.7, "stripes"
    assert changed[left].mean() < 0.1


def test_tissue_whose_depth_is_a_guess_is_dotted(scene: Scene) -> None:
    camera, width = scene.cameras[0], scene.cameras[0].width
    confidence = np.where(np.arange(width) < width // 2, 0.9, 0.1) * np.ones((camera.height, 1), np.float32)
    plain = frames_of(scene, masks_of(camera, None, None, None))
    sure = [replace(frame, depth_confidence=confidence.astype(np.float32)) for frame in plain]
    before, after = (SupportMap(scene, lambda window, f=f: f).render(0.0, camera) for f in (plain, sure))
    solid = np.isfinite(before.num_frames)
    changed = np.abs(after.color - before.color).max(-1) > 0.02
    assert not changed[:, : width // 2 - 8].any()
    assert 0.03 < changed[:, width // 2 + 8 :][solid[:, width // 2 + 8 :]].mean() < 0.3, "dots"
    np.testing.assert_array_equal(before.num_frames, after.num_frames)


def test_tissue_from_another_time_is_tinted(scene: Scene) -> None:
    slow = replace(scene, frames_per_second=0.1)
    camera = slow.cameras[0]
    frames = frames_of(slow, masks_of(camera, None, None, None))[2:]
    shown = SupportMap(slow, lambda window: frames).render(0.0, camera)
    solid = np.isfinite(shown.gap_seconds)
    assert np.median(shown.gap_seconds[solid]) == pytest.approx(2 / 0.1, rel=0.05)
    bluer = (
        shown.color[..., 2] - shown.color[..., 0]
        > slow.render(0.0, camera).color.numpy()[..., 2] - (slow.render(0.0, camera).color.numpy()[..., 0])
    )
    assert bluer[solid].mean() > 0.9
