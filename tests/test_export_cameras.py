"""`--format cameras`: seen from a camera of the file, the exported Gaussians are where our images show them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from export_scenes import export, moving_scene
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from endoprior.export.axes import ROTATIONS


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene of which one Gaussian is opaque, and its run folder; the camera moves and turns."""
    scene, folder = moving_scene(moving_camera=True), tmp_path_factory.mktemp("cameras") / "run"
    poses = [camera.world_to_camera.copy() for camera in scene.cameras]
    for i, pose in enumerate(poses):
        pose[:3] = Rotation.from_euler("xyz", [i, -i / 2, 9 * i], degrees=True).as_matrix() @ pose[:3]
    cameras = tuple(replace(c, world_to_camera=pose) for c, pose in zip(scene.cameras, poses, strict=True))
    with torch.no_grad():
        scene.gaussians["opacity_logits"].fill_(-20)
        scene.gaussians["opacity_logits"][449] = 4
    scene = replace(scene, cameras=cameras)
    scene.save(folder / "scene.safetensors")
    return scene, folder


@pytest.mark.parametrize("axes", ROTATIONS)
def test_an_exported_gaussian_is_on_the_pixel_of_the_image(scene, tmp_path, axes):
    scene, run = scene
    assert export(run, tmp_path / "cameras.json", "cameras", "--frame", axes) == 0
    assert export(run, tmp_path / "a.ply", "ply", "--frame", axes, "--times", "0.7") == 0
    cameras = json.loads((tmp_path / "cameras.json").read_text())
    assert [c["img_name"] for c in cameras] == [f"{i:06d}" for i in range(10)]
    camera = cameras[7]
    assert (camera["id"], camera["width"], camera["height"]) == (7, 64, 48)
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    center = np.array([vertex[c][449] for c in "xyz"], np.float64)
    to_world = np.array(camera["rotation"])
    assert np.linalg.det(to_world) == pytest.approx(1)
    x, y, z = to_world.T @ (center - camera["position"])
    pixel = camera["fx"] * x / z + camera["cx"], camera["fy"] * y / z + camera["cy"]
    alpha = scene.render(0.7).alpha.numpy()
    rows, columns = np.indices(alpha.shape) + 0.5
    shown = (alpha * columns).sum() / alpha.sum(), (alpha * rows).sum() / alpha.sum()
    assert z > 0 and pixel == pytest.approx(shown, abs=0.2)
