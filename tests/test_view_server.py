"""The viewer over its own protocol: images, clicks; scenes, sequences, training."""

import csv
import hashlib
import io
import json
import math
import threading
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData
from pygltflib import GLTF2
from slicer_reader import Bundle, sequence_index
from view_client import Client, at_work, wait_until

from endoprior.cli.view import live_view, open_viewable
from endoprior.core.config import Config
from endoprior.core.types import Camera, to_uint8
from endoprior.data import load_sequence
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.gaussians import Gaussians
from endoprior.model.presets import preset
from endoprior.model.scene import Scene, SingleScene
from endoprior.runs.train import train
from endoprior.view import live
from endoprior.view.measure import DrawnTracks
from endoprior.view.panel import (
    AREA,
    BROWSER,
    CLEAR,
    DISPLACEMENT,
    IMAGE,
    LAYER_NAMES,
    MESH,
    ORBIT,
    PLY,
    POINTS,
    SLICER,
    STRETCH,
    TABLE,
    VIDEO,
)
from endoprior.view.server import Viewer
from endoprior.view.viewable import ViewSettings
from endoprior.view.viewable_scene import ViewableScene
from endoprior.view.viewable_sequence import ViewableSequence

NUM_FRAMES = 6
CAMERA = Camera(64, 48, 80.0, 80.0, 32.0, 24.0, np.eye(4))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A wall of Gaussians at 50 mm that slides 7 mm to the right over the video."""
    cfg: Config = preset("default").fitted(20)
    x, y = np.meshgrid(np.linspace(-24, 24, 40), np.linspace(-18, 18, 30))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 50.0)], -1).astype(np.float32)
    colors = np.random.default_rng(0).random((len(points), 3), np.float32)
    gaussians = create_gaussians(points, colors, np.full(len(points), np.log(0.8), np.float32), cfg)
    with torch.no_grad():
        gaussians["opacity_logits"].fill_(3.0)
        gaussians["motion"][:, :, 0] = torch.linspace(0, 7, gaussians["motion"].shape[1])
    score = torch.linspace(0, 1, len(points))
    return SingleScene(gaussians, None, cfg, (CAMERA,) * NUM_FRAMES, 25.0, score, torch.ones(len(points)))


@pytest.fixture
def viewer(scene, tmp_path):
    """A viewer of that scene, at work."""
    with at_work(Viewer(ViewableScene(scene, "wall"), out=tmp_path / "view")) as viewer:
        yield viewer


@pytest.fixture
def client(viewer):
    """A connected stand-in for a browser, after its first image."""
    client = Client(viewer.url)
    client.send_camera()
    client.image()
    yield client
    client.socket.close()


def close(a, b, levels: float = 3.0) -> bool:
    """Whether two images agree up to JPEG errors."""
    return a.shape == b.shape and np.abs(a.astype(float) - b).mean() < levels


def test_the_image_equals_the_rendering_of_the_scene(scene):
    settings, viewable = ViewSettings(frame=3), ViewableScene(scene, "wall")
    assert np.array_equal(viewable.picture(settings, CAMERA), to_uint8(scene.render(3 / NUM_FRAMES).color.numpy()))
    assert viewable.surface(settings, CAMERA)[24, 32] == pytest.approx(50, abs=1e-3)


def test_so_it_does_on_the_white_background_of_some_methods(scene, monkeypatch):
    black = scene.render(3 / NUM_FRAMES).color.numpy()
    monkeypatch.setattr(type(scene), "background", (1.0, 1.0, 1.0))
    white = scene.render(3 / NUM_FRAMES).color.numpy()
    assert np.abs(white - black).max() > 0.01, "two levels of 255 and more"
    assert np.array_equal(ViewableScene(scene, "wall").picture(ViewSettings(frame=3), CAMERA), to_uint8(white))


def test_the_slider_changes_the_image(viewer, client, scene):
    client.set(viewer.panel.frame, 5)
    expected = to_uint8(scene.render(5 / NUM_FRAMES).color.numpy())
    canvas = client.image()
    assert viewer.settings.frame == 5 and canvas.shape[:2] == (52, 64)  # 600 x 480 is narrower than 64 x 48
    assert np.array_equal(canvas[2:50], expected) and not canvas[0].any()


def test_a_window_of_another_height_shows_the_image_undistorted(viewer, client):
    client.send_camera(image_width=600, image_height=600)
    assert client.image().shape[:2] == (64, 64)
    client.send_camera(image_width=600, image_height=1200)  # a phone is turned: the image is as wide as before
    assert client.image().shape[:2] == (128, 64)


@pytest.mark.slow
def test_every_layer_is_a_different_image(viewer, client):
    client.set(viewer.panel.frame, 4)
    images = {"color": client.image()}
    for layer in ("depth", "alpha", "displacement", "stretch", "prior"):
        client.set(viewer.panel.layer, LAYER_NAMES[layer])
        images[layer] = client.image()
    for a in images:
        assert all(a == b or not close(images[a], images[b]) for b in images)


@pytest.mark.slow
def test_the_free_camera_and_clipping(viewer, client):
    client.set(viewer.panel.camera, ORBIT)
    client.image()
    client.send_camera()
    facing = client.image()
    client.send_camera(position=(0, 0, -50))
    assert not close(client.image(), facing)
    client.set(viewer.panel.clip, (0.0, 40.0))
    assert client.image().max() < 10  # the wall is behind the far end
    client.send_camera()
    client.send_camera(position=(np.nan, 0, 0))  # nothing can be seen from nowhere: it stays where it was
    client.set(viewer.panel.clip, (0.0, viewer.panel.clip_end))
    assert np.array_equal(client.image(), facing)


def test_two_clicks_measure_and_the_distance_follows_the_tissue(viewer, client, scene):
    client.set(viewer.panel.measure, True)
    client.set(viewer.panel.tracks, True)
    time.sleep(0.3)
    for x in (0.25, 0.75):
        client.click(x, 0.5)
    client.image()
    assert viewer.measuring.measured.curve("Distance") == pytest.approx(np.full(NUM_FRAMES, 32 / 80 * 50), abs=0.05)
    assert "mm" in viewer.panel.distance.content
    shift = viewer.measuring.measured.paths[-1, 0, 0] - viewer.measuring.measured.paths[0, 0, 0]
    moved = scene.at((NUM_FRAMES - 1) / NUM_FRAMES).means - scene.at(0).means
    assert shift == pytest.approx(float(moved[0, 0]), abs=1e-3) and shift > 1
    client.click(1.5, 0.5)
    client.click(np.nan, 0.5)
    time.sleep(0.5)
    assert viewer.measuring.measured.paths.shape[1] == 2  # clicks on nothing change nothing


def test_a_click_in_any_frame_starts_a_track(viewer, client, scene):
    client.set(viewer.panel.frame, 3)
    before = client.image()
    client.set(viewer.panel.follow, True)
    time.sleep(0.3)
    client.click(0.5, 0.5)
    marked = client.image()
    assert len(viewer.tracks.picked) == 1 and viewer.measuring.measured is None
    (track,) = viewer.tracks.picked
    assert track.positions[3, 0] == pytest.approx([0, 0, 50], abs=0.7)
    moved = scene.at((NUM_FRAMES - 1) / NUM_FRAMES).means - scene.at(0).means
    assert track.positions[-1, 0, 0] - track.positions[0, 0, 0] == pytest.approx(float(moved[0, 0]), abs=1e-3)
    rows, columns = np.nonzero((marked != before).any(-1))
    assert len(rows) and abs(rows.mean() - 25.5) < 2 and abs(columns.max() - 32) < 4  # a trail that ends at the click
    client.set(viewer.panel.clear_tracks, True)
    assert np.array_equal(client.image(), before) and not viewer.tracks.picked


def test_a_track_fades_where_a_tool_hides_its_point_or_where_it_is_uncertain(scene, make_tiny_sequence):
    sequence = load_sequence(make_tiny_sequence(num_frames=NUM_FRAMES, width=64, height=48))
    viewable = ViewableScene(scene, "wall", sequence)
    covered = np.argwhere(sequence.frame(4).tissue_mask & ~sequence.frame(1).tissue_mask)
    y, x = covered[len(covered) // 2] + 0.5
    under_tool = np.array([(x - 32) / 80 * 50, (y - 24) / 80 * 50, 50.0])
    assert not viewable.shows(under_tool[None], 1)[0]
    assert ViewableScene(scene, "wall").shows(under_tool[None], 1)[0], "without the sequence nothing is known of tools"
    tracks = DrawnTracks(viewable)
    tracks.pick(under_tool, 1)
    lines = tracks.lines(1, False)
    assert not lines.dots.any() and lines.colors[-1].max() < 128
    assert tracks.lines(4, False).dots.any(), "seen again"
    picked = tracks.picked[0]
    assert picked.errors is not None
    tracks.picked = [replace(picked, errors=replace(picked.errors, confidence=np.zeros((NUM_FRAMES, 1))))]
    assert not tracks.lines(4, False).dots.any(), "not certain there any more"


@pytest.mark.slow
def test_every_quantity_is_measured_and_saved_as_a_table(viewer, client):
    client.set(viewer.panel.measure, True)
    client.set(viewer.panel.quantity, AREA)
    time.sleep(0.3)
    for at in ((0.3, 0.4), (0.7, 0.4), (0.7, 0.6), (0.3, 0.6)):
        client.click(*at)
    client.image()
    assert viewer.measuring.measured.curve(AREA) == pytest.approx(
        np.full(NUM_FRAMES, 16 * 6.5), rel=0.02
    )  # canvas 64 x 52 px
    assert "mm²" in viewer.panel.distance.content and viewer.panel.chart.visible
    client.set(viewer.panel.since, 2)
    client.set(viewer.panel.quantity, STRETCH)
    client.image()
    assert viewer.measuring.measured.curve(STRETCH) == pytest.approx(
        np.ones(NUM_FRAMES), abs=0.01
    )  # the wall slides as a whole
    assert viewer.measuring.measured.curve(DISPLACEMENT)[2] == 0 < viewer.measuring.measured.curve(DISPLACEMENT)[4]
    client.set(viewer.panel.points, TABLE)
    wait_until(lambda: list(viewer.out.glob("measures*.csv")))
    rows = list(csv.DictReader((viewer.out / "measures_1.csv").read_text().splitlines()))
    assert len(rows) == NUM_FRAMES and float(rows[1]["area_mm2"]) == pytest.approx(
        viewer.measuring.measured.curve(AREA)[1], abs=1e-3
    )
    client.set(viewer.panel.points, CLEAR)
    client.set(viewer.panel.points, TABLE)
    time.sleep(0.3)
    assert viewer.measuring.measured is None and len(list(viewer.out.iterdir())) == 1


def test_displacement_and_stretch_are_since_the_reference_frame(scene):
    viewable = ViewableScene(scene, "wall")
    for layer in ("displacement", "stretch"):
        settings = ViewSettings(frame=5, layer=layer, since=5)
        assert "since frame 5: blue" in viewable.legend(settings)
        assert np.ptp(viewable.picture(settings, CAMERA).reshape(-1, 3), 0).max() <= 4  # nothing has moved: one color
    moved = viewable.picture(ViewSettings(frame=5, layer="displacement", since=0), CAMERA)
    assert not close(moved, viewable.picture(ViewSettings(frame=5, layer="displacement", since=5), CAMERA))
    # The wall goes on beyond the image of the reference frame: what its stretch is there is not known.
    beside = replace(CAMERA, cx=-20.0)
    alpha, stretch = (
        viewable.picture(ViewSettings(frame=5, layer=layer, endoscope=False), beside) for layer in ("alpha", "stretch")
    )
    assert alpha[24, 2].min() > 200 and stretch[24, 2].any()
    assert alpha[24, 23].min() > 200 and not stretch[24, 23].any()


def test_each_gaussian_has_a_color_also_behind_the_camera(scene):
    turned = np.eye(4)
    turned[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # looks along the wall, from its middle
    turned[:3, 3] = -turned[:3, :3] @ [0, 0, 50]
    cameras = tuple(replace(camera, world_to_camera=turned) for camera in scene.cameras)
    cloud = ViewableScene(replace(scene, cameras=cameras), "wall").cloud(ViewSettings(layer="prior"))
    assert len(cloud.colors) == len(cloud.points) == len(scene)


@pytest.mark.slow
def test_play_advances_and_pauses(viewer, client):
    client.set(viewer.panel.speed, "0.5x")
    client.set(viewer.panel.play, True)
    seen = set()
    wait_until(lambda: seen.add(viewer.settings.frame) or len(seen) >= 4, 3)
    client.set(viewer.panel.play, True)
    client.image()
    at = viewer.settings.frame
    time.sleep(0.4)
    assert viewer.settings.frame == at == viewer.panel.frame.value


def test_a_browser_can_render_the_gaussians_itself(viewer, client):
    def demand(handle, value, *kinds):
        client.set(handle, value)
        missing, end = set(kinds), time.monotonic() + 20
        while missing and (left := end - time.monotonic()) > 0:
            with suppress(TimeoutError):
                missing -= {message["type"] for message in client.read(left)}
        assert not missing, f"no {missing} came after {value}"

    demand(viewer.panel.rendered_by, BROWSER, "GaussianSplatsMessage", "BackgroundImageMessage")
    demand(viewer.panel.rendered_as, POINTS, "PointCloudMessage")
    demand(viewer.panel.layer, LAYER_NAMES["depth"], "BackgroundImageMessage")  # no color of a Gaussian


@pytest.mark.slow
def test_screenshot_and_video_are_stored_in_the_run(viewer, client):
    client.set(viewer.panel.save_view, IMAGE)
    client.set(viewer.panel.camera, ORBIT)
    client.set(viewer.panel.keep, True)
    client.image()
    client.send_camera(position=(2, 0, 0))
    client.set(viewer.panel.frame, 3)
    client.set(viewer.panel.keep, True)
    client.set(viewer.panel.save_view, VIDEO)
    wait_until(lambda: list(viewer.out.glob("color*.mp4")), 20)
    assert sorted(path.name for path in viewer.out.iterdir()) == ["color_000000_1.png", "color_1.mp4"]


def received(client, wanted: str, seconds: float = 60) -> list[dict]:
    """The messages until the first of this type."""
    found, end = [], time.monotonic() + seconds
    while not any(message["type"] == wanted for message in found):
        found += client.read(end - time.monotonic())
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("button", "name"), [(PLY, "gaussians_000003.ply"), (SLICER, "tissue.mrb"), (MESH, "moving_mesh.glb")]
)
def test_the_model_is_saved_for_other_programs(viewer, client, scene, button, name):
    client.set(viewer.panel.frame, 3)
    wait_until(lambda: viewer.settings.frame == 3)
    client.set(viewer.panel.save_scene, button)
    (begun,) = (m for m in received(client, "FileTransferStartDownload") if m["type"] == "FileTransferStartDownload")
    stored = viewer.out / f"{name.replace('.', '_1.')}"
    wait_until(stored.is_file)
    content = stored.read_bytes()
    assert (begun["filename"], begun["size_bytes"]) == (name, len(content))
    if button == PLY:
        vertices = PlyData.read(io.BytesIO(content))["vertex"]
        means = np.stack([vertices[axis] for axis in "xyz"], 1)
        assert means == pytest.approx(scene.at(3 / NUM_FRAMES).means.numpy(), abs=1e-4)
    elif button == SLICER:
        bundle = Bundle(content)
        steps = [node for node in bundle.nodes.values() if "indexValues" in node.attributes]
        assert all(len(sequence_index(node)) == NUM_FRAMES for node in steps) and steps
    else:
        gltf = GLTF2.load_from_bytes(content)
        assert gltf is not None
        assert gltf.accessors[gltf.animations[0].samplers[0].input].count == NUM_FRAMES


@pytest.mark.slow
def test_the_page_says_how_far_it_is_and_what_went_wrong(viewer, client):
    client.set(viewer.panel.save_scene, SLICER)
    shown = received(client, "RemoveNotificationMessage")
    titles = [m["props"]["title"] for m in shown if m["type"] == "NotificationShowMessage"]
    counts = [m["props"]["body"] for m in shown if m["type"] == "NotificationUpdateMessage"]
    assert titles[0] == "Writing the model: Slicer" and all(count.endswith(f" of {NUM_FRAMES}") for count in counts)
    assert counts
    tensors = viewer.viewable.scene.gaussians.tensors
    faint = Gaussians(tensors | {"opacity_logits": torch.full_like(tensors["opacity_logits"], -12.0)})
    viewer.jobs.put(lambda: viewer.show(ViewableScene(replace(viewer.viewable.scene, gaussians=faint), "clear")))
    client.set(viewer.panel.save_scene, MESH)
    wait_until(lambda: viewer.viewable.title == "clear")
    shown = []
    while not any("props" in m and m["props"].get("title") == "That did not work" for m in shown):
        shown += client.read(30)
    (said,) = (m["props"]["body"] for m in shown if "props" in m and m["props"].get("title") == "That did not work")
    assert "expected" in said and "\n" not in said
    assert not list(viewer.out.glob("moving_mesh*"))


def test_a_raw_sequence_has_no_model_to_save(tiny_sequence):
    viewer = Viewer(ViewableSequence(load_sequence(tiny_sequence)))
    try:
        assert not viewer.panel.save_scene.visible and viewer.panel.save_view.visible
    finally:
        viewer.close()


def test_the_server_binds_to_this_machine_only(viewer):
    assert viewer.server.get_host() == "127.0.0.1" and viewer.server.request_share_url() is None


@pytest.mark.slow
def test_a_raw_sequence_is_shown_before_training(tiny_sequence):
    sequence = load_sequence(tiny_sequence)
    viewable = ViewableSequence(sequence)
    frame, camera = sequence.frame(2), sequence.camera(2)
    assert np.array_equal(viewable.picture(ViewSettings(frame=2, layer="frame"), camera), frame.rgb_u8)
    kinds = [viewable.picture(ViewSettings(frame=2, layer=layer), camera) for layer in viewable.layers]
    assert len({kind.tobytes() for kind in kinds}) == 3
    cloud = viewable.cloud(ViewSettings(frame=2, layer="frame", endoscope=False))
    assert len(cloud.points) == (frame.depth_valid & frame.tissue_mask).sum()
    free = ViewSettings(frame=2, layer="frame", endoscope=False)
    seen = viewable.surface(free, camera)
    both = (seen > 0) & frame.depth_valid & frame.tissue_mask
    assert both.sum() > 1000 and np.median(np.abs(seen - frame.depth)[both]) < 0.2
    with at_work(Viewer(viewable)) as viewer:
        client = Client(viewer.url)
        client.send_camera()
        first = client.image()
        client.set(viewer.panel.layer, LAYER_NAMES["depth"])
        assert not close(client.image(), first)
        client.set(viewer.panel.camera, ORBIT)
        client.set(viewer.panel.measure, True)
        time.sleep(0.5)
        for x in (0.45, 0.55):
            client.click(x, 0.7)
        time.sleep(0.5)
        assert (
            np.isfinite(viewer.measuring.measured.curve("Distance")).sum() == 1
        )  # the motion of the points is unknown
        client.socket.close()


def test_lengths_of_relative_depth_are_not_called_mm(tiny_sequence):
    file = tiny_sequence / "sequence.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"depth_relative": True}))
    viewable, out = open_viewable(tiny_sequence, None)
    assert viewable.relative and out is None and "mm" not in viewable.legend(ViewSettings(layer="depth"))
    viewer = Viewer(viewable)
    assert "not mm" in viewer.panel.status.content and "rel." in viewer.panel.clip.label
    viewer.close()


def test_a_window_of_other_length_is_shown_from_its_own_frames(scene):
    viewer, shorter = Viewer(ViewableScene(scene, "first")), replace(scene, cameras=scene.cameras[:3])
    viewer.panel.frame.value = 5
    viewer.settings = replace(viewer.settings, frame=5, since=4)
    for shown, last, settings in ((shorter, 2, (2, 2)), (scene, 5, (2, 2))):
        viewer.show(ViewableScene(shown, "second"))
        assert (viewer.settings.frame, viewer.settings.since) == settings
        assert (viewer.panel.frame.value, viewer.panel.frame.max, viewer.panel.since.max) == (2, last, last)
        assert "frame 2" in viewer.panel.status.content
    viewer.close()


def short_config() -> Config:
    """Few Gaussians, few iterations."""
    cfg = preset("default")
    schedule = replace(cfg.schedule, coarse_iterations=0, fine_iterations=12)
    return replace(cfg, init=replace(cfg.init, budget=300), schedule=schedule)


@pytest.mark.slow
def test_the_viewer_does_not_change_the_training(tiny_sequence, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(live, "REFRESH_SECONDS", 0.0)
    monkeypatch.setattr(live, "MAX_TIME_SHARE", math.inf)
    digests, shown = [], []
    for watched in (False, True):
        out, client = tmp_path / f"run{watched}", None
        with live_view(0 if watched else None) as on_step:

            def step(report, trainer, on_step=on_step, watched=watched):
                nonlocal client
                on_step(report, trainer)
                if watched:
                    if client is None:
                        assert f"view: {on_step.viewer.url}\n" in capsys.readouterr().out
                        client = Client(on_step.viewer.url)
                        client.send_camera()
                        threading.Event().wait(0.3)
                    client.set(
                        on_step.viewer.panel.layer, LAYER_NAMES["displacement" if report.iteration % 2 else "prior"]
                    )
                    threading.Event().wait(0.05)
                    shown.append(on_step.viewer.panel.status.content)

            train(load_sequence(tiny_sequence), short_config(), out, on_step=step)
            if client:
                assert client.image(timeout=5, quiet=0.2).any()
                client.socket.close()
        digests.append(hashlib.sha256((out / "scene.safetensors").read_bytes()).hexdigest())
    assert digests[0] == digests[1]
    assert "iteration 11" in shown[-1] or "iteration 12" in shown[-1]
