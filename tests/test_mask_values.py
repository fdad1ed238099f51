"""Which values of a folder of masks are high: two values, smoothed outlines, labels, and labels that need an answer."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data.mask_files import read_user_mask, rule_of_files
from endoprior.data.mask_folders import open_mask_folder

SIZE = (96, 64)
FRAMES = 3


def dilated(mask, px):
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * px + 1, 2 * px + 1))) > 0


def shaft(i):
    mask = np.zeros((64, 96), bool)
    mask[10:30, 10 + i : 60 + i] = True
    return mask


def jaw(i):
    mask = np.zeros((64, 96), bool)
    mask[14:26, 60 + i : 75 + i] = True
    return mask


def thread(i):
    """Two pixels wide."""
    mask = np.zeros((64, 96), bool)
    mask[40:42, 5 : 80 + i] = True
    return mask


def tool(i):
    return shaft(i) | jaw(i)


def write(folder, frame, suffix=".png", options=()):
    folder.mkdir()
    for i in range(FRAMES):
        values = frame(i)
        if suffix == ".npy":
            np.save(folder / f"{i}.npy", values)
        else:
            stored = values[..., ::-1] if values.ndim == 3 else values
            stored = stored if stored.dtype == np.uint16 else stored.astype(np.uint8)
            assert cv2.imwrite(str(folder / f"{i}{suffix}"), stored, list(options))
    return folder


def read(folder, labels=""):
    return [frame.read(SIZE) for frame in open_mask_folder(folder, labels).frames]


def ignored_rim(of):
    return lambda i: of(i) + 255 * (dilated(of(i), 2) & ~of(i))


EXACT = {
    "a rim of 255": (ignored_rim(tool), lambda i: dilated(tool(i), 2)),
    "a thread with a rim of 255": (ignored_rim(thread), lambda i: dilated(thread(i), 2)),
    "parts up to 255": (lambda i: 85 * shaft(i) + 170 * jaw(i) + 255 * thread(i), lambda i: tool(i) | thread(i)),
    "a faint part": (lambda i: 255 * shaft(i) + 127 * jaw(i), tool),
    "a part in one frame": (lambda i: 255 * shaft(i) + 60 * (jaw(i) if i == 1 else 0), lambda i: tool(i) if i == 1
                            else shaft(i)),
    "a thin part": (lambda i: 2 * tool(i) + (dilated(tool(i), 1) & ~tool(i)), lambda i: dilated(tool(i), 1)),
    "1 and 255, by frame": (lambda i: (255 if i else 1) * tool(i), tool),
    "1 and 2": (lambda i: 1 + tool(i).astype(int), tool),
    "40 instances": (lambda i: np.where(tool(i), 10 + np.arange(96) // 2, 0), tool),
    "16 bits": (lambda i: tool(i).astype(np.uint16), tool),
}  # fmt: skip


@pytest.mark.parametrize("name", EXACT)
def test_labels_are_told_from_two_values(tmp_path, name):
    values, want = EXACT[name]
    for i, mask in enumerate(read(write(tmp_path / "m", values))):
        assert (mask == want(i)).all()


def parts(i):
    return (85 * shaft(i) + 170 * jaw(i) + 255 * thread(i)).astype(np.uint8)


def through_jpeg(values):
    return cv2.imdecode(cv2.imencode(".jpg", values.astype(np.uint8))[1], cv2.IMREAD_UNCHANGED)


def half_size(values):
    large = cv2.resize(values, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    return cv2.resize(np.roll(large, 1, (0, 1)), SIZE, interpolation=cv2.INTER_AREA)


def blurred(sigma):
    return lambda i: cv2.GaussianBlur((255 * tool(i)).astype(np.uint8), (0, 0), sigma)


NEARLY = {
    "parts, compressed": (parts, ".jpg", lambda i: tool(i) | thread(i), 3),
    "smoothed": (blurred(1), ".png", tool, 1),
    "smoothed much": (blurred(3), ".png", tool, 3),
    "smoothed and compressed": (blurred(2), ".jpg", tool, 2),
    "resized": (lambda i: half_size((255 * tool(i)).astype(np.uint8)), ".png", tool, 1),
    "saved again without loss": (lambda i: through_jpeg(255 * tool(i)), ".png", tool, 2),
    "compressed badly": (lambda i: 255 * tool(i), ".jpg", tool, 2),
}


@pytest.mark.parametrize("name", NEARLY)
def test_outlines_stay_where_they_are(tmp_path, name):
    values, suffix, want, px = NEARLY[name]
    quality = (cv2.IMWRITE_JPEG_QUALITY, 60) if "badly" in name else ()
    for i, mask in enumerate(read(write(tmp_path / "m", values, suffix, quality))):
        inner = ~dilated(~want(i), px)
        assert mask[inner].all() and not mask[~dilated(want(i), px)].any()


@pytest.mark.parametrize(
    "values",
    [
        lambda i: np.where(tool(i), 0.8, 0.3) if i else np.zeros((64, 96)),  # probabilities, one frame of whole numbers
        lambda i: np.where(tool(i), 2.5, -3.5) if i else np.full((64, 96), 2.5),  # logits, one frame positive
        lambda i: np.where(tool(i), 1, -1),
        tool,
    ],
)
def test_arrays_have_one_meaning_in_a_folder(tmp_path, values):
    found = read(write(tmp_path / "m", values, ".npy"))
    assert all((found[i] == tool(i)).all() for i in (1, 2))


def test_a_few_wrong_pixels_do_not_make_labels_of_inverted_masks(tmp_path):
    def values(i):
        inverted = np.where(tool(i), 0, 255)
        inverted[60, 3:6] = 250
        return inverted

    found = read(write(tmp_path / "m", values))
    assert (found[0] == ~tool(0)).all() and open_mask_folder(tmp_path / "m").tool_is_high is None


def test_what_was_made_of_labels_is_said(tmp_path):
    given = open_mask_folder(write(tmp_path / "m", ignored_rim(tool)))
    assert given.tool_is_high and given.note == "labels 0, 1, 255; tools: all above 0; others: `--mask-labels 255`"
    assert open_mask_folder(write(tmp_path / "two", lambda i: 255 * tool(i))).note == ""
    chosen = open_mask_folder(tmp_path / "m", "1")
    assert chosen.note == "tools: labels 1 of 0, 1, 255" and (chosen.frames[1].read(SIZE) == tool(1)).all()


def tissues(i):
    return 3 + 2 * (np.arange(96) > 50)[None] * np.ones((64, 1), int) + 6 * tool(i)


def colored(i):
    image = np.zeros((64, 96, 3), np.uint8)
    image[:] = 127, 0, 127
    image[tool(i)] = 255, 85, 0
    return image


DOUBTFUL = {
    "no background": (tissues, "the labels 3, 5, 9, 11", "9, 11"),
    "mostly labels": (
        lambda i: tissues(i) * (np.arange(96) > 4),
        "the labels 0, 3, 5, 9, 11, those above 0 on",
        "9,11",
    ),
    "0 is the tool": (lambda i: np.where(tool(i), 0, 1 + (np.arange(96) > 50)), "the labels 0, 1, 2", "0"),
    "colors without black": (colored, "the colors #7f007f, #ff5500", "#FF5500"),
}


@pytest.mark.parametrize("name", DOUBTFUL)
def test_labels_that_may_be_tissue_are_asked_for(tmp_path, name):
    values, says, answer = DOUBTFUL[name]
    write(tmp_path / "m", values)
    with pytest.raises(InputError) as error:
        open_mask_folder(tmp_path / "m")
    text = str(error.value)
    assert says in text and "Fix: Name those of tools, such as `--mask-labels " in text and "\n" not in text
    assert all((mask == tool(i)).all() for i, mask in enumerate(read(tmp_path / "m", answer)))


def test_labels_that_are_not_there_are_named(tmp_path):
    write(tmp_path / "m", ignored_rim(tool))
    with pytest.raises(InputError, match=r"--mask-labels: expected labels of \S+m \(0, 1, 255\), got 7\. Fix: `"):
        open_mask_folder(tmp_path / "m", "1,7")
    write(tmp_path / "jpeg", lambda i: 255 * tool(i), ".jpg")
    with pytest.raises(InputError, match="values that are compressed with errors"):
        open_mask_folder(tmp_path / "jpeg", "255")


def test_a_mask_alone_is_read_like_a_folder_of_one(tmp_path):
    write(tmp_path / "m", ignored_rim(tool))
    assert (read_user_mask(tmp_path / "m/1.png", SIZE) == dilated(tool(1), 2)).all()
    rule = rule_of_files([tmp_path / "m/0.png"], "1")
    assert (read_user_mask(tmp_path / "m/1.png", SIZE, rule) == tool(1)).all()


def test_prepare_reads_labels_with_a_rim(tmp_path, capsys):
    rng = np.random.default_rng(0)
    colors = [np.where(tool(i)[..., None], (120, 120, 120), (180, 80, 70)) for i in range(FRAMES)]
    write(tmp_path / "images", lambda i: np.clip(colors[i] + rng.integers(-9, 9, (64, 96, 1)), 0, 255).astype(np.uint8))
    write(tmp_path / "m", ignored_rim(tool))
    words = ["prepare", str(tmp_path / "images"), str(tmp_path / "out"), "--masks", str(tmp_path / "m")]
    assert main([*words, "--depth", "none", "--poses", "still", "--border", "keep"]) == 0
    assert "note: masks: labels 0, 1, 255; tools: all above 0" in capsys.readouterr().out
    for i in range(FRAMES):
        mask = cv2.imread(str(tmp_path / f"out/masks/{i:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert (mask == 255 * dilated(tool(i), 2)).all()
