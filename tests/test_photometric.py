"""Smoke apart from the tissue: the model's formula, what is found in frames, training, files, pictures without it."""

from __future__ import annotations

import signal
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from state_files import StateFile
from tiny_training import losses_of, tiny_config

from endoprior import evaluate, load_scene, load_sequence, train
from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.model.photometric import GRID, add_smoke, add_smoke_torch, between, of_all_frames
from endoprior.model.windowed_scene import Span, WindowedScene
from endoprior.runs.train import start_run
from endoprior.training.photometric import fitted_grids, haze_statistics, of_pixels, resized, smoke_needed, smoke_of
from endoprior.view.viewable import ViewSettings
from endoprior.view.viewable_scene import ViewableScene

SMOKE, LIGHT = 0.65, 0.3  # share of the light that the densest smoke takes, and squared color of smoke


def density(index: int, num_frames: int = 17) -> float:
    """Of the smoke in a frame, 0 to 1: it comes and goes."""
    return max(0.0, np.sin(np.pi * (2 * index / (num_frames - 1) - 0.5)))


def smoke_share(index: int, height: int, width: int) -> np.ndarray:
    """(H, W) share of light that smoke takes: denser at the right."""
    return np.broadcast_to(SMOKE * density(index) * np.linspace(0.6, 1, width), (height, width))


@pytest.fixture
def smoky(tiny_sequence):
    """The tiny sequence behind smoke, and its frames without: (17, 40, 48, 3) in [0, 1]."""
    clear = []
    for index, file in enumerate(sorted((tiny_sequence / "images").iterdir())):
        color = cv2.imread(str(file)) / 255
        share = smoke_share(index, 40, 48)[..., None]
        cv2.imwrite(str(file), np.rint(255 * np.sqrt((1 - share) * color**2 + share * LIGHT)))
        clear.append(color[..., ::-1])
    return tiny_sequence, np.stack(clear)


def config(photometric: str = "auto", coarse: int = 0, fine: int = 12):
    cfg = tiny_config("basis", coarse, fine)
    return replace(cfg, render=replace(cfg.render, photometric=photometric))


def psnr(image, true, mask) -> float:
    return float(-10 * np.log10(((image - true)[mask] ** 2).mean()))


# --- the formula ----------------------------------------------------------------------------------------------------


def random_case(seed: int = 0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    color = torch.rand(37, 45, 3, generator=generator).to(dtype).requires_grad_()
    return color, torch.rand(*GRID, 2, generator=generator)


def test_the_kernel_and_the_formula_agree_in_value_and_gradient():
    (color, grid), weight = random_case(), torch.rand(37, 45, 3)
    found = {}
    for function in (add_smoke, add_smoke_torch):
        shown = function(color, grid)
        (slope,) = torch.autograd.grad((shown * weight).sum(), color)
        found[function] = shown.detach(), slope
    torch.testing.assert_close(found[add_smoke], found[add_smoke_torch], rtol=2e-5, atol=2e-5)


def test_a_second_backward_pass_gives_the_gradient_again():
    color, grid = random_case()
    total = add_smoke(color, grid).sum() * 3
    first, second = (torch.autograd.grad(total, color, retain_graph=True)[0].clone() for _ in range(2))
    assert torch.equal(first, second)


def test_gradient_against_finite_differences():
    color, grid = random_case(1, torch.float64)
    small = color[:5, :6].detach().clamp(min=0.05).requires_grad_()
    assert torch.autograd.gradcheck(lambda c: add_smoke(c, grid), small)


def test_no_smoke_changes_nothing():
    color, grid = random_case()
    grid[..., 0], grid[..., 1] = 1, 0
    torch.testing.assert_close(add_smoke(color, grid), color, rtol=1e-3, atol=1.01e-4)


def test_smoke_in_closed_form_at_the_centers_of_cells():
    grid = torch.rand(*GRID, 2)
    color = torch.full((GRID[0] * 3, GRID[1] * 3, 3), 0.5)  # the middle of three pixels is the center of a cell
    want = (grid[..., 0] * 0.25 + grid[..., 1]).sqrt()
    torch.testing.assert_close(add_smoke(color, grid)[1::3, 1::3, 0], want, rtol=1e-4, atol=1e-4)


def test_held_out_frames_lie_between_their_neighbors():
    grids = torch.rand(3, *GRID, 2)
    whole = of_all_frames(grids, [0, 2, 5], 8)
    assert torch.equal(whole[[0, 2, 5]], grids) and torch.equal(whole[7], grids[2])
    torch.testing.assert_close(whole[1], (grids[0] + grids[1]) / 2)
    torch.testing.assert_close(whole[4], grids[1] + 2 / 3 * (grids[2] - grids[1]))
    torch.testing.assert_close(between(whole, 0.5), (whole[0] + whole[1]) / 2)


# --- what is found in frames ----------------------------------------------------------------------------------------


def test_smoke_is_found_where_it_is_and_taken_away(smoky):
    folder, clear = smoky
    frames = load_sequence(folder).frames("train")
    grids = smoke_of(frames, "auto")
    assert grids is not None and grids.shape == (15, *GRID, 2) and (grids[..., 1] >= 0).all()
    gains, before, after = [], [], []
    for frame, grid in zip(frames, grids, strict=True):
        gain, veil = of_pixels(grid, frame.tissue_mask.shape)
        share = smoke_share(frame.index, 40, 48)
        if density(frame.index) > 0.5:
            gains.append(np.abs(gain - (1 - share))[frame.tissue_mask].mean())
            color = np.sqrt(np.maximum(frame.rgb**2 - veil[..., None], 0) / gain[..., None])
            before.append(psnr(frame.rgb, clear[frame.index], frame.tissue_mask))
            after.append(psnr(color, clear[frame.index], frame.tissue_mask))
    assert np.mean(gains) < 0.1 and np.mean(after) > np.mean(before) + 8


def test_clear_frames_keep_the_brightness_of_the_tissue(smoky):
    small = [resized(frame) for frame in load_sequence(smoky[0]).frames("train")]
    statistics = haze_statistics(small)
    grids = fitted_grids(small, statistics)
    clear = statistics.haze < 0.05
    assert clear.sum() >= 3 and abs(np.log(grids[clear][..., 0]).mean()) < 0.02 and grids[clear][..., 1].max() < 0.02


def test_clips_without_smoke_have_no_model(tiny_sequence):
    frames = load_sequence(tiny_sequence).frames("train")
    assert not smoke_needed(haze_statistics([resized(frame) for frame in frames])) and smoke_of(frames, "auto") is None
    assert smoke_of(frames, "none") is None and smoke_of(frames, "smoke") is not None


def test_brightness_alone_is_no_smoke(tiny_sequence):
    for index, file in enumerate(sorted((tiny_sequence / "images").iterdir())):
        cv2.imwrite(str(file), np.rint(cv2.imread(str(file)) * (1 - 0.5 * density(index))))
    assert smoke_of(load_sequence(tiny_sequence).frames("train"), "auto") is None


def test_nothing_is_fitted_to_held_out_frames(smoky):
    folder, _ = smoky
    before = smoke_of(load_sequence(folder).frames("train"), "smoke")
    for index in load_sequence(folder).indices("test"):
        cv2.imwrite(str(folder / f"images/{index:06d}.png"), np.full((40, 48, 3), 200, np.uint8))
    assert np.array_equal(smoke_of(load_sequence(folder).frames("train"), "smoke"), before)


# --- training and files ---------------------------------------------------------------------------------------------


def test_where_there_is_no_smoke_training_is_bit_identical(tiny_sequence):
    assert losses_of(tiny_sequence, config("auto")) == losses_of(tiny_sequence, config("none"))


@pytest.mark.slow
def test_stop_and_resume_equals_uninterrupted(smoky, tmp_path):
    sequence, cfg = load_sequence(smoky[0]), config()
    whole = train(sequence, cfg, tmp_path / "whole")
    assert whole.smoke_at(0.5) is not None

    def interrupt(report, _trainer):
        if report.iteration == 5:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(sequence, cfg, tmp_path / "parts", on_step=interrupt)
    train(sequence, cfg, tmp_path / "parts", resume=True)
    first, second = ((tmp_path / name / "scene.safetensors").read_bytes() for name in ("whole", "parts"))
    assert first == second


@pytest.fixture
def run(smoky, tmp_path):
    train(load_sequence(smoky[0]), config(fine=30), tmp_path / "run")
    return tmp_path / "run"


def test_the_scene_shows_tissue_and_frames_apart_and_scores_take_the_latter(run, smoky):
    scene, sequence = load_scene(run), load_sequence(smoky[0])
    assert scene.smoke.shape == (17, *GRID, 2)
    frame = sequence.frame(9)  # held out, behind smoke
    tissue, shown = (
        function(frame.time, frame.camera).color.numpy() for function in (scene.render, scene.render_with_smoke)
    )
    assert np.abs(tissue - shown).mean() > 0.05
    assert psnr(tissue, smoky[1][9], frame.tissue_mask) > psnr(shown, smoky[1][9], frame.tissue_mask)
    scored = evaluate(scene, sequence, networks=False)
    row = next(row for row in scored.per_frame if row["index"] == 9)
    assert row["strict_psnr"] == pytest.approx(psnr(shown, frame.rgb, frame.tissue_mask), abs=0.01)
    assert "interpolated" in scored.protocol["smoke"]


def test_pictures_without_smoke_stay_beside_those_with_it(run):
    for option in ([], ["--no-smoke"]):
        assert main(["render", str(run), "--split", "test", *option]) == 0
    with_smoke, without = (
        cv2.imread(str(run / folder / "rgb" / "000009.png")) for folder in ("renders", "renders/no_smoke")
    )
    assert np.abs(with_smoke.astype(float) - without).mean() > 5 and (run / "video_no_smoke.mp4").exists()


def test_training_says_that_there_is_smoke(smoky, tmp_path):
    said = []
    start_run(load_sequence(smoky[0]), config(), tmp_path / "run", say=said.append)
    assert any("smoke in" in line and "--render.photometric none" in line for line in said)


def test_smoke_that_no_training_finds_is_rejected(run, tmp_path):
    file = StateFile.read(run / "scene.safetensors")
    file.arrays["smoke"][3, 2, 1, 1] = -0.5
    file.write(tmp_path / "scene.safetensors")
    with pytest.raises(InputError, match="smoke"):
        load_scene(tmp_path / "scene.safetensors")


def test_the_viewer_shows_tissue_and_smoke_when_asked(run):
    scene = load_scene(run)
    viewable, camera = ViewableScene(scene, "run"), scene.cameras[9]
    assert viewable.has_smoke
    pictures = [viewable.picture(ViewSettings(frame=9, smoke=smoke), camera) for smoke in (False, True)]
    for picture, view in zip(pictures, (scene.render(9 / 17), scene.render_with_smoke(9 / 17)), strict=True):
        assert np.abs(picture / 255 - view.color.numpy()).max() < 0.003
    aside = ViewSettings(frame=9, smoke=True, endoscope=False)
    assert np.array_equal(viewable.picture(aside, camera), pictures[0])  # smoke is known in the endoscope's view only


def test_windows_fade_their_smoke_and_one_without_takes_the_other(run):
    scene = load_scene(run)
    twin = replace(scene, smoke=scene.smoke * 2)
    parts = [scene, twin]
    spans = tuple(Span(start, start + 17, len(scene)) for start in (0, 7))
    windows = WindowedScene(scene.config, scene.cameras + scene.cameras[:7], 25.0, spans, parts.__getitem__)
    first, second = windows.shown_at(12 / 24)
    want = first.weight * between(scene.smoke, 12) + second.weight * between(twin.smoke, 5)
    torch.testing.assert_close(windows.smoke_at(12 / 24), want)
    parts[1] = replace(scene, smoke=None)
    alone = WindowedScene(scene.config, scene.cameras + scene.cameras[:7], 25.0, spans, parts.__getitem__)
    torch.testing.assert_close(alone.smoke_at(12 / 24), between(scene.smoke, 12))
    assert alone.smoke_at(20 / 24) is None
