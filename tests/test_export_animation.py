"""`--format animation`: one mesh whose vertices are carried by the model, as a glTF reader and Blender evaluate it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from export_scenes import moving_scene
from programs import open_in_blender
from pygltflib import GLTF2, Accessor

from endoprior.cli import main
from endoprior.export.axes import points_in_axes
from endoprior.export.mesh import Mesh, depth_grid
from endoprior.model.carry import carry_points
from endoprior.model.scene import Scene
from endoprior.model.scene_file import load_scene
from endoprior.model.surface import render_surface

TIMES = (0.1, 0.2, 0.6, 0.9)
SECONDS = (0.04, 0.08, 0.24, 0.36)  # ten frames at 25 per second


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with a scene whose Gaussians and camera move."""
    folder = tmp_path_factory.mktemp("animation") / "run"
    moving_scene(moving_camera=True).save(folder / "scene.safetensors")
    return folder


@pytest.fixture(scope="module")
def file(run, tmp_path_factory):
    """The exported animation."""
    out = tmp_path_factory.mktemp("animation") / "moving.glb"
    options = ("--times", *map(str, TIMES), "--mesh-step", "3")
    assert main(["export", str(run), str(out), "--format", "animation", *options]) == 0
    return out


@pytest.fixture(scope="module")
def expected(run) -> tuple[Mesh, np.ndarray]:
    """The mesh of the first time, and its (T, V, 3) vertices carried to all times; world axes, mm."""
    scene: Scene = load_scene(run)
    mesh = depth_grid(render_surface(scene, TIMES[0], scene.cameras[1], 0.5), 3, 5.0)
    return mesh, carry_points(scene, mesh.vertices, np.zeros(len(mesh.vertices), np.intp), list(TIMES))


class Reader:
    """A .glb file by pygltflib, evaluated as the glTF specification says."""

    def __init__(self, file: Path) -> None:
        self.gltf = GLTF2().load(str(file))
        (self.primitive,) = self.gltf.meshes[0].primitives
        (animation,) = self.gltf.animations
        (channel,), (sampler,) = animation.channels, animation.samplers
        assert (channel.target.node, channel.target.path, sampler.interpolation) == (0, "weights", "LINEAR")
        self.seconds = self.array(sampler.input)
        self.weights = self.array(sampler.output).reshape(len(self.seconds), len(self.primitive.targets))

    def accessor(self, number: int) -> Accessor:
        return self.gltf.accessors[number]

    def array(self, number: int) -> np.ndarray:
        accessor = self.accessor(number)
        view = self.gltf.bufferViews[accessor.bufferView]
        kind, width = {5126: "<f4", 5125: "<u4"}[accessor.componentType], {"SCALAR": 1, "VEC3": 3}[accessor.type]
        assert view.byteOffset % 4 == 0 and view.byteLength == 4 * accessor.count * width
        values = np.frombuffer(self.gltf.binary_blob(), kind, accessor.count * width, view.byteOffset)
        return values if width == 1 else values.reshape(-1, width)

    def positions(self, second: float) -> np.ndarray:
        """(V, 3) in the scene, meters."""
        weights = [np.interp(second, self.seconds, column) for column in self.weights.T]
        moved = self.array(self.primitive.attributes.POSITION).astype(np.float64)
        for weight, target in zip(weights, self.primitive.targets, strict=True):
            moved = moved + weight * self.array(target["POSITION"])
        return moved * self.gltf.nodes[0].scale


def test_vertices_are_where_the_model_carries_them(file, expected):
    found, (mesh, carried) = Reader(file), expected
    assert found.seconds == pytest.approx(SECONDS)
    want = points_in_axes(carried, "opengl") / 1000
    for second, there in zip(SECONDS, want, strict=True):
        assert found.positions(second) == pytest.approx(there, abs=1e-8)  # 0.01 micrometers
    assert found.positions(0.16) == pytest.approx((want[1] + want[2]) / 2, abs=1e-8)
    assert np.abs(want[2] - want[0]).max() > 1e-4  # it does move
    assert np.array_equal(found.array(found.primitive.indices).reshape(-1, 3), mesh.triangles)


def test_colors_are_linear_and_not_lit_again(file, expected):
    found, (mesh, _) = Reader(file), expected
    linear = found.array(found.primitive.attributes.COLOR_0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert 255 * encoded == pytest.approx(mesh.colors, abs=0.01)
    material = found.gltf.materials[found.primitive.material]
    assert material.extensions == {"KHR_materials_unlit": {}} and material.doubleSided
    assert found.gltf.extensionsUsed == ["KHR_materials_unlit"]


def test_the_document_says_what_readers_need(file):
    found = Reader(file)
    bounded = [found.primitive.attributes.POSITION, *(target["POSITION"] for target in found.primitive.targets)]
    for number in (*bounded, found.gltf.animations[0].samplers[0].input):
        values = found.array(number).reshape(found.accessor(number).count, -1)
        assert found.accessor(number).min == pytest.approx(values.min(0))
        assert found.accessor(number).max == pytest.approx(values.max(0))
    targets = {found.gltf.bufferViews[found.accessor(n).bufferView].target for n in bounded}
    assert targets == {34962}
    assert found.gltf.bufferViews[found.accessor(found.primitive.indices).bufferView].target == 34963
    assert found.gltf.meshes[0].weights == [0, 0, 0], "VTK and ParaView show no motion without them"
    assert found.gltf.meshes[0].extras["targetNames"] == ["000001", "000002", "000003"]
    assert found.gltf.asset.extras == {"unit": "mm", "axes": "opengl", "lengths_are_relative": False}


def test_every_frame_of_the_sequence(run, tmp_path):
    out = tmp_path / "all.glb"
    options = ("--mesh-method", "tsdf", "--voxel-mm", "4", "--frame", "lps")
    assert main(["export", str(run), str(out), "--format", "animation", *options]) == 0
    found = Reader(out)
    assert found.seconds == pytest.approx([i / 25 for i in range(10)])
    assert np.median(found.positions(0)[:, 1]) == pytest.approx(0.06, abs=0.005)  # y is depth in LPS


@pytest.mark.parametrize(("times", "first", "last"), [((), 0, 9), (("--times", "0.2", "0.55"), 2, 6)])
def test_the_command_says_what_to_type_in_blender(run, tmp_path, capsys, times, first, last):
    """Blender's importer sets neither the frame rate nor the frames that are played."""
    out = tmp_path / "it's.glb"
    assert main(["export", str(run), str(out), "--format", "animation", "--mesh-step", "8", *times]) == 0
    code = capsys.readouterr().out.split("type: ")[1].strip()
    opened, bpy = [], SimpleNamespace(context=SimpleNamespace(scene=SimpleNamespace(render=SimpleNamespace())))
    bpy.ops = SimpleNamespace(import_scene=SimpleNamespace(gltf=lambda filepath: opened.append(filepath)))
    exec(code, {"bpy": bpy})
    scene = bpy.context.scene
    assert (scene.render.fps, scene.frame_start, scene.frame_end) == (25, first, last) and opened == [str(out)]


@pytest.mark.slow
def test_blender_shows_the_same_motion_and_colors(file, expected, tmp_path):
    seconds = np.array((*SECONDS, 0.16))
    found, (mesh, carried) = open_in_blender(file, tmp_path, list(24 * seconds)), expected
    # The importer turns glTF's y up into Blender's z up: right, forward, up.
    want = points_in_axes(carried, "opengl")[..., [0, 2, 1]] * [1, -1, 1]
    want = np.concatenate([want, (want[1:2] + want[2:3]) / 2])
    assert 1000 * found["positions"] == pytest.approx(want, abs=0.01)  # mm
    assert np.array_equal(np.sort(found["triangles"]), np.sort(mesh.triangles))
    linear = found["colors"][:, :3]
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert 255 * encoded == pytest.approx(mesh.colors[found["corners"]], abs=1.01)  # Blender stores 8 bits
    assert found["shows_colors"].all()
