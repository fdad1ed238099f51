"""Depth from the light in a tube, where no points are triangulated: its closed form, and what is no tube."""

import cv2
import numpy as np
import pytest

from endoprior.prepare.camera_path import shape
from endoprior.prepare.camera_path.shape import MAX_DEPTH_RATIO, axial_cosine, shape_by_light
from endoprior.prepare.camera_path.tracks import PoseInput, TrackingCamera
from endoprior.prepare.relative_depth import fit_shading

SIZE = WIDTH, HEIGHT = 160, 128
CAMERA = TrackingCamera(np.array([[140.0, 0, 79.5], [0, 140.0, 63.5], [0, 0, 1]]), SIZE, True)
COSINE = axial_cosine(CAMERA)
EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)
Y, X = np.mgrid[:HEIGHT, :WIDTH]


def lit(distance, cos_slope, gain):
    """(H, W, 3) image of a surface of one color, lit by a lamp at the camera."""
    linear = np.clip(gain * cos_slope / distance**2, 0, 1)
    return np.rint(255 * linear[..., None] ** (1 / 2.2) * [1.0, 0.6, 0.5]).astype(np.uint8)


def straight_tube(turn_degrees=(6.0, 4.0), radius=12.0):
    """z and distance along the rays (H, W), and cosine of the slope, inside a cylinder through the camera."""
    rays = np.stack([(X - 79.5) / 140, (Y - 63.5) / 140, np.ones(X.shape)], -1)
    axis = cv2.Rodrigues(np.deg2rad([*turn_degrees, 0.0]))[0] @ [0, 0, 1.0]
    across = np.linalg.norm(np.cross(rays, axis), axis=-1) / np.linalg.norm(rays, axis=-1)  # sine to the axis
    distance = np.minimum(radius / np.maximum(across, 1e-6), 120.0)
    return distance * COSINE, distance, across


def shaded(image):
    """A frame with depth from its shading."""
    return PoseInput(image, EVERYWHERE, fit_shading([image], [EVERYWHERE]).depth(image, EVERYWHERE))


def error(z, truth, where=EVERYWHERE):
    ratio = (z / truth)[where]
    return float(np.median(np.abs(ratio / np.median(ratio) - 1)))


def test_a_tube_lit_by_a_lamp_at_the_camera_gives_its_depth_back(monkeypatch):
    monkeypatch.setattr(shape, "EXPONENT", 1 / 3)  # exact in a tube without folds
    z, distance, cos_slope = straight_tube()
    frames = [shaded(lit(distance, cos_slope, gain)) for gain in (250, 300, 350)]
    found = shape_by_light(frames, COSINE)
    assert found is not None and not found.pixels
    measured = distance < 80
    for frame in frames:
        assert error(found.shaped(0, frame.depth), z, measured) < 0.04
        assert error(frame.depth, z, measured) > 0.15
    assert found.shaped(1, frames[1].depth).max() <= MAX_DEPTH_RATIO * found.middle


def test_the_usual_exponent_is_nearer_to_a_tube_than_plain_shading():
    z, distance, cos_slope = straight_tube()
    frame = shaded(lit(distance, cos_slope, 300))
    found = shape_by_light([frame], COSINE)
    assert found is not None
    assert error(found.shaped(0, frame.depth), z) < 0.5 * error(frame.depth, z)


def test_depth_that_has_the_shape_already_or_another_source_stays():
    _, distance, cos_slope = straight_tube()
    frame = shaded(lit(distance, cos_slope, 300))
    found = shape_by_light([frame], COSINE)
    assert found is not None
    again = PoseInput(frame.rgb_u8, EVERYWHERE, found.shaped(0, frame.depth))
    assert shape_by_light([again], COSINE) is None
    other = np.random.default_rng(0).uniform(50, 90, X.shape).astype(np.float32)
    assert shape_by_light([PoseInput(frame.rgb_u8, EVERYWHERE, other)], COSINE) is None


@pytest.mark.parametrize("scene", ["wall", "shadow", "edge"])
def test_what_is_dark_elsewhere_is_no_tube(scene):
    bright = np.full(X.shape, 0.4)
    if scene == "shadow":  # a dark place in an image that is darker to its rim
        bright *= np.exp(-2 * (((X - 80) / 80) ** 2 + ((Y - 64) / 64) ** 2))
        bright[50:75, 60:90] = 0.01
    if scene == "edge":  # one side is dark
        bright = np.where(X > 80, 0.03, 0.15 + 0.003 * X)
    frame = shaded(lit(np.ones(X.shape), bright, 1.0))
    assert shape_by_light([frame] * 3, COSINE) is None


def test_half_of_the_frames_must_show_a_tube():
    _, distance, cos_slope = straight_tube()
    seen, wall = shaded(lit(distance, cos_slope, 300)), shaded(lit(np.ones(X.shape), np.full(X.shape, 0.4), 1.0))
    assert shape_by_light([seen, seen, wall], COSINE) is not None
    assert shape_by_light([seen, wall, wall], COSINE) is None
    assert shape_by_light([], COSINE) is None
    hidden = PoseInput(seen.rgb_u8, ~EVERYWHERE, seen.depth)
    assert shape_by_light([hidden], COSINE) is None
