"""The moving exports in three.js and PlayCanvas, whose engine SuperSplat uses: opened by their own readers in Chromium.

The pictures are kept in `build/programs/` to be looked at.
"""

from __future__ import annotations

import threading
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from browser import open_page, pictures_folder, require_chromium
from export_scenes import export, moving_run
from programs import node_module

from endoprior.export.axes import points_in_axes
from endoprior.export.mesh import depth_grid
from endoprior.model.carry import carry_points
from endoprior.model.scene_file import load_scene
from endoprior.model.surface import render_surface

pytestmark = pytest.mark.slow
STEP = 3  # of the mesh, px
SPLAT_FORMATS = ("ply", "compressed_ply", "sog")
WIDTH, HEIGHT, FOCAL = 640, 480, 800.0
THREE = """<!doctype html><script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "/three/examples/jsm/loaders/GLTFLoader.js";
const found = await new GLTFLoader().loadAsync("/files/moving.glb");
const mesh = found.scene.getObjectByProperty("isMesh", true), mixer = new THREE.AnimationMixer(found.scene);
mixer.clipAction(found.animations[0]).play();
window.steps = Array.from(found.animations[0].tracks[0].times);
window.colors = Array.from(mesh.geometry.attributes.color.array);
window.lit = mesh.material.type;
window.positionsAt = second => {
  mixer.setTime(second);
  found.scene.updateMatrixWorld(true);
  const at = new THREE.Vector3();
  return Array.from({length: mesh.geometry.attributes.position.count}, (_, i) =>
    mesh.getVertexPosition(i, at).applyMatrix4(mesh.matrixWorld).toArray());
};
window.ready = true;
</script>"""
PLAYCANVAS = """<!doctype html><body style="margin: 0"><canvas id="c" width="640" height="480"></canvas>
<script type="module">
import * as pc from "/playcanvas/build/playcanvas.mjs";
const app = new pc.Application(document.getElementById("c"));
app.start();
const camera = new pc.Entity(), shown = new pc.Entity();
camera.addComponent("camera", {fov: 2 * Math.atan(240 / 800) * 180 / Math.PI, nearClip: 1, farClip: 1000,
                               clearColor: new pc.Color(0, 0, 0, 1)});
shown.setLocalEulerAngles(180, 0, 0);  // from our axes, y down and z forward
app.root.addChild(camera);
app.root.addChild(shown);
window.show = url => new Promise((done, failed) => {
  const asset = new pc.Asset(url, "gsplat", {url});
  asset.on("load", () => {
    shown.removeComponent("gsplat");
    shown.addComponent("gsplat", {asset});
    window.splats = asset.resource.gsplatData;
    done(true);
  });
  asset.on("error", failed);
  app.assets.add(asset);
  app.assets.load(asset);
});
window.values = name => Array.from(splats.getProp(name));
window.ready = true;
</script>"""


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    require_chromium()
    return moving_run(tmp_path_factory.mktemp("web") / "run")


class _Handler(SimpleHTTPRequestHandler):
    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".mjs": "text/javascript"}

    def log_message(self, *_) -> None:
        pass


@contextmanager
def opened(folder: Path, module: Path, html: str):
    """A page of this HTML in Chromium, with the files of `folder` at /files and an npm package beside them."""
    site = folder.parent / f"site_{module.name}"
    site.mkdir()
    (site / "index.html").write_text(html)
    (site / "favicon.ico").touch()
    (site / module.name).symlink_to(module.resolve())
    (site / "files").symlink_to(folder)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, directory=str(site)))
    worker = threading.Thread(target=server.serve_forever)
    worker.start()
    try:
        with open_page(f"http://127.0.0.1:{server.server_port}/", width=WIDTH, height=HEIGHT) as page:
            page.wait_for("window.ready === true")
            yield page
    finally:
        server.shutdown()
        worker.join()
        server.server_close()


def test_three_js_plays_the_moving_mesh(run):
    module, folder = node_module("three"), run.parent / "mesh"
    folder.mkdir()
    assert export(run, folder / "moving.glb", "animation", "--mesh-step", str(STEP)) == 0
    scene = load_scene(run)
    mesh = depth_grid(render_surface(scene, 0.0, scene.cameras[0], 0.5), STEP, 5.0)
    carried = carry_points(scene, mesh.vertices, np.zeros(len(mesh.vertices), np.intp), [i / 10 for i in range(10)])
    with opened(folder, module, THREE) as page:
        assert page.evaluate("steps") == pytest.approx([i / 25 for i in range(10)])
        for frame in (0, 4, 9):
            there = 1000 * np.array(page.evaluate(f"positionsAt({frame / 25})"))
            assert there == pytest.approx(points_in_axes(carried[frame], "opengl"), abs=0.01)
        linear = np.array(page.evaluate("colors")).reshape(len(mesh.vertices), -1)[:, :3]
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        assert 255 * encoded == pytest.approx(mesh.colors, abs=0.01)
        assert page.evaluate("lit") == "MeshBasicMaterial"


def test_playcanvas_shows_the_gaussians_of_each_time_step_as_we_do(run):
    module, folder = node_module("playcanvas"), run.parent / "splats"
    folder.mkdir()
    for name in SPLAT_FORMATS:
        assert export(run, folder / name, name) == 0
    scene = load_scene(run)
    camera = replace(scene.cameras[0], width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=WIDTH / 2, cy=HEIGHT / 2)
    with opened(folder, module, PLAYCANVAS) as page:
        wanted = {frame: 255 * scene.render(frame / 10, camera).color.numpy() for frame in (0, 9)}
        for frame, other in ((0, 9), (9, 0)):
            for name in SPLAT_FORMATS:
                (file,) = (folder / name).glob(f"{frame:06d}.*")
                page.evaluate(f"show('/files/{name}/{file.name}')")
                if name == "ply":
                    means = np.stack([page.evaluate(f"values('{axis}')") for axis in "xyz"], 1)
                    assert by_x(means) == pytest.approx(by_x(scene.at(frame / 10).means.numpy()), abs=1e-3)
                picture = settled(page, f"{name}_{frame}")
                # A file has one color for each Gaussian, fitted to the endoscope's image of 64 x 48 px.
                assert np.abs(picture - wanted[frame]).mean() < 10 < 14 < np.abs(picture - wanted[other]).mean()


def by_x(points: np.ndarray) -> np.ndarray:
    """In ascending order of x: PlayCanvas sorts what it loads."""
    return points[np.argsort(points[:, 0])]


def settled(page, name: str) -> np.ndarray:
    """The window, (H, W, 3), once it has stopped to change; kept under `name`."""
    before = None
    for _ in range(40):
        page.evaluate("new Promise(done => setTimeout(done, 200))")
        now = page.screenshot(pictures_folder("programs") / f"{name}.png").astype(float)
        if before is not None and now.std() > 10 and np.abs(now - before).max() < 1:
            return now
        before = now
    raise AssertionError("it shows nothing, or does not stop to change")
