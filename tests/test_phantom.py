"""The phantom: geometry against closed forms and slow loops, the written folder against its own ground truth."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numba
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.core.geometry import bilinear
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.phantom.noise import cells, fractal
from endoprior.phantom.raster import FAR, rasterize, vertex_normals
from endoprior.phantom.scene import build_scene
from endoprior.phantom.surface import build_anatomy, build_plane, organs_at
from endoprior.phantom.views import visible_points

SMALL = PhantomConfig(frames=6, width=96, height=80, seed=3, stereo=True)
DEFAULT_MEANS = [91.4352, 0.20586, 58.6039, 97.7305, 74.1917, 6.7050, -2.0577, 74.1212]
"""Of frame 1: image, mask, depth, true image and true depth; of all tracks x, y and z."""

pytestmark = pytest.mark.usefixtures("all_vessels")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One small stereo sequence, written once."""
    out = tmp_path_factory.mktemp("phantom") / "sequence"
    write_phantom(out, SMALL)
    return out


def read(path):
    """One PNG, RGB where it has color."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, path
    return pixels[..., ::-1] if pixels.ndim == 3 else pixels


def frame(folder, index):
    """(image, mask, depth mm, truth image, truth z) of one frame."""
    name = f"{index:06d}"
    depth = read(folder / f"depth/{name}.png") * 0.01
    truth = read(folder / f"truth/tissue/{name}.png"), np.load(folder / f"truth/depth/{name}.npy")
    return read(folder / f"images/{name}.png"), read(folder / f"masks/{name}.png") == 255, depth, *truth


# --- the written folder ---------------------------------------------------------------------------------------------


def test_layout_and_types(folder):
    names = [f"{i:06d}" for i in range(SMALL.frames)]
    for kind in ("images", "masks", "depth", "right", "truth/tissue", "truth/depth"):
        suffix = "npy" if kind == "truth/depth" else "png"
        assert sorted(p.name for p in (folder / kind).iterdir()) == [f"{n}.{suffix}" for n in names], kind
    for kind in ("images", "right", "truth/tissue"):
        pixels = read(folder / kind / "000000.png")
        assert (pixels.shape, pixels.dtype) == ((80, 96, 3), np.uint8)
    for index in range(SMALL.frames):
        mask = read(folder / f"masks/{index:06d}.png")
        assert mask.dtype == np.uint8 and set(np.unique(mask)) == {0, 255}
    assert read(folder / "depth/000000.png").dtype == np.uint16
    z = np.load(folder / "truth/depth/000000.npy")
    assert z.dtype == np.float32 and np.isfinite(z).all() and 40 < z.min() and z.max() < 120
    assert not list(folder.parent.glob(".*")), "the unfinished folder is left over"


def test_description_and_poses(folder):
    described = json.loads((folder / "sequence.json").read_text())
    assert (described["width"], described["height"], described["mask_tool_value"]) == (96, 80, 255)
    assert described["fx"] == described["fy"] == pytest.approx(0.9 * 96)
    assert (described["cx"], described["cy"], described["depth_unit"], described["depth_scale"]) == (48, 40, "mm", 0.01)
    assert described["baseline_mm"] == 4.2
    pair = json.loads((folder / "calibration.json").read_text())
    assert pair["T_mm"] == [-4.2, 0, 0] and pair["K_left"] == pair["K_right"] and pair["K_left"][0][2] == 48
    assert np.array_equal(pair["R"], np.eye(3))
    poses = np.load(folder / "poses_bounds.npy")
    assert poses.shape == (6, 17)
    camera = poses[:, :15].reshape(6, 3, 5)
    assert np.array_equal(camera[:, :, :4], np.broadcast_to(np.eye(3, 4), (6, 3, 4)))
    assert np.allclose(camera[:, :, 4], [80, 96, described["fx"]])
    assert (poses[:, 15] > 15).all() and (poses[:, 16] < 120).all() and (poses[:, 15] < poses[:, 16]).all()


def test_mask_marks_a_tool_of_plausible_size(folder):
    for index in range(SMALL.frames):
        image, mask, _, truth, _ = frame(folder, index)
        assert 0.02 < mask.mean() < 0.40
        # Inside the mask the image is mostly something else than tissue: metal has little color.
        gap = np.abs(image.astype(float) - truth).max(-1)
        assert np.median(gap[mask]) > 20 > np.percentile(gap[~mask], 99)


def test_image_is_the_truth_plus_noise_outside_the_mask(folder):
    for index in range(SMALL.frames):
        image, mask, _, truth, _ = frame(folder, index)
        gap = image.astype(float)[~mask] - truth[~mask]
        # noise 1.6 levels at mid gray, up to 1.25 times that in the dark; clipping at 0 and 255 only shrinks it
        assert abs(gap.mean()) < 0.15 and 1.0 < gap.std() < 2.4 and np.abs(gap).max() < 12


def test_depth_is_tissue_depth_with_stereo_errors(folder):
    for index in range(SMALL.frames):
        _, mask, depth, _, z = frame(folder, index)
        measured = (depth > 0) & ~mask
        error = np.abs(depth - z)[measured]
        assert 0.05 < np.median(error) < 1.0  # about 0.3 mm is intended; 0 would mean no error model
        assert 0 < (depth == 0).mean() < 0.2  # 3-5 % at full size; bands one pixel wide weigh more in a small image
        # A tool is nearer than the tissue behind it, and depth sees the tool.
        inside = (depth > 0) & cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
        assert np.median((z - depth)[inside]) > 3


def test_tracks_lie_on_the_true_surface_where_visible(folder):
    tracks = np.load(folder / "truth/tracks.npz")
    points, visible = tracks["points"], tracks["visible"]
    assert points.shape == (6, 256, 3) and points.dtype == np.float32
    assert visible.shape == (6, 256) and visible.dtype == bool
    assert visible[0].mean() > 0.6 and not visible.all()
    fx, cx, cy = 0.9 * 96, 48.0, 40.0
    for index in range(SMALL.frames):
        _, mask, _, _, z = frame(folder, index)
        p = points[index][visible[index]].astype(float)
        pixels = np.stack([fx * p[:, 0] / p[:, 2] + cx, fx * p[:, 1] / p[:, 2] + cy], -1)
        assert (pixels >= 0).all() and (pixels <= [96, 80]).all()
        column, row = pixels[:, 0].astype(int), pixels[:, 1].astype(int)
        assert not mask[row, column].any()
        error = np.abs(bilinear(z, pixels) - p[:, 2])
        # One pixel is 0.9 mm here, so bilinear depth is off by the surface's curvature over one pixel.
        assert np.median(error) < 0.1 and np.percentile(error, 95) < 1.2


def test_some_tracks_move_far_and_occlusion_moves(folder):
    points = np.load(folder / "truth/tracks.npz")["points"]
    moved = np.linalg.norm(points - points[:1], axis=-1).max(0)
    assert moved.max() > 8 and np.percentile(moved, 20) < 4.5  # the pull is local, breathing is a few mm
    masks = np.stack([frame(folder, i)[1] for i in range(SMALL.frames)])
    assert (masks.any(0) & ~masks.all(0)).sum() > 0.3 * masks.any(0).sum()


def test_same_seed_gives_the_same_bytes_for_any_threads(folder, tmp_path):
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        write_phantom(tmp_path / "again", SMALL)
    finally:
        numba.set_num_threads(threads)
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(tmp_path / "again") for p in (tmp_path / "again").rglob("*") if p.is_file())
    for name in files:
        assert (folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_the_default_phantom_stays_as_it_is(tmp_path):
    """Sums over a small one, at the commit before it could slide. Bytes also depend on the CPU, so not on them."""
    write_phantom(tmp_path / "p", PhantomConfig(frames=3, width=96, height=80, seed=3))
    tracks = np.load(tmp_path / "p/truth/tracks.npz")
    assert tracks.files == ["points", "visible"] and not (tmp_path / "p/truth/camera_to_world.npy").exists()
    image, mask, depth, truth, z = frame(tmp_path / "p", 1)
    found = [image.mean(), mask.mean(), depth.mean(), truth.mean(), z.mean(), *tracks["points"].mean((0, 1))]
    assert found == pytest.approx(DEFAULT_MEANS, rel=1e-3)


@pytest.mark.slow
def test_seeds_differ_and_mono_has_no_right_image(folder, tmp_path):
    out = tmp_path / "other"
    done = []
    cfg = replace(SMALL, seed=4, frames=2, stereo=False)
    write_phantom(out, cfg, progress=lambda index, count: done.append((index, count)))
    assert done == [(1, 2), (2, 2)]
    assert not (out / "right").exists() and not (out / "calibration.json").exists()
    gap = read(out / "truth/tissue/000000.png").astype(float) - read(folder / "truth/tissue/000000.png")
    assert np.abs(gap).mean() > 15
    assert np.abs(np.load(out / "truth/depth/000000.npy") - np.load(folder / "truth/depth/000000.npy")).mean() > 2


@pytest.mark.slow
def test_principal_point_moves_the_image(tmp_path):
    # The same ray is seen at another pixel: an off-center principal point shifts the true depth map by whole pixels.
    out, count = {}, 2
    for x in (48.0, 52.0):
        cfg = PhantomConfig(frames=count, width=96, height=80, principal_x=x)
        write_phantom(tmp_path / str(x), cfg)
        out[x] = np.load(tmp_path / str(x) / "truth/depth/000000.npy")
        assert json.loads((tmp_path / str(x) / "sequence.json").read_text())["cx"] == x
    # The mesh is laid out anew, so depths agree to its resolution (1.7 mm cells) except at the rims of organs.
    assert np.median(np.abs(out[48.0][:, :-4] - out[52.0][:, 4:])) < 0.05


def test_occupied_output_is_an_error(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    with pytest.raises(InputError, match=r"full.*new or empty"):
        write_phantom(tmp_path / "full", SMALL)
    assert [p.name for p in tmp_path.rglob("*")] == ["full", "note.txt"]


def test_all_vertices_in_the_image_are_tracked_if_more_points_are_wanted(tmp_path):
    write_phantom(tmp_path / "data", PhantomConfig(frames=2, width=64, height=32, tracks=20_000))
    visible = np.load(tmp_path / "data/truth/tracks.npz")["visible"]
    assert 5000 < visible.shape[1] < 13_000 and visible[0].mean() > 0.5


def test_border_and_overlay_hide_points(tmp_path):
    out = tmp_path / "data"
    write_phantom(out, replace(SMALL, frames=2, border="octagon", overlay=True, stereo=False, tracks=2000))
    tracks = np.load(out / "truth/tracks.npz")
    for index in (0, 1):
        covered = np.load(out / "truth/border.npy") | np.load(out / f"truth/overlay/{index:06d}.npy")
        z = tracks["points"][index, :, 2]
        pixels = (SMALL.focal * tracks["points"][index, :, :2] / z[:, None] + SMALL.center).astype(int)
        inside = ((pixels >= 0) & (pixels < (SMALL.width, SMALL.height))).all(1)
        x, y = pixels[inside].T
        visible = tracks["visible"][index, inside]
        assert covered[y, x].sum() > 50 and not visible[covered[y, x]].any()
        assert visible[~covered[y, x]].mean() > 0.5


INSPECT = {"camera": "inspect"}


@pytest.mark.parametrize(
    "change",
    [
        {"frames": 1}, {"width": 16}, {"height": 0}, {"seed": -1}, {"pull_mm": 99.0}, {"smooth_share": 1.0},
        {"slide_mm": 12.0, "focal_per_width": 1.4}, {"noise": float("nan")}, {"width": 640, "height": 64},
        {"principal_x": 0.0}, {"tracks": 0}, {"baseline_mm": -4.2}, {"frames": 1, **INSPECT},
        {"focal_per_width": 0.6, **INSPECT}, {"width": 300, "height": 480, **INSPECT},
        {"width": 2560, "height": 1440, **INSPECT}, {"instruments": "pink"}, {"tissue": "pink"},
        {"camera": "pink"}, {"scene": "pink"},
    ],
)  # fmt: skip
def test_values_out_of_range_are_input_errors(change):
    with pytest.raises(InputError, match="expected") as caught:
        PhantomConfig(**change)
    assert "\n" not in str(caught.value) and ("pink" in change.values()) == ("one of" in str(caught.value))


# --- geometry and noise ---------------------------------------------------------------------------------------------


def test_plane_coordinates_and_grid_are_inverse():
    cfg = PhantomConfig(seed=5)
    plane = build_plane(cfg)
    assert np.allclose(plane.axes @ plane.axes.T, np.eye(3), atol=1e-12)
    assert plane.axes[2, 2] < 0 and plane.axes[1, 1] > 0  # normal to the camera, e_b down the image
    grid_u, grid_v = np.meshgrid([0.0, 0.3, 1.0], [0.1, 0.8], indexing="xy")
    a, b = plane.coordinates(grid_u, grid_v)
    assert np.allclose(plane.grid(a, b), (grid_u, grid_v), atol=1e-12)


def test_loop_height_slow_loop():
    anatomy = build_anatomy(2)
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-20, 20, (2, 1, 25))
    organs = organs_at(anatomy, a, b)
    for j in range(25):
        k = organs.owner[0, j]
        if k < 0:
            continue
        best = (np.inf, 0.0, 0.0)
        path = anatomy.paths[k].astype(float)
        for m in range(len(path) - 1):
            edge, offset = path[m + 1] - path[m], np.array([a[0, j], b[0, j]]) - path[m]
            f = np.clip(offset @ edge / (edge @ edge), 0, 1)
            distance = np.linalg.norm(offset - f * edge)
            radius = (1 - f) * anatomy.radii[k, m] + f * anatomy.radii[k, m + 1]
            base = (1 - f) * anatomy.bases[k, m] + f * anatomy.bases[k, m + 1]
            best = min(best, (distance, radius, base))
        distance, radius, base = best
        assert abs(organs.across[0, j]) == pytest.approx(distance, abs=1e-4)  # float32 coordinates of tens of mm
        if distance < 0.9 * radius:
            want = base + 0.9 * radius * np.sqrt(1 - (distance / radius) ** 2)
            assert organs.height[0, j] == pytest.approx(want, abs=1e-3)


def test_rasterized_slanted_plane_closed_form():
    b, a = np.mgrid[-60:60:9.0, -60:60:7.0]
    vertices = np.stack([a, b, 70 + 0.3 * a - 0.2 * b], -1)
    hits = rasterize(vertices, 60.0, (32.0, 24.0), 64, 48)
    x, y = np.meshgrid((np.arange(64) + 0.5 - 32) / 60, (np.arange(48) + 0.5 - 24) / 60)
    z = 70 / (1 - 0.3 * x + 0.2 * y)  # ray (x, y, 1) z on the plane
    assert np.allclose(hits[..., 2], z, rtol=2e-5)  # float32 screen coordinates
    assert np.allclose(hits[..., 0], (x * z - a[0, 0]) / (a[0, -1] - a[0, 0]), atol=1e-4)
    assert np.allclose(hits[..., 1], (y * z - b[0, 0]) / (b[-1, 0] - b[0, 0]), atol=1e-4)
    want = np.array([0.3, -0.2, -1]) / np.linalg.norm([0.3, -0.2, -1])
    assert np.allclose(vertex_normals(vertices), want, atol=1e-6)


def test_nearest_surface_wins_and_gaps_stay_far():
    # A mesh that runs to the right at z = 60 and folds back to the left at z = 50: the near sheet hides the far one.
    x = np.array([-10.0, 10.0, 10.0, -5.0])
    z = np.array([60.0, 60.0, 50.0, 50.0])
    vertices = np.stack([np.stack([x, np.full(4, y), z], -1) for y in (-10.0, 10.0)])
    for mesh in (vertices, vertices[:, ::-1]):  # whichever sheet is drawn first
        hits = rasterize(mesh, 60.0, (20.0, 20.0), 40, 40)
        assert np.allclose(hits[20, 16:30, 2], 50) and np.allclose(hits[20, 11:13, 2], 60)
        assert hits[20, 2, 2] == FAR and hits[2, 20, 2] == FAR


def test_a_point_is_visible_unless_out_of_frame_buried_or_under_a_tool():
    cfg = PhantomConfig(width=96, height=80)
    z, tool = np.full((80, 96), 60, np.float32), np.zeros((80, 96), bool)
    tool[:, 60:] = True
    points = np.array([[0, 0, 60.0], [0, 0, 63.0], [-60, 0, 60.0], [20, 0, 60.0]])
    assert visible_points(points, z, tool, cfg).tolist() == [True, False, False, False]


def test_fractal_slow_loop_and_continuity():
    x, y = np.array([[0.3, 1.3, 7.0]]), np.array([[0.6, -2.2, 3.0]])
    one, two = fractal(x, y, 1, 5), fractal(x, y, 2, 5)
    assert one[0, 2] == 0  # gradient noise vanishes on lattice points
    assert np.allclose(fractal(x + 1e-4, y, 2, 5), two, atol=2e-3) and not np.allclose(one, fractal(x, y, 1, 6))
    grid = np.meshgrid(np.linspace(0, 40, 200), np.linspace(0, 40, 200))
    noise = fractal(*grid, 3, 9)
    assert abs(noise.mean()) < 0.05 and 0.15 < noise.std() < 0.5
    assert cells(*grid, 1).min() >= 0 and 0.1 < cells(*grid, 1).mean() < 0.6


@pytest.mark.slow
def test_no_sample_falls_between_triangles():
    cfg = PhantomConfig(frames=16, width=320, height=256)
    scene, size = build_scene(cfg), (2 * cfg.width, 2 * cfg.height)
    center = (2 * cfg.center[0], 2 * cfg.center[1])
    for index in (5, 10):  # where rounding once left a sample on an edge to neither side
        hits = rasterize(scene.vertices(index / 15), 2 * cfg.focal, center, *size)
        assert hits[..., 2].max() < FAR
