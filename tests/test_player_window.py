"""The player in small windows, as on a phone: much of the image, targets for fingers, nothing cut off."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from browser import Page, pictures_folder
from player_page import random_scene, settle

from endoprior.export.html import write_html

SIDEWAYS, UPRIGHT, DESK, NARROW = (844, 390), (390, 844), (1280, 720), (560, 800)
SMALL, SMALL_SIDEWAYS = (320, 568), (568, 320)
TARGETS = "[...document.querySelectorAll('button, select, input')].filter(e => e.checkVisibility() && !e.disabled)"
REMARK = "Verdict: doubtful. Look at it, but do not measure: the depth is a guess."


@pytest.fixture(scope="module")
def player(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a scene with a remark."""
    out = tmp_path_factory.mktemp("window") / "scene.html"
    return write_html(random_scene(600, 6), out, title="Case 7", remark=REMARK)


@contextmanager
def held(browser: Page, player: Path, size: tuple[int, int], *, fingers: bool = True) -> Iterator[Page]:
    """The page in a window of that size, of a screen for fingers or not."""
    browser.problems.clear()
    touch = {"enabled": fingers, "maxTouchPoints": 2 if fingers else 1}
    browser.send("Emulation.setTouchEmulationEnabled", **touch)
    browser.send(
        "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=fingers
    )
    browser.go(player.as_uri())
    browser.wait_for("document.body.dataset.state == 'ready'")
    settle(browser)
    try:
        yield browser
    finally:
        browser.screenshot(pictures_folder("player") / f"window_{size[0]}x{size[1]}.png")
        browser.send("Emulation.setTouchEmulationEnabled", enabled=False)
    assert not browser.problems


def inside(page: Page, selector: str, outer: str) -> bool:
    (left, top, width, height), (x, y, w, h) = page.box(selector), page.box(outer)
    return x <= left and y <= top and left + width <= x + w and top + height <= y + h


def test_a_phone_turned_sideways_shows_mostly_the_image(browser, player):
    with held(browser, player, SIDEWAYS) as page:
        assert page.box("#picture")[3] >= 0.85 * SIDEWAYS[1]  # was 175 px
        page.press("d")
        assert inside(page, "#scale", "#stage") and inside(page, "#scale-far", "#scale")
        assert page.evaluate("[notice, remark].every(e => e.checkVisibility())")
        page.click("#fold")
        assert page.evaluate("measure.checkVisibility() && fold.getAttribute('aria-expanded') == 'true'")
        page.click("#fold")
        assert not page.evaluate("measure.checkVisibility()")


@pytest.mark.parametrize(
    "size", [SMALL, (360, 640), (375, 667), (360, 800), UPRIGHT], ids=lambda size: "{}x{}".format(*size)
)
def test_an_upright_phone_shows_the_image_as_wide_as_it_is(browser, player, size):
    with held(browser, player, size) as page:
        assert page.box("#picture")[2] >= 0.95 * size[0]  # at 320x568 it was 17 px
        assert page.evaluate("[notice, remark].every(e => e.checkVisibility())")


def test_a_small_phone_turned_sideways_has_one_row_of_controls(browser, player):
    with held(browser, player, SMALL_SIDEWAYS) as page:
        assert page.box("#picture")[3] >= 0.8 * SMALL_SIDEWAYS[1] and page.box("#slider")[2] >= 120


@pytest.mark.parametrize(
    "size", [SIDEWAYS, UPRIGHT, DESK, NARROW, SMALL, SMALL_SIDEWAYS], ids=lambda size: "{}x{}".format(*size)
)
def test_nothing_is_cut_and_targets_fit_fingers(browser, player, size):
    with held(browser, player, size) as page:
        page.press("d")
        if page.evaluate("document.body.classList.contains('folded')"):
            page.press("c")
        sizes = page.evaluate(f"{TARGETS}.map(e => [e.id, e.offsetWidth, e.offsetHeight])")
        assert len(sizes) > 10 and not [name for name, width, height in sizes if min(width, height) < 44]
        ends = page.evaluate(
            f"{TARGETS}.map(e => e.getBoundingClientRect()).map(b => [b.left, b.top, b.right, b.bottom])"
        )
        assert all(x >= 0 and y >= 0 and right <= size[0] and below <= size[1] for x, y, right, below in ends)
        assert inside(page, "#scale", "#stage")


def test_the_last_frame_is_counted_as_the_last(browser, player):
    with held(browser, player, DESK, fingers=False) as page:
        assert page.evaluate("counter.textContent") == "Frame 1 of 6"
        page.press("End")
        assert page.evaluate("counter.textContent") == "Frame 6 of 6"
        assert page.evaluate("slider.getAttribute('aria-valuetext')").startswith("Frame 6 of 6")


def test_fingers_are_told_what_they_can_do_until_they_did_it(browser, player):
    with held(browser, player, DESK, fingers=False) as page:
        assert not page.evaluate("gestures.checkVisibility()")
    with held(browser, player, UPRIGHT) as page:
        assert page.evaluate("gestures.checkVisibility()")
        finger = [{"x": 150 + 10 * k, "y": 250} for k in range(4)]
        page.send("Input.dispatchTouchEvent", type="touchStart", touchPoints=finger[:1])
        for point in finger[1:]:
            page.send("Input.dispatchTouchEvent", type="touchMove", touchPoints=[point])
        page.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        page.wait_for("!gestures.checkVisibility()")
        assert page.evaluate("free.getAttribute('aria-pressed')") == "true"


def test_full_screen_shows_the_image_alone_after_a_while(browser, player):
    with held(browser, player, SIDEWAYS) as page:
        page.click("#full")
        page.wait_for("picture.getBoundingClientRect().height == innerHeight")
        page.wait_for("getComputedStyle(controls).opacity == 0", timeout=20)
        page.click_at(400, 100)
        page.wait_for("getComputedStyle(controls).opacity == 1")
        page.click("#full")
        page.wait_for("!document.fullscreenElement && picture.getBoundingClientRect().height < innerHeight - 44")
