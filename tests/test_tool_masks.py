"""Tools found in a clip: against the phantom's truth, with and without tools; each cue by itself; the regions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import shrink_tool_network

from endoprior.data.images import read_color, read_depth, read_tool_mask
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.tool_masks import FoundTools, ToolSample, fit_tools
from endoprior.tool_masks.attachment import attachment_log_odds, color_cells, independence
from endoprior.tool_masks.colors import ClipColors, first_guess
from endoprior.tool_masks.regions import entering_regions
from endoprior.tool_masks.relief import relief_cells, relief_log_odds
from endoprior.tool_masks.synthetic import paint_tool

FRAMES = 6
VIEW = np.ones((128, 160), bool)


@pytest.fixture(autouse=True, scope="module")
def whole_network(small_tool_network, all_vessels):
    """As large and as long trained as for a user, only in this file."""
    small_tool_network.undo()
    yield
    shrink_tool_network(small_tool_network)


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """(images, tool masks, depths mm, images without tools) of six frames."""
    folder = tmp_path_factory.mktemp("tools") / "phantom"
    write_phantom(folder, PhantomConfig(frames=FRAMES, width=160, height=128, seed=4))
    files = [f"{i:06d}.png" for i in range(FRAMES)]
    return (
        [read_color(folder / "images" / name) for name in files],
        [read_tool_mask(folder / "masks" / name) for name in files],
        [read_depth(folder / "depth" / name, 0.01) for name in files],
        [read_color(folder / "truth" / "tissue" / name) for name in files],
    )


@pytest.fixture(scope="module")
def model(phantom):
    return fit_tools(samples(phantom[0], phantom[2]))


def samples(images, depths=None, view=VIEW):
    known = depths if depths is not None else [None] * len(images)
    later = [*images[1:], None]
    return [ToolSample(*part) for part in zip(images, [view] * len(images), later, known, strict=True)]


def scores(found, true):
    """Intersection over union and precision over all frames."""
    found, true = np.stack(found), np.stack(true)
    return (found & true).sum() / (found | true).sum(), (found & true).sum() / max(found.sum(), 1)


@pytest.mark.slow
def test_tools_of_the_phantom_are_found(phantom, model):
    images, true, depths, _ = phantom
    found = [model.find(image, VIEW, depth) for image, depth in zip(images, depths, strict=True)]
    overlap, precision = scores([tools.mask for tools in found], true)
    assert overlap > 0.8 and precision > 0.95  # 0.865 and 0.984 at least, for three phantoms and two seeds
    assert model.detected_share == 1 and model.relief is not None
    assert all(0.3 < tools.confidence <= 1 for tools in found)


@pytest.mark.slow
def test_masks_are_filled_regions(phantom, model):
    mask = model.find(phantom[0][0], VIEW).mask
    regions = cv2.connectedComponents(mask.astype(np.uint8))[0] - 1
    assert 1 <= regions <= 2  # two instruments
    background = cv2.connectedComponents(np.pad(~mask, 1, constant_values=True).astype(np.uint8), connectivity=4)[0] - 1
    assert background == 1


@pytest.mark.slow
def test_tissue_alone_gives_empty_masks(phantom):
    tissue = phantom[3]
    model = fit_tools(samples(tissue))
    assert model.detected_share == 0
    assert not any(model.find(image, VIEW).mask.any() for image in tissue)


@pytest.mark.slow
def test_paler_and_darker_clips_give_similar_masks(phantom, model):
    images = phantom[0]
    usual = [model.find(image, VIEW).mask for image in images]
    dark = [image // 3 for image in images]
    pale = [(0.5 * image + 0.5 * image.mean(-1, keepdims=True)).astype(np.uint8) for image in images]
    for changed in (dark, pale):
        again = fit_tools(samples(changed))
        assert scores([again.find(image, VIEW).mask for image in changed], usual)[0] > 0.8


def test_equal_samples_give_equal_masks_inside_the_view(phantom, monkeypatch):
    shrink_tool_network(monkeypatch)
    y, x = np.mgrid[:128, :160]
    view = (x - 80) ** 2 + (y - 64) ** 2 < 60**2
    black = [np.where(view[..., None], image, 0).astype(np.uint8) for image in phantom[0]]
    torn = [fit_tools(samples(black, view=view)) for _ in range(2)]
    first, second = ([model.find(image, view) for image in black] for model in torn)
    for one, other in zip(first, second, strict=True):
        assert (one.mask == other.mask).all() and one.confidence == other.confidence
        assert not (one.mask & ~view).any()


def test_masks_of_low_confidence_are_uncertain_and_empty_ones_are_not():
    tool, none = np.ones((4, 4), bool), np.zeros((4, 4), bool)
    expected = [(tool, 0.49, True), (tool, 0.51, False), (none, 0.1, False)]
    assert [FoundTools(mask, confidence).uncertain for mask, confidence, _ in expected] == [e for *_, e in expected]


def test_gray_clips_and_empty_views_give_empty_masks():
    gray = np.full((40, 60, 3), 90, np.uint8)
    for view in (np.ones((40, 60), bool), np.zeros((40, 60), bool)):
        model = fit_tools([ToolSample(gray, view)])
        assert model.detected_share == 0
        assert not model.find(gray, view).mask.any() and model.find(gray, view).confidence == 1


def test_the_guess_depends_on_neither_exposure_nor_saturation(phantom):
    image, true = phantom[0][0], phantom[1][0]
    guesses = []
    for changed in (image, image // 2, (0.6 * image + 0.4 * image.mean(-1, keepdims=True)).astype(np.uint8)):
        guesses.append(first_guess(changed, VIEW, ClipColors.of([changed], [VIEW])) > 0)
    assert (guesses[0] & true).sum() > 0.7 * true.sum() and (guesses[0] & ~true).mean() < 0.05
    assert all(scores([guess], [guesses[0]])[0] > 0.75 for guess in guesses[1:])


@pytest.mark.parametrize(("own_px", "sign"), [(4, -1), (-4, 1)])
def test_what_moves_with_its_surroundings_is_tissue(own_px, sign):
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (160, 200)).astype(np.float32), (0, 0), 2)
    texture = (texture - texture.min()) / np.ptp(texture)
    red, gray = (texture[..., None] * np.array(color) for color in ((200.0, 90, 90), (180.0, 170, 170)))

    def frame(shift_px, patch_px):
        image = np.roll(red, shift_px, 1)
        image[50:110, 80 + patch_px : 120 + patch_px] = gray[50:110, 80:120]
        return image.astype(np.uint8)

    first, later, view = frame(0, 0), frame(4, own_px), np.ones((160, 200), bool)
    clip = ClipColors.of([first], [view])
    guess = np.full(view.shape, -3, np.float32)
    guess[50:110, 80:120] = 3
    cell = color_cells(first, clip)
    odds = attachment_log_odds([(cell, *independence(first, later, view, guess))], view.size)[cell]
    assert np.sign(np.median(odds[60:100, 90:110])) == sign and abs(np.median(odds[60:100, 90:110])) > 1
    assert np.median(odds[:40]) < -1
    assert (attachment_log_odds([], view.size) == 0).all()


@pytest.mark.parametrize("seed", range(12))
def test_painted_tools_enter_the_view_and_hide_what_is_behind(seed):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:77, :96]
    view = (x - 48) ** 2 + (y - 38) ** 2 < 36**2 if seed % 2 else np.ones((77, 96), bool)
    frame = np.full((77, 96, 3), (0.5, 0.2, 0.2), np.float32) * view[..., None]
    before = frame.copy()
    painted, tool = paint_tool(rng, frame, view)
    assert (frame == before).all() and painted.dtype == np.float32
    assert not (tool & ~view).any() and not painted[~view].any() and painted.min() >= 0
    assert cv2.connectedComponents(cv2.dilate(tool.astype(np.uint8), np.ones((5, 5))))[0] <= 2
    if tool.sum() > 20:
        inner = cv2.erode(np.pad(view, 1).astype(np.uint8), np.ones((9, 9)))[1:-1, 1:-1] > 0
        assert (tool & ~inner).any()  # it comes from the border
        assert np.abs(painted - frame).max(-1)[tool].mean() > 0.02


def test_missing_depth_has_no_relief():
    depth = np.full((96, 96), 50, np.float32)
    depth[40:56, :] = 30  # a bar 20 mm nearer
    depth[:8] = 0
    cell = relief_cells(depth, depth != 30)
    assert (cell[:8] == cell.max()).all() and (cell[44:52] != cell.max()).all()
    assert (cell[48] > cell[90]).all()  # nearer than its surroundings


def test_relief_of_tools_raises_their_odds():
    depth = np.full((96, 96), 50, np.float32)
    depth[40:56, :] = 30
    tools, view = depth == 30, np.ones((96, 96), bool)
    odds = relief_log_odds([(depth, tools, view)])
    cell = relief_cells(depth, ~tools)
    assert odds[cell[48, 48]] > 1 and odds[cell[90, 48]] < -1 and odds[-1] == 0
    assert relief_log_odds([(depth, np.zeros_like(tools), view)]) is None
    assert relief_log_odds([]) is None


@pytest.mark.parametrize(
    ("box", "kept"),
    [
        (np.s_[40:60, :80], True),  # a bar that comes in from the left
        (np.s_[40:60, :], True),  # a bar right across
        (np.s_[40:60, 20:80], False),  # one that does not touch the border
        (np.s_[:20, 10:110], False),  # an organ along the border
        (np.s_[40:42, :10], False),  # enters, but is too small
    ],
)
def test_tools_enter_end_first(box, kept):
    mask = np.zeros((100, 120), np.uint8)
    mask[box] = 1
    assert entering_regions(mask, np.ones((100, 120), bool)).any() == kept


def test_mismatched_shapes_are_named():
    image, view = np.zeros((8, 9, 3), np.uint8), np.ones((8, 9), bool)
    with pytest.raises(ValueError, match="view must have shape"):
        fit_tools([ToolSample(image, view.T)])
    with pytest.raises(ValueError, match="depth must have shape"):
        fit_tools([ToolSample(image, view, None, np.zeros((4, 4), np.float32))])
    with pytest.raises(ValueError, match="at least one frame"):
        fit_tools([])


@pytest.mark.slow
def test_real_clip(real_clip):
    files = [f"{i:06d}.png" for i in range(90)]
    images = [read_color(real_clip / "images" / name) for name in files]
    true = [read_tool_mask(real_clip / "masks" / name) for name in files[::10]]
    view = np.ones(true[0].shape, bool)
    chosen = [ToolSample(images[i], view, images[i + 2]) for i in range(0, 88, 6)]
    model = fit_tools(chosen)
    found = [model.find(image, view).mask for image in images[::10]]
    for masks in (found, true):
        for mask in masks:
            mask[:42, :110] = False  # the burned-in label is no tool
    overlap, precision = scores(found, true)
    assert overlap > 0.65 and precision > 0.75
