"""Pages of the HTML player in tests: small scenes, a second decoder of the data, and pictures from a browser."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from browser import Page
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from endoprior.core.types import Camera
from endoprior.export.html import CHANNELS
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model import scene as scenes
from endoprior.model.presets import preset
from endoprior.model.scene import Scene, SingleScene

WIDTH, HEIGHT, RATE = 320, 256, 10.0


def random_scene(num: int, num_frames: int, seed: int = 0) -> Scene:
    """Flat Gaussians on a bumpy patch 50-70 mm away, striped, moving smoothly; a camera that turns a little."""
    cfg = preset("default").fitted(num_frames)
    cfg = replace(cfg, schedule=replace(cfg.schedule, sh_degree=1))
    rng = np.random.default_rng(seed)
    flat = rng.uniform([-22, -18], [22, 18], (num, 2))
    depth = 60 + 8 * np.sin(flat[:, 0] / 7) * np.cos(flat[:, 1] / 5)
    points = np.column_stack([flat, depth]).astype(np.float32)
    stripes = 0.5 + 0.4 * np.sin(flat[:, :1] * [0.5, 0.9, 1.4] + flat[:, 1:] * [1.1, -0.4, 0.3])
    gaussians = create_gaussians(points, stripes.astype(np.float32), np.zeros(num, np.float32), cfg)
    size = 40 / np.sqrt(num)  # mm: about a neighbor apart
    with torch.no_grad():
        gaussians["quats"].copy_(torch.from_numpy(rng.normal(size=(num, 4))))
        gaussians["log_scales"].copy_(torch.from_numpy(np.log(size * rng.uniform(0.3, 1.5, (num, 3)))))
        gaussians["opacity_logits"].copy_(torch.from_numpy(rng.uniform(-3, 4, num)))
        gaussians["sh_rest"].copy_(torch.from_numpy(rng.normal(size=gaussians["sh_rest"].shape) * 0.1))
        gaussians["color_slopes"].copy_(torch.from_numpy(rng.normal(size=(num, 2, 3)) * 0.1))
        for name in ("motion", "changes"):
            gaussians[name].copy_(torch.from_numpy(rng.normal(size=gaussians[name].shape) * 0.3))
    cameras = []
    for i in range(num_frames):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec([0.004 * i, 0.2 - 0.006 * i, 0.1]).as_matrix()
        pose[:3, 3] = [-12, 0.3 * i, 2]
        cameras.append(Camera(WIDTH, HEIGHT, 300.0, 310.0, 150.0, 137.0, pose))
    return SingleScene(gaussians, None, cfg, tuple(cameras), RATE, torch.zeros(num), torch.zeros(num))


def unpack(page: Path) -> tuple[dict, list[NDArray[np.float64]]]:
    """Description and the (C, T, N) channels of every block of a page.

    By a second decoder: slow sums of what the format says.
    """
    text = page.read_text(encoding="utf-8")
    about, data = (re.search(rf'<script id="{name}"[^>]*>(.*?)</script>', text, re.S)[1] for name in ("about", "data"))
    about, packed = json.loads(about), base64.b64decode(data)
    assert about["channels"] == list(CHANNELS)
    blocks, start = [], 0
    for block in about["blocks"]:
        size = sum(channel["bytes"] for channel in block["channels"])
        blocks.append(unpack_block(block, packed[start : start + size]))
        start += size
    assert start == len(packed)
    return about, blocks


def unpack_block(block: dict, packed: bytes) -> NDArray[np.float64]:
    """(C, T, N) channels of a block."""
    num, num_steps = block["gaussians"], block["steps"]
    channels, start = [], 0
    for channel in block["channels"]:
        stream = zlib.decompress(packed[start : start + channel["bytes"]])
        start += channel["bytes"]
        steps = 1 if channel["order"] == 0 else num_steps
        low, high = np.frombuffer(stream, np.uint8).astype(np.int64).reshape(2, num, steps)
        coded = low + 256 * high
        residual = np.where(coded % 2 == 0, coded // 2, -(coded + 1) // 2)
        values = np.empty((num, steps), np.int64)
        for t in range(steps):
            if t == 0:
                values[:, 0] = coded[:, 0]
            elif t == 1 or channel["order"] == 1:
                values[:, t] = values[:, t - 1] + residual[:, t]
            else:
                values[:, t] = 2 * values[:, t - 1] - values[:, t - 2] + residual[:, t]
        values = np.broadcast_to(values.T % 65536, (num_steps, num))
        channels.append(channel["low"] + channel["step"] * values)
    return np.stack(channels)


def open_player(page: Page, address: Path) -> None:
    """Load a page written by `write_html`, and size the window so that its picture is 1:1."""
    page.problems.clear()
    page.requests.clear()
    page.resize(640, 520)
    page.go(address.as_uri())
    page.wait_for("document.body.dataset.state == 'ready'")
    stage_height = page.box("#stage")[3]
    page.resize(640, round(520 + HEIGHT - stage_height))
    page.wait_for(f"picture.getBoundingClientRect().height == {HEIGHT}")
    settle(page)


def press_button(page: Page, selector: str) -> None:
    """Click a button of the player; one that is folded away, as in these low windows, is unfolded before."""
    folded = page.evaluate("document.body.classList.contains('folded')")
    if folded:
        page.press("c")
    page.click(selector)
    if folded:
        page.press("c")


@contextmanager
def with_script(page: Page, code: str) -> Iterator[None]:
    """Run JavaScript before the scripts of each page that is loaded meanwhile."""
    script = page.send("Page.addScriptToEvaluateOnNewDocument", source=code)["identifier"]
    try:
        yield
    finally:
        page.send("Page.removeScriptToEvaluateOnNewDocument", identifier=script)


def settle(page: Page, frame: int | None = None) -> None:
    """Wait until the picture is drawn in full."""
    frame_shown = "" if frame is None else f" && picture.dataset.frame == {frame}"
    # Two ticks: one to notice what just happened, one to draw it.
    page.evaluate(
        "new Promise(f => requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(f))))"
    )
    page.wait_for("picture.dataset.settled == 'true'" + frame_shown)


def picture(page: Page, path: Path) -> NDArray[np.float64]:
    """(H, W, 3) the drawn picture, 0..255; a screenshot of the whole window is kept at `path`."""
    left, top, width, height = (round(v) for v in page.box("#picture"))
    return page.screenshot(path)[top : top + height, left : left + width].astype(float)


def rendered(scene: Scene, time: float) -> NDArray[np.float64]:
    """(H, W, 3) the renderer's picture, 0..255."""
    # Where two windows show, the page has the Gaussians of both, and `Scene.render` mixes their pictures.
    parts, camera = [(scene.at(time), 1.0)], scene.camera_at(time)
    return 255.0 * scenes.render_parts(parts, camera, scene.backend, scene.background).color.numpy()
