"""Gaussians along the surface: normals from depth, a flat start, and scales that stay within their limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from endoprior.core.config import Config
from endoprior.core.config_deformation import BasisConfig, DeformationConfig
from endoprior.core.geometry import back_project, pixel_centers, quaternion_to_matrix
from endoprior.core.types import Camera, Frame
from endoprior.initialization.first_gaussians import create_gaussians, first_gaussians, flat_along, surface_normals
from endoprior.initialization.sampling import PointCloud
from endoprior.model.basis import basis_offsets, spline_weights
from endoprior.model.gaussians import temporal_shapes
from endoprior.model.ops import NUMBA
from endoprior.model.presets import preset
from endoprior.training.step import MAX_SCALE_SHARE, largest_share, limit_scales

WIDTH, HEIGHT = 160, 120


def camera(turn_deg: float = 0.0) -> Camera:
    """A camera turned about the vertical axis, 5 mm beside the origin."""
    a = math.radians(turn_deg)
    pose = np.eye(4)
    pose[:3, :3] = [[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]]
    pose[0, 3] = 5.0
    return Camera(WIDTH, HEIGHT, 150.0, 140.0, 82.0, 57.0, pose)


def frame_of(depth: np.ndarray, cam: Camera) -> Frame:
    image, everywhere = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.ones(depth.shape, bool)
    return Frame(0, 0.0, cam, image, everywhere, depth.astype(np.float32), depth > 0)


def plane_depth(normal: np.ndarray, distance: float, cam: Camera) -> np.ndarray:
    """Depth of the plane normal . x = distance in camera axes."""
    pixels = pixel_centers(WIDTH, HEIGHT)
    rays = np.stack(
        [(pixels[..., 0] - cam.cx) / cam.fx, (pixels[..., 1] - cam.cy) / cam.fy, np.ones((HEIGHT, WIDTH))], -1
    )
    return distance / (rays @ normal)


def cloud_at(depth: np.ndarray, cam: Camera, cells: np.ndarray) -> PointCloud:
    x, y = cells.T
    points = back_project(cells + 0.5, depth[y, x], cam).astype(np.float32)
    return PointCloud(points, np.zeros_like(points), np.zeros(len(points), np.int32))


CELLS = np.array([[0, 0], [WIDTH - 1, HEIGHT - 1], [80, 60], [30, 100], [150, 7]])


@pytest.mark.parametrize("turn", [0.0, 25.0])
def test_normals_of_a_plane_are_exact_up_to_the_border_of_the_picture(turn: float) -> None:
    normal = np.array([0.4, -0.3, 0.9]) / np.linalg.norm([0.4, -0.3, 0.9])
    cam = camera(turn)
    depth = plane_depth(normal, 60.0, cam)
    found = surface_normals(cloud_at(depth, cam, CELLS), [frame_of(depth, cam)])
    want = normal @ cam.world_to_camera[:3, :3]
    np.testing.assert_allclose(found, np.tile(want, (len(CELLS), 1)), atol=2e-3)


def test_tissue_behind_an_edge_does_not_tilt_the_normal() -> None:
    cam = camera()
    depth = np.full((HEIGHT, WIDTH), 60.0)
    depth[:, 80:] = 90.0
    found = surface_normals(cloud_at(depth, cam, np.array([[79, 50], [80, 50]])), [frame_of(depth, cam)])
    np.testing.assert_allclose(found, [[0, 0, 1]] * 2, atol=2e-3)


def test_a_lone_measured_pixel_faces_the_camera() -> None:
    cam, depth = camera(), np.zeros((HEIGHT, WIDTH))
    depth[50, 40] = 60.0
    found = surface_normals(cloud_at(depth, cam, np.array([[40, 50]])), [frame_of(depth, cam)])
    assert np.isfinite(found).all() and found[0, 2] > 0.99


def test_the_third_axis_is_turned_to_the_normal() -> None:
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals = np.vstack([normals / np.linalg.norm(normals, axis=1, keepdims=True), [0, 0, -1], [0, 0, 1]])
    turned = quaternion_to_matrix(flat_along(normals))[:, :, 2]
    np.testing.assert_allclose(turned, normals, atol=1e-6)


def test_a_start_keeps_its_shapes_and_opacities() -> None:
    cfg = preset("default", **{"init.opacity": 0.2, "deformation.basis.num_bases": 4}).fitted(4)
    zeros, quats = np.zeros((2, 3)), np.tile([0.5, 0.5, 0.5, 0.5], (2, 1))
    made = create_gaussians(zeros, zeros, np.log([[2.0, 2, 0.5], [1, 3, 4]]), cfg, quats, np.array([0.9, 0.3]))
    np.testing.assert_allclose(made.scales.detach(), [[2, 2, 0.5], [1, 3, 4]], rtol=1e-6)
    np.testing.assert_allclose(made.opacities.detach(), [0.9, 0.3], rtol=1e-6)
    assert made["quats"].tolist() == [[0.5] * 4] * 2
    spheres = create_gaussians(zeros, zeros, np.log([2.0, 3]), cfg)
    np.testing.assert_allclose(spheres.scales.detach(), [[2, 2, 2], [3, 3, 3]], rtol=1e-6)
    np.testing.assert_allclose(spheres.opacities.detach(), [0.2, 0.2], rtol=1e-6)


def test_the_first_gaussians_lie_flat_along_a_slanted_plane() -> None:
    normal = np.array([0.4, -0.3, 0.9]) / np.linalg.norm([0.4, -0.3, 0.9])
    cam = camera()
    frames = [frame_of(plane_depth(normal, 60.0, cam), cam)] * 2
    cfg = preset("default", **{"init.motion": "rest", "gaussians": 300, "init.thickness": 0.25}).fitted(2)
    first = first_gaussians(frames, cfg)
    turned = quaternion_to_matrix(first.quats)[:, :, 2]
    np.testing.assert_allclose(turned, np.tile(normal, (len(turned), 1)), atol=5e-3)
    thickness = np.exp(first.log_scales[:, 2] - first.log_scales[:, 0])
    np.testing.assert_allclose(thickness, 0.25, rtol=1e-5)
    assert (first.opacities == np.float32(cfg.init.opacity)).all() and first.motion is None


def test_scales_over_time_stay_within_the_factor() -> None:
    cfg = Config(deformation=DeformationConfig(kind="basis", basis=BasisConfig(5), max_scale_change=1.5))
    generator = torch.Generator().manual_seed(0)
    tensors = {name: 3 * torch.randn(20, *shape, generator=generator) for name, shape in temporal_shapes(cfg).items()}
    weights = {name: torch.from_numpy(spline_weights(0.3, n)).float() for name, n in (("motion", 5), ("changes", 4))}
    means, free = (torch.einsum("nbc,b->nc", tensors[name], weights[name]) for name in weights)
    offsets = basis_offsets(tensors, 0.3, cfg, NUMBA)
    limit = math.log(1.5)
    torch.testing.assert_close(offsets.log_scales, free[:, 4:7].clamp(-limit, limit), atol=1e-5, rtol=0)
    torch.testing.assert_close(offsets.means, means, atol=1e-5, rtol=0)
    assert offsets.log_scales.abs().max() == pytest.approx(limit)


def test_scales_are_limited_by_the_distance_to_the_camera() -> None:
    cam = camera(25.0)
    means = torch.tensor([[0.0, 0.0, 50.0], [10.0, -20.0, 100.0], [0.0, 0.0, 5.0]])
    log_scales = torch.tensor([[-1.0, 0.0, 5.0], [3.0, -4.0, 0.5], [0.0, 1.0, 2.0]])
    before = log_scales.clone()
    limit_scales(log_scales, means, cam, 0.02)
    distances = np.linalg.norm(means.numpy() - cam.center, axis=1)
    for n in range(3):
        largest = math.log(0.02 * max(distances[n], np.median(distances)))
        torch.testing.assert_close(log_scales[n], before[n].clamp(max=largest))


def test_gaussians_stay_as_flat_as_they_start() -> None:
    cam = camera()
    log_scales = torch.tensor([[1.0, 0.5, 0.6], [0.5, 1.0, -4.0], [2.0, 3.0, 4.0]])
    limit_scales(log_scales, torch.tensor([[0.0, 0.0, 1e4]]).expand(3, 3), cam, 1.0, 0.3)
    thin = math.log(0.3)
    torch.testing.assert_close(log_scales[:, 2], torch.tensor([0.5 + thin, -4.0, 2.0 + thin]))
    torch.testing.assert_close(log_scales[:, :2], torch.tensor([[1.0, 0.5], [0.5, 1.0], [2.0, 3.0]]))


def test_few_gaussians_may_be_as_large_as_they_are_apart() -> None:
    cam = camera()
    num = 4
    spacing_px = math.sqrt(cam.width * cam.height / num)
    assert largest_share(cam, num) == pytest.approx(spacing_px / cam.fx)
    assert largest_share(cam, 10_000_000) == MAX_SCALE_SHARE


def test_a_gaussian_in_the_camera_stays_finite() -> None:
    cam = camera()
    log_scales = torch.zeros(1, 3)
    limit_scales(log_scales, torch.from_numpy(cam.center[None].astype(np.float32)), cam, 0.02)
    assert log_scales.isfinite().all() and log_scales.exp().gt(0).all()
