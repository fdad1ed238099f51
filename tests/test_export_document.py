"""docs/format.md, taken at its word: its reader gives what the program gives, and it names every tensor."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from export_scenes import moving_scene, plane_camera
from hexplane_grids import planes

from endoprior.export.axes import ROTATIONS
from endoprior.export.formats import FORMATS
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.hexplane_field import HexPlaneField
from endoprior.model.presets import preset
from endoprior.model.scene import Scene, SingleScene

DOCS = Path(__file__).parents[1] / "docs"
TIMES = (0.0, 0.13, 0.5, 0.99, 1.0)


@pytest.fixture(scope="module")
def reader():
    """The document's reader as a module."""
    spec = importlib.util.spec_from_file_location("reader", DOCS / "read_scene.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def check(scene: Scene, found: tuple, time: float) -> None:
    """Compare with the program's own evaluation: float32 of mm below 100."""
    want = scene.at(time)
    for name, value in zip(("means", "quats", "scales", "opacities", "sh"), found, strict=True):
        assert value.shape == getattr(want, name).shape, name
        assert value == pytest.approx(getattr(want, name).detach().numpy(), rel=1e-4, abs=2e-5), name


@pytest.mark.parametrize(
    "changes", [{}, {"deform_opacity": True}, {"deform_shape": False}, {"deform_shape": False, "deform_opacity": True}]
)
def test_reader_evaluates_the_basis(reader, tmp_path, changes):
    cfg = preset("default").fitted(20)
    cfg = replace(cfg, deformation=replace(cfg.deformation, **changes))
    cfg = replace(cfg, schedule=replace(cfg.schedule, sh_degree=1))
    scene = replace(random_scene(cfg), field=None)
    scene.save(tmp_path / "scene.safetensors")
    arrays, about = reader.read(tmp_path / "scene.safetensors")
    for time in TIMES:
        check(scene, reader.at(arrays, about, time), time)
    assert not np.allclose(reader.at(arrays, about, 0.1)[0], reader.at(arrays, about, 0.6)[0], atol=1e-2)


def test_reader_evaluates_the_hexplane(reader, tmp_path):
    cfg = preset("paper").fitted(20)
    hexplane = planes((5, 6, 7), 9, 8, (1, 2))
    cfg = replace(cfg, deformation=replace(cfg.deformation, hexplane=hexplane, deform_opacity=True))
    scene = random_scene(cfg)
    means = scene.gaussians["means"].detach()
    field = HexPlaneField.from_points(means[:-5], cfg.deformation, torch.Generator().manual_seed(3))
    field.grid.values.uniform_(0.5, 1.5, generator=torch.Generator().manual_seed(4))
    scene = replace(scene, field=field)
    scene.save(tmp_path / "scene.safetensors")
    arrays, about = reader.read(tmp_path / "scene.safetensors")
    for time in TIMES:
        check(scene, reader.at(arrays, about, time, reader.hexplane_offsets), time)
    assert not np.allclose(scene.at(0.1).means, scene.at(0.6).means, atol=1e-2)


def random_scene(cfg) -> Scene:
    """Forty Gaussians with nothing at its starting value."""
    rng = np.random.default_rng(2)
    points = rng.uniform([-15, -12, 50], [15, 12, 60], (40, 3)).astype(np.float32)
    gaussians = create_gaussians(points, rng.random((40, 3), np.float32), np.zeros(40, np.float32), cfg)
    with torch.no_grad():
        for name, tensor in gaussians.tensors.items():
            if name != "means":
                tensor.add_(torch.from_numpy(rng.normal(size=tensor.shape).astype(np.float32)) * 0.3)
    return SingleScene(gaussians, None, cfg, (plane_camera(),) * 10, 25.0, torch.zeros(40), torch.zeros(40))


def test_document_names_every_tensor_of_the_file(reader, tmp_path):
    scene = moving_scene()
    scene.save(tmp_path / "scene.safetensors")
    arrays, about = reader.read(tmp_path / "scene.safetensors")
    text = (DOCS / "format.md").read_text(encoding="utf-8")
    assert not [name for name in arrays if f"`{name}`" not in text]
    assert not [key for key in about if f"`{key}`" not in text]


def test_documents_know_every_format_and_frame():
    for name in FORMATS:
        assert f"`{name}`" in (DOCS / "export.md").read_text(encoding="utf-8")
    for name in ROTATIONS:
        assert f"| `{name}`" in (DOCS / "format.md").read_text(encoding="utf-8")
