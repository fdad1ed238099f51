"""The player sways at its start, so that one sees a model and not a film; the first touch ends it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from browser import Page, open_page
from export_scenes import moving_scene

from endoprior.export.html import write_html


@pytest.fixture(scope="module")
def player(tmp_path_factory: pytest.TempPathFactory) -> str:
    return Path(write_html(moving_scene(), tmp_path_factory.mktemp("sway") / "scene.html", title="")).as_uri()


def settled(page: Page) -> np.ndarray:
    page.wait_for("document.querySelector('#picture').dataset.settled == 'true'", timeout=60)
    return page.screenshot(selector="#picture").astype(int)


def start_swaying(page: Page, player: str) -> None:
    """Load the page as one who did not ask for reduced motion, as the tests' browser does."""
    page.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "no-preference"}])
    page.go(player)
    page.wait_for("document.body.dataset.sway == 'on' && Number(picture.dataset.drawn) > 3", timeout=60)


@pytest.mark.slow
def test_it_sways_until_the_first_touch_and_then_shows_the_recorded_view(player: str) -> None:
    with open_page(player, width=600, height=500) as page:
        still = settled(page)
        assert page.evaluate("document.body.dataset.sway") is None
        start_swaying(page, player)
        page.wait_for("picture.dataset.settled != 'true'")
        assert np.abs(page.screenshot(selector="#picture").astype(int) - still).max() > 50
        page.click_at(5, 495)
        page.wait_for("document.body.dataset.sway == 'ended'")
        np.testing.assert_array_equal(settled(page), still)
        assert not page.problems


@pytest.mark.slow
def test_it_ends_by_itself(player: str) -> None:
    with open_page(player, width=600, height=500) as page:
        still = settled(page)
        start_swaying(page, player)
        page.wait_for("document.body.dataset.sway == 'ended'", timeout=120)
        np.testing.assert_array_equal(settled(page), still)
