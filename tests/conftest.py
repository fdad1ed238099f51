"""Fixtures shared by all tests: a tiny EndoNeRF folder written on the spot, and the real clip where it is present."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

if TYPE_CHECKING:
    from browser import Page

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is imported

TINY_FRAMES, TINY_WIDTH, TINY_HEIGHT = 17, 48, 40
TINY_FOCAL = 50.0
TINY_DEPTH_SCALE = 0.01
LINUX_ONLY = (
    "test_bad_drives.py", "test_bad_inputs.py", "test_devices.py", "test_faults.py", "test_hostile_viewer.py",
    "test_leftovers.py", "test_memory.py",
)  # fmt: skip
"""Files that need limits of processes, /proc, signals or shell scripts."""
collect_ignore = [] if sys.platform == "linux" else [*LINUX_ONLY]
REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
FIRST = ("test_bad_inputs", "test_check", "test_phantom", "test_prepare", "test_view_server")
"""Files to begin with: one of two workers compiles the kernels of training, the other those of the phantom.

The last one mostly waits: at the end of the run the other worker would have nothing to do meanwhile.
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files of `FIRST` first; the others keep their order."""
    items.sort(key=lambda item: FIRST.index(item.path.stem) if item.path.stem in FIRST else len(FIRST))


@pytest.fixture
def tiny_sequence(tmp_path: Path) -> Path:
    """17 frames of 48x40 px in the EndoNeRF layout: see `write_tiny_sequence`."""
    return write_tiny_sequence(tmp_path / "tiny")


@pytest.fixture
def make_tiny_sequence(tmp_path: Path) -> Callable[..., Path]:
    """`write_tiny_sequence` into a folder of this test; takes its keyword arguments."""

    def make(name: str = "tiny", **options: int) -> Path:
        return write_tiny_sequence(tmp_path / name, **options)

    return make


@pytest.fixture(scope="session")
def real_clip() -> Path:
    """The real sequence `bowel_lift` (90 frames, 640x512); skips, with the path it looked at, where it is absent."""
    clip = REAL_DATA / "bowel_lift"
    if not clip.is_dir():
        pytest.skip(f"real clip not present at {clip}")
    return clip


def write_tiny_sequence(
    out: Path, num_frames: int = TINY_FRAMES, width: int = TINY_WIDTH, height: int = TINY_HEIGHT
) -> Path:
    """Write a slanted textured plane that slides and breathes under a gray bar that comes in from the right.

    The texture is fixed to the plane, depth is 50-70 mm (16 bit, 0.01 mm), the tool is 15 mm nearer, and a corner of
    5x4 px has no depth. The camera stands still at the origin; 255 marks the tool.
    """
    for name in ("images", "masks", "depth"):
        (out / name).mkdir(parents=True)
    focal = TINY_FOCAL * width / TINY_WIDTH
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    for i in range(num_frames):
        phase = 2 * np.pi * i / num_frames
        depth = (60 + 2 * np.sin(phase)) / (1 - 0.1 * x / focal - 0.15 * y / focal)
        on_x, on_y = x / focal * depth - 1.5 * np.sin(phase), y / focal * depth  # mm on the plane
        waves = np.sin(0.9 * on_x + 0.3 * on_y) * np.cos(0.7 * on_y - 0.2 * on_x)
        vessel = np.exp(-((on_y - 6 * np.sin(0.15 * on_x)) ** 2) / 4)
        red, green, blue = 0.65 + 0.15 * waves - 0.2 * vessel, 0.3 + 0.1 * waves - 0.15 * vessel, 0.28 + 0.08 * waves
        rgb = np.stack([red, green, blue], -1)
        tool = (x > width * (0.3 - 0.1 * np.sin(phase))) & (np.abs(y) < height * 0.1)
        rgb[tool] = 0.55
        depth[tool] -= 15
        depth[:4, :5] = 0
        name = f"{i:06d}.png"
        cv2.imwrite(str(out / "images" / name), np.rint(255 * rgb.clip(0, 1)).astype(np.uint8)[..., ::-1])
        cv2.imwrite(str(out / "masks" / name), tool.astype(np.uint8) * 255)
        cv2.imwrite(str(out / "depth" / name), np.rint(depth / TINY_DEPTH_SCALE).astype(np.uint16))
    row = np.column_stack([np.eye(3), np.zeros(3), (height, width, focal)]).ravel()
    np.save(out / "poses_bounds.npy", np.tile(np.append(row, (40, 80)), (num_frames, 1)))
    description = (
        f'{{"width": {width}, "height": {height}, "fx": {focal}, "fy": {focal}, "cx": {width / 2}, "cy": {height / 2}, '
        f'"frames_per_second": 15.0, "depth_unit": "mm", "depth_scale": {TINY_DEPTH_SCALE}, "mask_tool_value": 255}}'
    )
    (out / "sequence.json").write_text(description, encoding="utf-8")
    return out


@pytest.fixture(autouse=True, scope="session")
def few_vessels() -> Iterator[None]:
    """To grow the vessels of a phantom takes longer than all the rest of a small one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("endoprior.phantom.texture.TREES", 100)
        yield


@pytest.fixture(scope="module")
def all_vessels() -> Iterator[None]:
    """As many as for a user, in the files that use this fixture."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("endoprior.phantom.texture.TREES", 1000)
        yield


@pytest.fixture(scope="module")
def browser(player: Path) -> Iterator[Page]:
    """One Chromium for the HTML page `player` of a file of tests; skips loudly where there is none."""
    from browser import open_page, require_chromium

    require_chromium()
    with open_page(player.as_uri(), width=640, height=520) as page:
        yield page


@pytest.fixture
def page(browser: Page, player: Path) -> Page:
    """That page, just opened, in a window in which one recorded pixel is one pixel of the screen."""
    from player_page import open_player

    open_player(browser, player)
    return browser
