"""`endoprior masks DATA`: new masks in the folder, the originals beside them, a sheet, shares and confidence."""

import json
import shutil

import cv2
import numpy as np
import pytest

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.data.edit import replace_masks, writable_masks
from endoprior.data.images import read_tool_mask
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.visualization.image_tools import mask_sheet

FRAMES = 4


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """Left as it is."""
    out = tmp_path_factory.mktemp("phantom") / "DATA"
    write_phantom(out, PhantomConfig(frames=FRAMES, width=128, height=96, seed=4))
    return out


@pytest.fixture
def folder(phantom, tmp_path):
    """A copy of it."""
    return shutil.copytree(phantom, tmp_path / "DATA")


def masks_of(folder):
    return [read_tool_mask(file) for file in sorted(folder.glob("*.png"))]


def test_masks_are_replaced_and_the_originals_kept(folder, capsys):
    before = masks_of(folder / "masks")
    assert main(["masks", str(folder)]) == 0
    assert all((a == b).all() for a, b in zip(masks_of(folder / "masks_before"), before, strict=True))
    assert len(masks_of(folder / "masks")) == FRAMES
    shares = json.loads((folder / "tool_masks.json").read_text())
    assert [entry["frame"] for entry in shares] == list(range(FRAMES))
    for entry, mask in zip(shares, masks_of(folder / "masks"), strict=True):
        assert entry["share"] == pytest.approx(mask.mean()) and 0 <= entry["confidence"] <= 1
    assert cv2.imread(str(folder / "tool_masks.png")).shape[1] == 6 * 320
    said = capsys.readouterr().out
    assert f"of {FRAMES} frames" in said and "endoprior view" in said
    load_sequence(folder, DataConfig()).validate()  # the sheet does not disturb the folder


def test_refining_only_adds_pixels(folder):
    true = masks_of(folder / "masks")
    for file, mask in zip(sorted((folder / "masks").glob("*.png")), true, strict=True):
        shorter = mask.copy()
        shorter[:, 60:70] = False
        cv2.imwrite(str(file), np.where(shorter, 255, 0).astype(np.uint8))
    given = masks_of(folder / "masks")
    assert main(["masks", str(folder), "--refine"]) == 0
    assert not any((a & ~b).any() for a, b in zip(given, masks_of(folder / "masks"), strict=True))


def test_a_folder_without_masks_gets_them(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    for i in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), rng.integers(0, 255, (48, 64, 3), np.uint8))
    sequence = load_sequence(tmp_path, DataConfig())
    mask = np.zeros((48, 64), bool)
    mask[10:20] = True
    replace_masks(sequence, dict.fromkeys(range(3), mask))
    again = load_sequence(tmp_path, DataConfig())
    assert all((~again.frame(i).tissue_mask == mask).all() for i in range(3))
    assert not (tmp_path / "masks_before").exists()


def forplane(folder):
    """The layout whose left columns are cropped, with masks of the uncropped images."""
    write(folder, "images", "masks", "gt_depth")
    row = np.column_stack([np.eye(3), np.zeros(3), (48, 64, 70)]).ravel()
    np.save(folder / "poses_bounds.npy", np.tile(np.append(row, (0, 1)), (3, 1)))


def rectified(folder):
    write(folder, "image01", "depth01")
    (folder / "intrinsics.txt").write_text("70 0 32\n0 70 24\n0 0 1\n")


def write(folder, *parts):
    for part in parts:
        (folder / part).mkdir(parents=True)
        for i in range(3):
            blank = np.zeros((48, 64, 3) if part.startswith("image") else (48, 64), np.uint8)
            cv2.imwrite(str(folder / part / f"{i}.png"), blank)


@pytest.mark.parametrize("make", [forplane, rectified])
def test_a_dataset_whose_reader_takes_no_masks_of_this_size_stays_as_it_is(tmp_path, make, capsys, monkeypatch):
    make(tmp_path / "DATA")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    sequence = load_sequence(tmp_path / "DATA")
    camera = sequence.camera(0)
    with pytest.raises(InputError, match="one mask file per frame"):
        replace_masks(sequence, dict.fromkeys(range(3), np.zeros((camera.height, camera.width), bool)))
    search = "endoprior.tool_masks.tool_finder.find_in_sequence"
    monkeypatch.setattr(search, lambda *args, **more: pytest.fail("searched"))
    assert main(["masks", str(tmp_path / "DATA")]) == 2
    assert "one mask file per frame" in capsys.readouterr().err
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


def test_new_masks_are_those_of_all_frames_at_full_size(tmp_path):
    write(tmp_path, "images")
    assert [file.name for file in writable_masks(load_sequence(tmp_path))] == ["0.png", "1.png", "2.png"]
    for cfg in (DataConfig(shrink=2), DataConfig(first_frames=2), DataConfig(window="0-1")):
        with pytest.raises(InputError, match="one mask file per frame"):
            writable_masks(load_sequence(tmp_path, cfg))


def test_the_sheet_tints_and_outlines_tools():
    image = np.full((40, 60, 3), 100, np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[10:30, 20:40] = True
    sheet = mask_sheet([(image, mask, ""), (image, ~mask & mask, "")], 2, 60)
    assert sheet.shape == (40, 120, 3)
    assert tuple(sheet[20, 30]) == (60, 140, 162) and tuple(sheet[10, 25]) == (0, 200, 255)
    assert (sheet[5, :] == 100).all() and (sheet[:35, 60:] == 100).all()
