"""Splat containers, each read back by a reader that shares nothing with its writer."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from export_readers import read_compressed_ply, read_glb, read_sog, read_splat, read_spz
from export_scenes import covariances, random_splats
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from endoprior.core.checks import InputError
from endoprior.core.types import Splats
from endoprior.export.formats import load_format
from endoprior.export.gltf import encode_glb
from endoprior.export.packed_splats import encode_compressed_ply, encode_sog, encode_splat, encode_spz
from endoprior.export.ply import encode_ply

DC = 0.28209479177387814


def one_splat(**changes) -> Splats:
    """A Gaussian longest along its first axis, which a quarter turn about z brings to y."""
    values = {
        "means": [[1.0, 2.0, 3.0]],
        "quats": [[2**0.5, 0.0, 0.0, 2**0.5]],
        "scales": [[4.0, 2.0, 0.5]],
        "opacities": [0.25],
        "sh": [[[0.5, -0.5, 0.1]]],
    }
    return Splats(**{name: torch.tensor(value) for name, value in (values | changes).items()})


def columns(vertex, *names: str) -> np.ndarray:
    """(N, len(names)) of a PLY element."""
    return np.column_stack([vertex[name] for name in names])


@pytest.mark.parametrize("degree", range(4))
def test_ply_has_the_layout_of_3dgs(degree):
    splats = random_splats(degree=degree)
    data = PlyData.read(io.BytesIO(encode_ply(splats, "lps")))
    vertex = data["vertex"]
    num_rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(num_rest)] + ["opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    assert [p.name for p in vertex.properties] == names and {p.val_dtype for p in vertex.properties} == {"f4"}
    assert "SPACE=LPS" in data.comments
    assert np.array_equal(columns(vertex, "x", "y", "z"), splats.means.numpy())
    assert not columns(vertex, "nx", "ny", "nz").any()
    assert np.array_equal(columns(vertex, "f_dc_0", "f_dc_1", "f_dc_2"), splats.sh[:, 0].numpy())
    for k in range(num_rest // 3):
        for channel in range(3):  # all of red, then green, then blue
            stored = vertex[f"f_rest_{channel * (num_rest // 3) + k}"]
            assert np.array_equal(stored, splats.sh[:, k + 1, channel].numpy())
    assert 1 / (1 + np.exp(-vertex["opacity"])) == pytest.approx(splats.opacities.numpy(), rel=1e-6)
    assert np.exp(columns(vertex, "scale_0", "scale_1", "scale_2")) == pytest.approx(splats.scales.numpy(), rel=1e-6)
    rotation = columns(vertex, "rot_0", "rot_1", "rot_2", "rot_3")
    assert np.linalg.norm(rotation, axis=1) == pytest.approx(1, abs=1e-6)
    assert rotation * np.linalg.norm(splats.quats, axis=1)[:, None] == pytest.approx(splats.quats.numpy(), abs=1e-6)


def test_ply_of_opacities_at_the_end_is_finite():
    splats = one_splat(opacities=[1.0])
    assert 10 < PlyData.read(io.BytesIO(encode_ply(splats)))["vertex"]["opacity"][0] < 20


def test_splat_records():
    splats = random_splats()
    data = encode_splat(splats)
    assert len(data) == 32 * 50
    found = read_splat(data)
    order = np.argsort(-splats.scales.numpy().prod(1) * splats.opacities.numpy())
    assert np.array_equal(found["centers"].astype(np.float32), splats.means.numpy()[order])
    assert np.array_equal(found["scales"].astype(np.float32), splats.scales.numpy()[order])
    color = (splats.sh[:, 0].numpy() * DC + 0.5)[order]
    assert found["rgba"][:, :3] / 255 == pytest.approx(color, abs=0.5 / 255 + 1e-6)
    assert found["rgba"][:, 3] / 255 == pytest.approx(splats.opacities.numpy()[order], abs=0.5 / 255 + 1e-6)
    unit = (splats.quats / splats.quats.norm(dim=1, keepdim=True)).numpy()[order]
    assert found["quats"] == pytest.approx(unit, abs=1 / 128)  # 255 stands for +1


@pytest.mark.parametrize("degree", range(4))
def test_spz_within_its_precision(degree):
    splats = random_splats(degree=degree)
    found = read_spz(encode_spz(splats))
    assert found["means"] == pytest.approx(splats.means.numpy(), abs=0.5 / 4096 + 1e-9)
    assert found["opacities"] == pytest.approx(splats.opacities.numpy(), abs=0.5 / 255 + 1e-6)
    assert found["dc"] == pytest.approx(splats.sh[:, 0].numpy(), abs=0.5 / (255 * 0.15) + 1e-6)
    assert np.log(found["scales"]) == pytest.approx(splats.scales.log().numpy(), abs=0.5 / 16 + 1e-6)
    assert found["rest"] == pytest.approx(splats.sh[:, 1:].numpy(), abs=0.5 / 128 + 1e-6)
    # x, y, z within 1/255 and w at least 1/2 turn by less than 2.5 degrees
    turns = (
        covariances(found["quats"], np.array([[4.0, 2.0, 1.0]])),
        covariances(splats.quats.double().numpy(), np.array([[4.0, 2.0, 1.0]])),
    )
    assert turns[0] == pytest.approx(turns[1], abs=15 * np.deg2rad(2.5))
    assert (found["quats"][:, 0] > 0.49).all()


def test_spz_turns_are_exact_where_w_is_small():
    """Half a turn about x has w = 0, the worst case of the format; the same ellipsoid has a quaternion with w = 1."""
    splats = one_splat(quats=[[0.02, 1.0, 0.03, -0.01]])
    found = read_spz(encode_spz(splats))
    got = covariances(found["quats"], splats.scales.numpy())
    assert got == pytest.approx(
        covariances(splats.quats.numpy(), splats.scales.numpy()), abs=0.15
    )  # 1/255 of 16 - 0.25


def test_spz_of_a_large_scene_keeps_its_positions():
    found = read_spz(encode_spz(one_splat(means=[[9000.0, -8000.0, 5.0]])))
    assert found["bits"] == 9 and found["means"][0] == pytest.approx([9000, -8000, 5], abs=1 / 1024)
    with pytest.raises(InputError, match="finite"):
        encode_spz(one_splat(means=[[np.inf, 0.0, 0.0]]))


@pytest.mark.parametrize("degree", range(4))
def test_compressed_ply_within_its_precision(degree):
    splats = random_splats(600, degree=degree)
    found = read_compressed_ply(encode_compressed_ply(splats))
    means = splats.means.numpy()
    row = np.abs(found["means"][:, None] - means[None]).sum(-1).argmin(1)  # the file has another order
    assert sorted(row) == list(range(600))
    span = float(np.ptp(means, axis=0).max())
    assert found["means"] == pytest.approx(means[row], abs=0.51 * span / 1023)
    assert np.log(found["scales"]) == pytest.approx(splats.scales.log().numpy()[row], abs=0.01)
    assert found["opacities"] == pytest.approx(splats.opacities.numpy()[row], abs=0.5 / 255 + 1e-6)
    assert found["dc"] == pytest.approx(splats.sh[:, 0].numpy()[row], abs=0.03)
    assert found["rest"] == pytest.approx(splats.sh[:, 1:].numpy()[row], abs=4 / 255 + 1e-6)
    axes = np.array([[4.0, 2.0, 1.0]])
    wanted = covariances(splats.quats.double().numpy()[row], axes)
    assert covariances(found["quats"], axes) == pytest.approx(wanted, abs=0.06)


def test_sog_within_its_precision():
    splats = random_splats(1001, 1)
    data = encode_sog(splats)
    found = read_sog(data)
    assert data == encode_sog(splats)
    row = np.array([((splats.means.numpy() - mean) ** 2).sum(1).argmin() for mean in found["means"]])
    assert len(set(row)) == 1001
    assert found["means"] == pytest.approx(splats.means.numpy()[row], abs=0.01)  # 16 bits of the logarithm up to 90 mm
    for name, want in (("log_scales", splats.scales.log()), ("dc", splats.sh[:, 0])):
        assert found[name] == pytest.approx(want.numpy()[row], abs=0.501 * float(want.max() - want.min()) / 255)
    assert found["opacities"] == pytest.approx(splats.opacities.numpy()[row], abs=0.5 / 255 + 1e-6)
    axes = np.array([[4.0, 2.0, 1.0]])
    wanted = covariances(splats.quats.double().numpy()[row], axes)
    assert covariances(found["quats"], axes) == pytest.approx(wanted, abs=0.25)
    with pytest.raises(InputError, match="sog: expected finite"):
        encode_sog(one_splat(means=[[np.nan, 0.0, 0.0]]))
    assert read_sog(encode_sog(one_splat()))["means"] == pytest.approx(np.array([[1.0, 2.0, 3.0]]))


def test_compressed_ply_of_one_and_of_none():
    found = read_compressed_ply(encode_compressed_ply(one_splat(means=[[1.0, -2.0, 70.0]], opacities=[1.0])))
    assert found["means"] == pytest.approx(np.array([[1, -2, 70]]), abs=1e-4) and found["opacities"] == [1]
    nothing = Splats(**{name: value[:0] for name, value in one_splat().tensors.items()})
    assert not len(read_compressed_ply(encode_compressed_ply(nothing))["means"])
    with pytest.raises(InputError, match="finite"):
        encode_compressed_ply(one_splat(means=[[np.nan, 0.0, 0.0]]))


def test_neighbors_share_a_chunk_of_a_compressed_ply():
    """Chunks of a curve are small; those of the order in the scene span everything."""
    found = read_compressed_ply(encode_compressed_ply(random_splats(4096)))["means"]
    volume = np.prod([np.ptp(part, axis=0) for part in found.reshape(16, 256, 3)], axis=1)
    assert np.median(volume) < 0.2 * np.prod(np.ptp(found, axis=0))


@pytest.mark.parametrize("degree", range(4))
def test_glb_follows_the_ratified_extension(degree, tmp_path):
    splats = random_splats(degree=degree)
    gltf, arrays = read_glb(encode_glb(splats, {"time": 0.5}), tmp_path)
    (primitive,) = gltf.meshes[0].primitives
    assert gltf.extensionsUsed == ["KHR_gaussian_splatting"] and primitive.mode == 0
    assert primitive.extensions["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    assert gltf.nodes[gltf.scenes[gltf.scene].nodes[0]].scale == [0.001] * 3 and gltf.asset.extras == {"time": 0.5}
    position = gltf.accessors[primitive.attributes.POSITION]
    assert position.min == splats.means.amin(0).tolist() and position.max == splats.means.amax(0).tolist()
    assert np.array_equal(arrays["POSITION"], splats.means.numpy())
    prefix = "KHR_gaussian_splatting:"
    assert np.array_equal(arrays[prefix + "SCALE"], splats.scales.numpy())
    assert np.array_equal(arrays[prefix + "OPACITY"][:, 0], splats.opacities.numpy())
    stored = Rotation.from_quat(arrays[prefix + "ROTATION"])  # x, y, z, w
    assert np.linalg.norm(arrays[prefix + "ROTATION"], axis=1) == pytest.approx(1, abs=1e-6)
    matrix = stored.as_matrix() * splats.scales.numpy()[:, None]
    want = covariances(splats.quats.double().numpy(), splats.scales.double().numpy())
    assert matrix @ matrix.transpose(0, 2, 1) == pytest.approx(want, rel=1e-4, abs=1e-4)
    for band in range(degree + 1):
        for m in range(2 * band + 1):
            name = f"{prefix}SH_DEGREE_{band}_COEF_{m}"
            assert np.array_equal(arrays[name], splats.sh[:, band * band + m].numpy())
    assert f"{prefix}SH_DEGREE_{degree + 1}_COEF_0" not in arrays
    encoded = np.clip(splats.sh[:, 0].numpy() * DC + 0.5, 0, 1)
    back = arrays["COLOR_0"][:, :3].astype(np.float64)
    back = np.where(back <= 0.0031308, 12.92 * back, 1.055 * back ** (1 / 2.4) - 0.055)
    assert back == pytest.approx(encoded, abs=1e-5)
    assert np.array_equal(arrays["COLOR_0"][:, 3], splats.opacities.numpy())


ROUNDED = {  # largest error of position (mm), scale (share), opacity and color of each format
    "ply": (encode_ply, 0, 1e-6, 1e-6, 0),
    "gltf": (lambda splats: encode_glb(splats, {}), 0, 0, 0, 0),
    "splat": (encode_splat, 0, 0, 0.002, 0.007),
    "spz": (encode_spz, 2e-4, 0.032, 0.002, 0.014),
    "sog": (encode_sog, 0.01, 0.01, 0.002, 0.004),
    "compressed_ply": (encode_compressed_ply, 0.05, 0.003, 0.002, 0.016),
}


@pytest.mark.parametrize("name", ROUNDED)
@pytest.mark.parametrize("degree", [0, 3])
def test_our_reader_gives_what_was_written(name, degree):
    encode, *limits = ROUNDED[name]
    splats = random_splats(300, degree)
    found = load_format(name).read(encode(splats))
    own = (
        ((splats.means[:, None] - found.means[None]) ** 2).sum(-1).argmin(1)
    )  # some formats have an order of their own
    assert sorted(own.tolist()) == list(range(300))
    kept = found.sh.shape[1]
    assert kept == (1 if name in ("splat", "sog") else (degree + 1) ** 2)
    errors = [
        (found.means[own] - splats.means).abs().max(),
        (found.scales[own] / splats.scales - 1).abs().max(),
        (found.opacities[own] - splats.opacities).abs().max(),
        (found.sh[own] - splats.sh[:, :kept]).abs().max(),
    ]
    assert all(error <= limit for error, limit in zip(errors, limits, strict=True)), errors
    long = np.tile([3.0, 2.0, 1.0], (300, 1))
    turned = covariances(found.quats[own].numpy(), long), covariances(splats.quats.numpy(), long)
    assert np.abs(turned[0] - turned[1]).max() < 0.15
