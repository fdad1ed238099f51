"""Tools found in frames: against the phantom's truth, with and without tools; the regions; the weights."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch

from endoprior.core.checks import InputError
from endoprior.data.images import read_color, read_tool_mask
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.tool_masks import FoundTools, ToolFinder, network
from endoprior.tool_masks.network import (
    LONG_SIDE_PX,
    ToolNetwork,
    network_from,
    network_input,
    network_size,
    shipped_network,
    weights_of,
)
from endoprior.tool_masks.regions import entering_regions

pytestmark = pytest.mark.usefixtures("all_vessels")
FRAMES = 4
SIZE = (320, 256)
CARD = Path(__file__).parent.parent / "docs" / "tool_network.md"


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """(images, tool masks, images without tools) of a few frames."""
    folder = tmp_path_factory.mktemp("tools") / "phantom"
    write_phantom(folder, PhantomConfig(frames=FRAMES, width=SIZE[0], height=SIZE[1], seed=4, side_views=False))
    files = [f"{i:06d}.png" for i in range(FRAMES)]
    return (
        [read_color(folder / "images" / name) for name in files],
        [read_tool_mask(folder / "masks" / name) for name in files],
        [read_color(folder / "truth" / "tissue" / name) for name in files],
    )


def whole(image):
    return np.ones(image.shape[:2], bool)


def overlap(found, true):
    found, true = np.stack(found), np.stack(true)
    return (found & true).sum() / (found | true).sum()


@pytest.mark.slow
def test_tools_of_the_phantom_are_found(phantom):
    images, true, _ = phantom
    found = [ToolFinder().find(image, whole(image)) for image in images]
    assert overlap([tools.tool_mask for tools in found], true) > 0.8
    assert all(0.5 < tools.confidence <= 1 for tools in found)


def test_tissue_alone_gives_empty_masks(phantom):
    assert not any(ToolFinder().find(image, whole(image)).tool_mask.any() for image in phantom[2])


def test_exposure_color_and_mirroring_hardly_matter(phantom):
    image, finder = phantom[0][1], ToolFinder()
    usual = finder.find(image, whole(image)).tool_mask
    dark = (image * 0.6).astype(np.uint8)
    pale = (0.6 * image + 0.4 * image.mean(-1, keepdims=True)).astype(np.uint8)
    for changed in (dark, pale):
        assert overlap([finder.find(changed, whole(image)).tool_mask], [usual]) > 0.8
    mirrored = finder.find(np.ascontiguousarray(image[:, ::-1]), whole(image)).tool_mask[:, ::-1]
    assert overlap([mirrored], [usual]) > 0.95


def test_masks_stay_inside_the_view_and_repeat(phantom):
    image = phantom[0][0]
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    view = np.hypot(x - SIZE[0] / 2, y - SIZE[1] / 2) < 110
    first, second = (ToolFinder().find(image * view[..., None], view) for _ in range(2))
    assert (first.tool_mask == second.tool_mask).all() and first.confidence == second.confidence
    assert not (first.tool_mask & ~view).any()


def test_empty_views_give_empty_masks():
    image = np.full((40, 60, 3), 90, np.uint8)
    found = ToolFinder().find(image, np.zeros((40, 60), bool))
    assert not found.tool_mask.any() and found.confidence == 1 and not found.uncertain


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (700, 40)])
def test_any_size_is_taken(shape):
    rgb_u8 = np.random.default_rng(0).integers(0, 255, (*shape, 3)).astype(np.uint8)
    assert ToolFinder().find(rgb_u8, np.ones(shape, bool)).tool_mask.shape == shape
    assert max(network_size(shape)) == LONG_SIDE_PX


def test_masks_of_low_confidence_are_uncertain_and_mismatched_shapes_are_named():
    tool = np.ones((4, 4), bool)
    assert [FoundTools(tool, confidence).uncertain for confidence in (0.49, 0.51)] == [True, False]
    image, view = np.zeros((8, 9, 3), np.uint8), np.ones((8, 9), bool)
    with pytest.raises(ValueError, match="view must have shape"):
        ToolFinder().find(image, view.T)


def test_nothing_is_seen_beyond_the_view():
    rgb_u8 = np.random.default_rng(0).integers(0, 255, (8, 9, 3)).astype(np.uint8)
    view = np.zeros((8, 9), bool)
    view[2:5, 3:7] = True
    image = network_input(rgb_u8, view)
    assert image.shape == (6, 8, 9) and (image[5] == view).all() and not image[:5, ~view].any()
    assert image[0, 2, 3] == pytest.approx(rgb_u8[2, 3, 0] / 127.5 - 1)


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


def test_the_shipped_weights_are_those_of_the_model_card():
    data = network.FILE.read_bytes()
    assert hashlib.sha256(data).hexdigest() == network.SHA256
    assert len(data) <= 4 * 2**20
    assert network.SHA256 in CARD.read_text(encoding="utf-8")


def test_changed_or_missing_weights_are_one_line(tmp_path, monkeypatch):
    shipped_network.cache_clear()
    file = tmp_path / "weights.safetensors"
    monkeypatch.setattr(network, "FILE", file)
    with pytest.raises(InputError, match="expected the weights of the tool network"):
        shipped_network()
    file.write_bytes(weights_of(ToolNetwork()))
    with pytest.raises(InputError, match="expected a file with SHA-256"):
        shipped_network()


def test_weights_come_back_in_half_precision():
    torch.manual_seed(0)
    network = ToolNetwork().eval()
    again = network_from(weights_of(network))
    image = torch.randn(1, 6, 64, 96)
    with torch.no_grad():
        torch.testing.assert_close(again(image), network(image), rtol=2e-2, atol=2e-3)  # float16 has 11 bits


@pytest.mark.slow
def test_real_clip(real_clip):
    """Trained on frames of this clip too: the benchmark says what a clip is like that the network has not seen."""
    files = [f"{i:06d}.png" for i in range(0, 90, 10)]
    images = [read_color(real_clip / "images" / name) for name in files]
    true = [read_tool_mask(real_clip / "masks" / name) for name in files]
    found = [ToolFinder().find(image, whole(image)).tool_mask for image in images]
    for masks in (found, true):
        for mask in masks:
            mask[:42, :110] = False  # the burned-in label is no tool
    assert overlap(found, true) > 0.82
