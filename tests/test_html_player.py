"""The single-file player: it stores the scene within stated bounds, and a browser draws it as the renderer does."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from browser import pictures_folder
from player_page import (
    RATE,
    WIDTH,
    open_player,
    picture,
    press_button,
    random_scene,
    rendered,
    settle,
    unpack,
    with_script,
)

from endoprior.core.checks import InputError
from endoprior.export.html import write_html
from endoprior.model.photometric import GRID, add_smoke_torch
from endoprior.model.scene import Scene
from endoprior.render import sh

NUM_FRAMES = 6
FAINT, BROKEN, LOST = 3, 5, 7  # rows: never opaque enough, not finite, 100 m away


@pytest.fixture(scope="module")
def scene() -> Scene:
    """3000 Gaussians in six frames, three of them invisible."""
    scene = random_scene(3000, NUM_FRAMES)
    with torch.no_grad():
        scene.gaussians["opacity_logits"][FAINT] = -9
        scene.gaussians["means"][BROKEN] = float("nan")
        scene.gaussians["means"][LOST] = 1e5
    return scene


@pytest.fixture(scope="module")
def player(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of that scene."""
    return write_html(scene, tmp_path_factory.mktemp("player") / "scene.html", title="Bowel <1> & more @@DATA@@")


def test_what_is_stored_is_the_scene_within_the_stated_bounds(scene, player):
    about, (stored,) = unpack(player)
    kept = np.setdiff1d(np.arange(len(scene)), [FAINT, BROKEN, LOST])
    assert about["gaussians"] == len(kept) and stored.shape == (20, NUM_FRAMES, len(kept))
    assert np.allclose(about["seconds"], np.arange(NUM_FRAMES) / RATE)
    for t, camera in enumerate(scene.cameras):
        splats = scene.at(t / NUM_FRAMES)
        means, scales, opacities = (getattr(splats, n)[kept].numpy() for n in ("means", "scales", "opacities"))
        # Rounding costs half a step; float32 numbers of 60 mm are exact to 4e-6.
        error = np.abs(stored[:3, t].T - means).max()
        working_distance = about["depth_range"][0]
        assert error <= 0.05 and error * camera.fy / working_distance <= 0.125 + 1e-4
        quats = splats.quats[kept].numpy().astype(float)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        found = stored[3:7, t].T / np.linalg.norm(stored[3:7, t].T, axis=1, keepdims=True)
        cosine = np.abs((quats * found).sum(1)).clip(max=1)
        assert np.rad2deg(2 * np.arccos(cosine)).max() < 0.5
        assert np.abs(stored[7:10, t].T - np.log(scales)).max() <= 0.01 + 1e-5
        visible = opacities >= 1 / 255
        assert np.abs(stored[10, t] - opacities)[visible].max() <= 0.0005 and not stored[10, t][~visible].any()
        towards = means - camera.center
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        colors = sh.colors(splats.sh[kept], torch.from_numpy(towards).float()).numpy()
        assert np.abs(stored[11:14, t].T - colors)[visible].max() <= 0.5 / 255 + 1e-6
        slopes = splats.color_slopes[kept].flatten(1).numpy()
        assert np.abs(stored[14:, t].T - slopes)[visible].max() <= 0.25 / 255 + 1e-5
        assert np.allclose(about["cameras"][t], [300, 310, 150, 137, *camera.world_to_camera.ravel()])


@pytest.mark.slow
def test_sixty_frames_of_twenty_thousand_fit_in_a_mail(tmp_path):
    page = write_html(random_scene(20_000, 60), tmp_path / "new" / "scene.html")  # an error above 20 MB
    size = page.stat().st_size
    print(f"60 frames x 20,000 Gaussians: {size / 1e6:.2f} MB")
    assert 1e6 < size < 20e6


def test_the_page_refers_to_nothing_outside(player):
    text = re.sub(r"@@DATA@@|<script id=\"data\".*?</script>", "", player.read_text(encoding="utf-8"), flags=re.S)
    assert not re.search(r"https?://|@import|url\(|src=|@@", text)
    assert "default-src 'none'" in text and "not a medical device" in text
    assert text.count("Bowel &lt;1&gt; &amp; more") == 2


def test_what_cannot_be_written_is_rejected_in_one_line(scene, tmp_path):
    with pytest.raises(
        InputError, match=r"scene\.html: expected at most 0\.0 MB, got about 0\.\d MB for 6 time steps of 2997"
    ):
        write_html(scene, tmp_path / "scene.html", max_bytes=1000)
    with pytest.raises(InputError, match=r"expected a file to write, got a folder"):
        write_html(scene, tmp_path)
    for times in ([], [0.5, 0.5], [0.5, 0.2]):
        with pytest.raises(InputError, match="increasing times"):
            write_html(scene, tmp_path / "scene.html", times=times)
    with pytest.raises(ValueError, match=r"time must be in \[0, 1\]"):
        write_html(scene, tmp_path / "scene.html", times=[1.5])
    hidden = random_scene(20, 2)
    with torch.no_grad():
        hidden.gaussians["opacity_logits"].fill_(-20)
    with pytest.raises(InputError, match="got none that is visible"):
        write_html(hidden, tmp_path / "scene.html")
    assert not list(tmp_path.iterdir())


# ---- in a browser


@pytest.fixture
def kept():
    """Folder whose pictures stay, to be looked at."""
    return pictures_folder("player")


def test_draws_what_the_renderer_draws(scene, page, kept):
    for frame in (0, 3):
        page.evaluate(f"slider.value = {frame}; slider.dispatchEvent(new Event('input'))")
        settle(page, frame)
        got, want = picture(page, kept / f"frame{frame}.png"), rendered(scene, frame / NUM_FRAMES)
        both = np.concatenate([got, want], 1).round().astype(np.uint8)
        cv2.imwrite(str(kept / f"frame{frame}_player_renderer.png"), both[..., ::-1])
        assert got.shape == want.shape
        error = np.abs(got - want)
        print(f"frame {frame}: mean difference {error.mean():.3f} levels, largest {error.max():.0f}")
        # 0.25 is the screenshot's own rounding, the rest rounded numbers. Measured when wrong: no blur 0.78, half a
        # pixel aside 2.4, rotations transposed 5, unsorted 12, without slopes 4.5.
        assert error.mean() < 0.65 and want.std() > 20
    assert not page.problems
    assert all(address.startswith(("file://", "blob:")) for address in page.requests)


def test_smoke_is_shown_when_asked_for_and_where_there_is_some(scene, page, tmp_path, kept):
    assert page.evaluate("smoke.hidden")
    rows, columns = torch.meshgrid(torch.linspace(0, 1, GRID[0]), torch.linspace(0, 1, GRID[1]), indexing="ij")
    veil = torch.stack([1 - 0.7 * columns, 0.5 * columns * rows], -1)  # thick at the right, bright at the bottom
    grids = torch.stack([torch.lerp(torch.tensor([1.0, 0.0]), veil, t / NUM_FRAMES) for t in range(NUM_FRAMES)])
    smoky = replace(scene, smoke=grids)
    open_player(page, write_html(smoky, tmp_path / "smoke.html"))
    page.evaluate("slider.value = 4; slider.dispatchEvent(new Event('input'))")
    settle(page, 4)
    tissue = picture(page, kept / "tissue.png")
    assert np.abs(tissue - rendered(scene, 4 / NUM_FRAMES)).mean() < 0.65
    press_button(page, "#smoke")
    settle(page)
    with torch.no_grad():
        want = 255 * add_smoke_torch(torch.from_numpy(rendered(scene, 4 / NUM_FRAMES) / 255), grids[4]).numpy()
    got = picture(page, kept / "smoke.png")
    print(f"smoke: {np.abs(want - tissue).mean():.1f} levels, off by {np.abs(got - want).mean():.3f}")
    assert np.abs(want - tissue).mean() > 20 and np.abs(got - want).mean() < 0.9
    page.press("f")
    assert page.evaluate("smoke.disabled")
    page.press("e")
    page.press("s")
    settle(page)
    assert np.array_equal(picture(page, kept / "off.png"), tissue) and not page.problems


@pytest.mark.slow
def test_the_slider_and_the_keys_choose_the_frame(scene, page, kept):
    before = picture(page, kept / "first.png")
    left, top, width, height = page.box("#slider")
    page.click_at(left + width - 4, top + height / 2)
    settle(page, NUM_FRAMES - 1)
    after = picture(page, kept / "last.png")
    assert np.abs(after - before).mean() > 3
    assert np.abs(after - rendered(scene, (NUM_FRAMES - 1) / NUM_FRAMES)).mean() < 0.65
    assert page.evaluate("counter.textContent + ', ' + seconds.textContent") == "Frame 6 of 6, 0.50 s"
    assert page.evaluate("slider.getAttribute('aria-valuetext')") == "Frame 6 of 6, 0.50 s"
    page.press("ArrowLeft")
    settle(page, NUM_FRAMES - 2)
    page.press("Home")
    settle(page, 0)
    assert np.array_equal(picture(page, kept / "home.png"), before)
    assert not page.problems


@pytest.mark.slow
def test_play_goes_on_and_pauses(page):
    page.click("#play")
    assert page.evaluate("play.getAttribute('aria-label')") == "Pause"
    page.wait_for("picture.dataset.frame >= 2")
    page.wait_for("picture.dataset.frame < 2")  # from the start again
    page.press(" ")
    assert page.evaluate("play.getAttribute('aria-label')") == "Play"
    settle(page)
    stopped = page.evaluate("[picture.dataset.frame, counter.textContent]")
    page.evaluate("new Promise(f => setTimeout(f, 300))")
    assert page.evaluate("[picture.dataset.frame, counter.textContent]") == stopped
    press_button(page, "#loop")
    page.press(" ")
    page.wait_for("!document.body.classList.contains('playing') && picture.dataset.frame == 5")  # stays at the end
    assert not page.problems


@pytest.mark.slow
def test_the_free_view_turns_zooms_and_comes_back(page, kept):
    recorded = picture(page, kept / "recorded.png")
    page.press("f")
    settle(page)
    wide = picture(page, kept / "free.png")
    margin = (wide.shape[1] - WIDTH) // 2
    assert margin > 0 and np.abs(wide[:, margin : margin + WIDTH] - recorded).mean() < 1  # nothing jumps
    page.drag([(320, 180), (350, 190), (380, 200)])
    settle(page)
    turned = picture(page, kept / "turned.png")
    page.wheel(320, 180, -300)
    settle(page)
    near = picture(page, kept / "near.png")
    page.drag([(320, 180), (340, 190)], button="right")
    settle(page)
    moved = picture(page, kept / "moved.png")
    views = [wide, turned, near, moved]
    assert all(np.abs(a - b).mean() > 3 for i, a in enumerate(views) for b in views[:i])
    press_button(page, "#reset")
    settle(page)
    assert np.array_equal(picture(page, kept / "reset.png"), wide)
    press_button(page, "#endoscope")
    settle(page)
    assert np.array_equal(picture(page, kept / "again.png"), recorded)
    assert not page.problems


@pytest.mark.slow
def test_depth_is_shown_near_bright_far_dark(scene, page, kept):
    press_button(page, "#depth")
    settle(page)
    shown = picture(page, kept / "depth.png").sum(-1)
    out = scene.render(0.0)
    opaque = out.alpha.numpy() > 0.9
    opaque[:, -60:] = False  # the bar
    depth = (out.depth / out.alpha).numpy()[opaque]
    order = np.corrcoef(depth.argsort().argsort(), shown[opaque].argsort().argsort())[0, 1]
    assert opaque.mean() > 0.3 and order < -0.97
    assert page.evaluate("[!scale.hidden, Number(document.getElementById('scale-near').textContent)]")[0]
    assert not page.problems


def test_what_is_behind_everything_has_the_color_of_the_method(browser, kept, monkeypatch):
    white = random_scene(300, 2)
    monkeypatch.setattr(Scene, "background", (1.0, 1.0, 1.0))
    open_player(browser, write_html(white, kept / "white.html", times=[0.5]))
    want = rendered(white, 0.5)
    assert want.max() == 255 and np.abs(picture(browser, kept / "white.png") - want).mean() < 0.65
    press_button(browser, "#depth")
    settle(browser)
    assert picture(browser, kept / "white_depth.png")[0, 0].max() == 0


@pytest.mark.slow
def test_one_frame_is_a_still(scene, browser, kept):
    open_player(browser, write_html(scene, kept / "still.html", times=[0.5]))
    assert np.abs(picture(browser, kept / "still.png") - rendered(scene, 0.5)).mean() < 0.65
    assert browser.evaluate("[slider.disabled, play.disabled, counter.textContent, seconds.textContent]") == [
        True,
        True,
        "Frame 1 of 1",
        "0.30 s",
    ]
    browser.press(" ")
    browser.press("ArrowRight")
    settle(browser, 0)
    assert not browser.problems


DYING = "terminate() {} postMessage() { setTimeout(() => this.onerror(new Event('error'))); }"


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "window.Worker = class { constructor() { throw new Error('none here'); } };",
        f"window.Worker = class {{ {DYING} }};",
    ],
    ids=["rejected", "dies"],
)
def test_without_workers_the_page_sorts_by_itself(scene, browser, player, kept, code):
    with with_script(browser, code):
        open_player(browser, player)
        browser.press("End")
        settle(browser, NUM_FRAMES - 1)
        want = rendered(scene, (NUM_FRAMES - 1) / NUM_FRAMES)
        assert np.abs(picture(browser, kept / "alone.png") - want).mean() < 0.65
        assert not browser.problems


@pytest.mark.slow
def test_a_lost_graphics_card_comes_back(page, kept):
    before = picture(page, kept / "before.png")
    page.evaluate(
        "window.lose = picture.getContext('webgl2').getExtension('WEBGL_lose_context'); lose.loseContext();"
        "new Promise(f => setTimeout(f, 100))"
    )
    page.press("End")
    page.evaluate("lose.restoreContext(); new Promise(f => picture.addEventListener('webglcontextrestored', f))")
    page.press("Home")
    settle(page, 0)
    assert np.array_equal(picture(page, kept / "after.png"), before)
    assert all("context" in problem.lower() for problem in page.problems)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("delete window.DecompressionStream;", "cannot unpack the scene"),
        ("HTMLCanvasElement.prototype.getContext = () => null;", "has no WebGL 2"),
    ],
)
def test_a_browser_that_cannot_says_so_on_the_page(browser, player, kept, code, says):
    with with_script(browser, code):
        browser.go(player.as_uri())
        browser.wait_for("document.body.dataset.state == 'failed'")
        browser.screenshot(kept / "failed.png")
        assert says in browser.evaluate("message.textContent")
