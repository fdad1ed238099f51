"""The HTML player measures between two touched points, and follows them as `model.carry` does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import Page, pictures_folder
from player_page import HEIGHT, RATE, WIDTH, open_player, picture, press_button, random_scene, settle

from endoprior.core.geometry import back_project
from endoprior.export.html import write_html
from endoprior.model.carry import CarriedPoints, carry
from endoprior.model.measures import ranges_of
from endoprior.model.scene import Scene
from endoprior.model.surface import render_surface
from endoprior.model.uncertainty import CELLS, point_errors
from endoprior.model.windowed_scene import Span, WindowedScene

NUM_FRAMES = 6
PIXELS = ((110.5, 120.5), (200.5, 150.5))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Masks hide one of the points from frame 3 on."""
    masks = torch.full((NUM_FRAMES, *CELLS), 255, dtype=torch.uint8)
    masks[3:, :, 15:] = 0
    return replace(random_scene(3000, NUM_FRAMES), tissue=masks, depth_noise=0.008)


@pytest.fixture(scope="module")
def player(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of that scene."""
    return write_html(scene, tmp_path_factory.mktemp("measures") / "scene.html")


def seek(page: Page, frame: int) -> None:
    page.evaluate(f"slider.value = {frame}; slider.dispatchEvent(new Event('input'))")
    settle(page, frame)


def touch(page: Page, pixel: tuple[float, float]) -> None:
    """Click a pixel of the recording."""
    left, top, width, height = page.box("#picture")
    page.click_at(left + pixel[0] * width / WIDTH, top + pixel[1] * height / HEIGHT)


def carried_points(scene: Scene, frames: tuple[int, int]) -> CarriedPoints:
    """The points at `PIXELS` of the surface that the renderer has in each of the two frames."""
    num, points = len(scene.cameras), []
    for pixel, frame in zip(PIXELS, frames, strict=True):
        surface = render_surface(scene, frame / num, scene.cameras[frame])
        depth = surface.depth[int(pixel[1]), int(pixel[0])]
        points.append(back_project(np.array(pixel), np.array(depth, float), surface.camera))
    times = [i / num for i in range(num)]
    return carry(scene, np.stack(points), np.array(frames, np.intp), times)


def distances(scene: Scene, frames: tuple[int, int]) -> np.ndarray:
    """(T,) between these points."""
    carried = carried_points(scene, frames).positions
    return np.linalg.norm(carried[:, 0] - carried[:, 1], axis=-1)


def half_ranges(scene: Scene, frames: tuple[int, int]) -> np.ndarray:
    """(T,) half of the 95 % range of those distances."""
    carried, own = carried_points(scene, frames), np.array(frames, np.intp)
    errors = point_errors(scene, carried, own, range(len(scene.cameras)))
    paths = carried.positions.astype(np.float64)
    return ranges_of(paths, 0, np.zeros((0, 3), np.intp), errors).distance


def shown_range(page: Page) -> float:
    return float(page.evaluate("measured.textContent").split("± ")[1].split(" mm")[0])


def shown_mm(page: Page) -> float:
    page.wait_for("!measured.hidden && / (mm|rel\\.)/.test(measured.textContent)")
    return float(page.evaluate("measured.textContent").split(" ±")[0])


def test_two_touches_measure_a_distance_in_every_frame(scene, page):
    press_button(page, "#measure")
    assert page.evaluate("measured.textContent") == "Touch two points of the tissue."
    seek(page, 2)
    touch(page, PIXELS[0])
    page.wait_for("measured.textContent == 'Touch one more point.'")
    touch(page, PIXELS[1])
    want = distances(scene, (2, 2))
    # Rounded centers: half of 0.05 mm an axis and point, and what that changes of the order in depth.
    assert shown_mm(page) == pytest.approx(want[2], abs=0.15)
    found, ranges = [], []
    for frame in range(NUM_FRAMES):
        seek(page, frame)
        found.append(shown_mm(page))
        ranges.append(shown_range(page))
    assert ranges == pytest.approx(half_ranges(scene, (2, 2)), abs=0.05, rel=0.05)
    assert found == pytest.approx(want, abs=0.15) and np.ptp(want) > 0.3
    said = page.evaluate("measured.textContent")
    assert f"{found[-1] - found[2]:+.2f}".replace("-", "−") + " since frame 3; " in said
    assert f"{min(found):.2f} to {max(found):.2f} over all frames" in said
    press_button(page, "#clear")
    page.wait_for("getComputedStyle(ruler.firstElementChild).display == 'none'")
    assert page.evaluate("measured.textContent") == "Touch two points of the tissue."
    assert not page.problems


@pytest.mark.slow
def test_the_line_is_where_the_points_are(scene, page):
    before = picture(page, pictures_folder("player") / "unmeasured.png")
    page.press("m")
    for pixel in PIXELS:
        touch(page, pixel)
    shown_mm(page)
    settle(page)
    changed = np.abs(picture(page, pictures_folder("player") / "measured.png") - before).sum(-1) > 30
    (x1, y1), (x2, y2) = PIXELS
    assert changed[int((y1 + y2) / 2), int((x1 + x2) / 2)]
    assert not changed[:60].any()
    page.drag([(320, 150), (350, 150), (380, 150)])  # turns, and measures nothing
    settle(page)
    assert page.evaluate("ruler.children[0].getAttribute('x1')") != page.evaluate(
        "ruler.children[0].getAttribute('x2')"
    )
    assert "mm" in page.evaluate("measured.textContent")
    assert not page.problems


@pytest.mark.slow
def test_where_there_is_no_tissue_nothing_is_measured(page):
    page.press("f")
    page.press("m")
    settle(page)
    page.click_at(3, 100)
    assert "no surface" in page.evaluate("measured.textContent")
    assert not page.problems


@pytest.mark.slow
def test_lengths_of_an_assumed_scale_are_relative(scene, browser, tmp_path):
    relative = replace(scene, lengths_are_relative=True)
    open_player(browser, write_html(relative, tmp_path / "scene.html"))
    browser.press("m")
    for pixel in PIXELS:
        touch(browser, pixel)
    browser.wait_for("/^[\\d.]+ ± [\\d.]+ rel\\./.test(measured.textContent)")


@pytest.mark.slow
def test_points_are_followed_over_the_borders_of_windows(browser, tmp_path):
    spans = (Span(0, 7, 900), Span(4, 11, 1100), Span(8, 15, 700))
    scenes = [random_scene(span.num_gaussians, span.stop - span.start, seed=k) for k, span in enumerate(spans)]
    cameras = tuple(random_scene(2, 15).cameras)
    scene = WindowedScene(scenes[0].config, cameras, RATE, spans, scenes.__getitem__)
    open_player(browser, write_html(scene, tmp_path / "scene.html"))
    seek(browser, 7)
    browser.press("m")
    for pixel in PIXELS:
        touch(browser, pixel)
    browser.wait_for("measured.textContent.includes('over all frames')")
    want = distances(scene, (7, 7))
    for frame in (0, 7, 14):
        seek(browser, frame)
        assert shown_mm(browser) == pytest.approx(want[frame], abs=0.3), frame
    assert not browser.problems
