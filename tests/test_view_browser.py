"""The viewer in headless Chromium on a trained phantom: what a person would do, and what the page shows then.

The pictures are kept in `build/view/` to be looked at.
"""

import shutil
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from browser import open_page, pictures_folder, require_chromium
from view_client import at_work, wait_until

from endoprior.cli.view import open_viewable
from endoprior.core.geometry import back_project
from endoprior.data import load_sequence
from endoprior.model.presets import preset
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.runs.train import train
from endoprior.view.panel import BROWSER, CLEAR, IMAGE, LAYER_NAMES, MESH, ORBIT, PLY, SLICER, TABLE, VIDEO
from endoprior.view.server import Viewer
from endoprior.view.viewable_scene import ViewableScene
from endoprior.view.viewport import bounded_aspect, endoscope_viewport

pytestmark = pytest.mark.slow
PICTURES = pictures_folder("view")
WIDTH, HEIGHT = 1100, 760
FRAME = 3
KNOWN = ("THREE.Clock", "GPU stall due to ReadPixels", "GL Driver Message", "Automatic fallback to software WebGL")
"""Messages of viser's own page in a browser without a GPU: notes on speed and on an old name."""
SPLAT_NOTE = "computeBoundingSphere"
"""viser 1.1.1 gives its splats corners of two coordinates; three.js complains when it is asked for their extent."""

DRAG_NOTE = "Unable to preventDefault inside passive event listener"
"""Chromium's note when viser drags an object of the scene."""


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """A small phantom."""
    require_chromium()
    out = tmp_path_factory.mktemp("view") / "phantom"
    write_phantom(out, PhantomConfig(frames=10, width=192, height=160))
    return load_sequence(out)


@pytest.fixture(scope="module")
def scene(phantom):
    """That phantom, trained for a few seconds."""
    cfg = preset("default")
    schedule = replace(cfg.schedule, coarse_iterations=0, fine_iterations=250, half_resolution_iterations=0)
    return train(phantom, replace(cfg, init=replace(cfg.init, budget=6000), schedule=schedule))


@pytest.fixture
def viewer(scene, phantom, tmp_path):
    """A viewer of the trained phantom, at work."""
    with at_work(Viewer(ViewableScene(scene, "phantom", phantom), out=tmp_path / "view")) as viewer:
        yield viewer


@contextmanager
def opened(viewer, width=WIDTH, height=HEIGHT):
    """The page, once it shows an image."""
    with open_page(viewer.url, width=width, height=height) as page:
        page.wait_for("document.querySelector('[role=slider]') !== null")
        wait_until(lambda: canvas(page).std() > 20, 30)
        yield page


@pytest.fixture
def page(viewer):
    """The page. Afterwards its console must hold no error."""
    with opened(viewer) as page:
        yield page
    assert not unexpected(page.problems)


def unexpected(problems: list[str], *more: str) -> list[str]:
    """What is not known to be viser's own."""
    return [problem for problem in problems if not any(known in problem for known in (*KNOWN, *more))]


def canvas(page, name: str = "") -> np.ndarray:
    """(H, W, 3) the 3D canvas as it is shown, without the note about software WebGL; kept under `name`."""
    left, top, width, height = (round(v) for v in page.box("canvas"))
    shown = page.screenshot(PICTURES / f"{name}.png" if name else None)
    return shown[top : top + height, left : left + width].astype(float)[height // 3 :]


def settled(page, name: str = "") -> np.ndarray:
    """The canvas, once it has stopped to change."""
    before, end = canvas(page), time.monotonic() + 15
    while time.monotonic() < end:
        time.sleep(0.5)
        now = canvas(page)
        if np.abs(now - before).mean() < 0.05:
            break
        before = now
    return canvas(page, name)


def press_button(page, text: str) -> None:
    """Press the button with this label."""
    found = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() == {text!r})"
    page.wait_for(f"{found} !== undefined")
    page.evaluate(f"{found}.click()")


def go_to_frame(viewer, page) -> None:
    """To FRAME, by the keys of the slider."""
    page.evaluate("document.querySelector('[role=slider]').focus()")
    for _ in range(FRAME):
        page.press("ArrowRight")
    wait_until(lambda: viewer.settings.frame == FRAME)


def choose(viewer, handle, value) -> None:
    """Set a control as a browser would; the page's own drop-downs are viser's matter."""
    client = next(iter(viewer.server.get_clients().values()))
    handle.value = value
    viewer.jobs.put(viewer.read_panel if handle is not viewer.panel.measure else viewer.read_clicking)
    client.flush()


def test_the_slider_changes_the_image_and_play_advances(viewer, page, scene):
    first = settled(page, "first_frame")
    go_to_frame(viewer, page)
    assert np.abs(settled(page, "slider_moved") - first).mean() > 2
    press_button(page, "Play")
    seen = set()
    wait_until(lambda: seen.add(viewer.settings.frame) or len(seen) > 5)
    press_button(page, "Pause")
    wait_until(lambda: viewer.panel.play.label == "Play")
    settled(page, "played")


def test_two_clicks_measure_the_true_distance(viewer, page, phantom):
    go_to_frame(viewer, page)
    choose(viewer, viewer.panel.measure, True)
    settled(page)
    left, top, width, height = page.box("canvas")
    frame, truth = phantom.frame(FRAME), phantom.truth.depth(FRAME)
    viewport = endoscope_viewport(frame.camera, bounded_aspect(width, height))
    for pair in (((60, 80), (120, 130)), ((40, 110), (150, 120)), ((96, 60), (96, 140))):
        points = []
        for column, row in pair:
            assert truth[row, column] > 0
            points.append(back_project(np.array([column + 0.5, row + 0.5]), truth[row, column], frame.camera))
            before = viewer.measuring.measured
            x, y = viewport.screen((column + 0.5, row + 0.5))
            page.click_at(left + x * width, top + y * height)
            wait_until(lambda before=before: viewer.measuring.measured is not before)
        true = float(np.linalg.norm(points[1] - points[0]))
        assert viewer.measuring.measured.curve("Distance")[FRAME] == pytest.approx(true, abs=1.0)
        distance = viewer.measuring.measured.curve("Distance")[FRAME]
        page.wait_for(f"document.body.innerText.includes('{distance:.2f} ± ')")
    settled(page, "measured")


def test_layers_tracks_tool_and_orbit(viewer, page):
    go_to_frame(viewer, page)
    images = {}
    for layer, name in LAYER_NAMES.items():
        choose(viewer, viewer.panel.layer, name)
        wait_until(lambda layer=layer: viewer.settings.layer == layer)
        images[layer] = settled(page, f"layer_{layer}")
    for a in images:
        assert all(a == b or np.abs(images[a] - images[b]).mean() > 1 for b in images), a
    choose(viewer, viewer.panel.layer, LAYER_NAMES["color"])
    choose(viewer, viewer.panel.tool, True)
    choose(viewer, viewer.panel.tracks, True)
    marked = settled(page, "tool_and_tracks")
    assert np.abs(marked - images["color"]).mean() > 1
    choose(viewer, viewer.panel.camera, ORBIT)
    before = settled(page)
    left, top, width, height = page.box("canvas")
    middle = left + width / 2, top + height / 2
    page.drag([middle] + [(middle[0] + 10 * k, middle[1] + 4 * k) for k in range(12)])
    assert np.abs(settled(page, "orbit") - before).mean() > 2


def test_the_browser_renders_like_the_server(viewer):
    with opened(viewer) as page:
        ours = settled(page)
        choose(viewer, viewer.panel.rendered_by, BROWSER)
        wait_until(lambda: viewer.settings.in_browser)
        time.sleep(2)
        theirs = settled(page, "browser_splats")
    margin = round(0.2 * ours.shape[1])  # the server's image ends at the border of the endoscope image
    assert np.abs(ours - theirs)[:, margin:-margin].mean() < 12
    assert not unexpected(page.problems, SPLAT_NOTE)


def test_a_raw_sequence(phantom):
    viewable, _ = open_viewable(phantom.path, None)
    with at_work(Viewer(viewable)) as viewer, opened(viewer) as page:
        seen = settled(page, "sequence_frame")
        choose(viewer, viewer.panel.camera, ORBIT)
        time.sleep(2)
        points = settled(page, "sequence_points")
        assert np.abs(points - seen).mean() > 1 and points.std() > 20
        assert not unexpected(page.problems)


def test_masks_are_painted_by_dragging_carried_and_saved(phantom, tmp_path):
    folder = shutil.copytree(phantom.path, tmp_path / "data")
    viewable, _ = open_viewable(folder, None)
    with at_work(Viewer(viewable)) as viewer, opened(viewer) as page:
        viewer.panel.correct.value = True
        viewer.jobs.put(viewer.read_panel)
        wait_until(lambda: viewer.settings.correcting)
        before, shown = viewable.mask_edits.tool(0), settled(page, "mask_before")
        left, top, width, height = page.box("canvas")
        viewport = endoscope_viewport(viewable.cameras[0], bounded_aspect(width, height))

        def on_page(column, row):
            x, y = viewport.screen((column, row))
            return left + x * width, top + y * height

        page.drag([on_page(60 + 4 * k, 110) for k in range(11)])
        wait_until(lambda: (viewable.mask_edits.tool(0) & ~before).any())
        began = time.monotonic()
        wait_until(lambda: np.abs(canvas(page) - shown).mean() > 0.5)
        assert time.monotonic() - began < 3  # a screenshot alone takes a while in software
        settled(page, "mask_painted")
        added = np.argwhere(viewable.mask_edits.tool(0) & ~before)
        radius = viewer.panel.radius.value
        assert added[:, 0].mean() == pytest.approx(110, abs=1)
        assert (added[:, 1].min(), added[:, 1].max()) == pytest.approx((60 - radius, 100 + radius), abs=2)
        page.click_at(*on_page(120, 130))
        wait_until(lambda: viewable.mask_edits.tool(0)[130, 120])
        press_button(page, "Carry to other frames")
        wait_until(lambda: "Forward until" in viewer.panel.corrected.content, 30)
        assert viewable.mask_edits.tool(1)[110, 80]
        press_button(page, "Save masks")
        wait_until(lambda: "Saved:" in viewer.panel.corrected.content)
        page.wait_for("document.body.innerText.includes('Saved: frames 0')")
        settled(page, "mask_saved")
        assert np.array_equal(~load_sequence(folder).frame(1).tissue_mask, viewable.mask_edits.tool(1))
        assert not unexpected(page.problems, DRAG_NOTE)


def buttons(page) -> dict[str, tuple[float, float]]:
    """Top and bottom of each visible button, by its label."""
    found = page.evaluate(
        "[...document.querySelectorAll('button')].filter(b => b.offsetHeight && b.innerText.trim())"
        ".map(b => [b.innerText.trim(), b.getBoundingClientRect()]).map(([name, b]) => [name, [b.top, b.bottom]])"
    )
    return dict(found)


def test_measure_and_save_need_no_scrolling(viewer):
    with opened(viewer, 1280, 720) as page:
        ends = buttons(page)
        names = (CLEAR, TABLE, IMAGE, VIDEO, PLY, SLICER, MESH)
        for name in names:
            assert 0 < ends[name][0] < ends[name][1] < 720
        page.screenshot(PICTURES / "panel_1280x720.png")
        choose(viewer, viewer.panel.measure, True)
        settled(page)
        for x in (400, 600):
            before = viewer.measuring.measured
            page.click_at(x, 400)
            wait_until(lambda before=before: viewer.measuring.measured is not before)
        wait_until(lambda: viewer.panel.chart.visible)
        page.wait_for("document.querySelector('.uplot') !== null")
        settled(page)
        ends = buttons(page)
        page.screenshot(PICTURES / "panel_measuring_1280x720.png")
        assert all(0 < ends[name][0] < ends[name][1] < 720 for name in names)


def test_the_panel_of_a_narrow_window_is_below_the_image(viewer):
    for size in ((560, 800), (390, 844)):
        with opened(viewer, *size) as page:
            page.wait_for(f"document.querySelector('canvas').getBoundingClientRect().height < {0.6 * size[1]}")
            (left, top, width, height), below = page.box("canvas"), page.box("[role=slider]")[1]
            assert (left, top, width) == (0, 0, size[0]) and height >= 0.44 * size[1] and below >= height
            # The image keeps its form: the phantom's is 192 x 160 px.
            time.sleep(2)
            shown = page.screenshot(PICTURES / f"panel_{size[0]}x{size[1]}.png")[: int(height)].astype(float)
            lit = shown.sum(-1) > 40
            lit[:, : size[0] // 2] = False  # viser's note about software WebGL
            rows = np.flatnonzero(lit.any(1))
            scale = min(size[0] / 192, height / 160)
            assert rows[-1] - rows[0] == pytest.approx(160 * scale, abs=0.05 * height)
