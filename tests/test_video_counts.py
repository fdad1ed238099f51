"""Videos whose announced number of images is not the real one: used with a note, and rejected if images are lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from video_files import ffmpeg, moving_pattern

from endoprior.core.checks import InputError
from endoprior.prepare.source import open_source

H264 = ["-c:v", "libx264", "-pix_fmt", "yuv420p"]


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of clips of 4 s or less, 25 images per second."""
    folder = tmp_path_factory.mktemp("clips")
    whole = ffmpeg(*moving_pattern(4), *H264, "-movflags", "faststart", folder / "whole.mp4")
    trim, front = ["-ss", "2.1", "-i", whole, "-t", "1.5", "-c", "copy"], ["-movflags", "faststart"]
    ffmpeg(*trim, *front, folder / "trimmed.mp4")
    ffmpeg("-itsoffset", "2", "-i", whole, "-c", "copy", *front, folder / "late.mp4")
    thinned = "select='not(eq(mod(n,5),3))*not(between(n,40,60))'"
    ffmpeg(*moving_pattern(4), "-vf", thinned, "-fps_mode", "vfr", *H264, *front, folder / "uneven.mp4")
    ffmpeg(*moving_pattern(1), "-c:v", "mjpeg", folder / "mjpeg.avi")
    for codec in ("mjpeg", "mpeg4"):  # the second image is missing: an empty one, for a repetition, takes its place
        ffmpeg("-ss", "0.5", "-i", whole, "-t", "1", "-c:v", codec, folder / f"repeated_{codec}.avi")
    ffmpeg(*moving_pattern(4), *H264, folder / "b_frames.avi")
    ffmpeg("-i", whole, "-c", "copy", folder / "clock_of_600.avi")
    ffmpeg("-i", whole, "-c", "copy", folder / "whole.mkv")
    ffmpeg("-itsoffset", "0.52", "-i", whole, "-c", "copy", folder / "late.mkv")
    ffmpeg("-i", whole, "-c", "copy", "-output_ts_offset", "18000", folder / "late.ts")
    ffmpeg(*moving_pattern(1), "-c:v", "libvpx-vp9", "-b:v", "300k", folder / "whole.webm")
    return folder


INTACT = {
    "whole.mp4": (100, ""),
    "trimmed.mp4": (39, "announces 92 images, 39 can be decoded"),
    "late.mp4": (100, ""),
    "uneven.mp4": (63, ""),
    "mjpeg.avi": (25, ""),
    "repeated_mjpeg.avi": (24, "announces 25 images, 24 can be decoded"),
    "repeated_mpeg4.avi": (24, "announces 25 images, 24 can be decoded"),
    "b_frames.avi": (100, ""),
    "clock_of_600.avi": (100, "announces 2400 images, 100 can be decoded"),
    "whole.mkv": (100, ""),
    "late.mkv": (100, ""),
    "whole.webm": (25, ""),
}
"""Number of images, and the note."""


@pytest.mark.parametrize("name", INTACT)
def test_an_intact_file_is_used_to_its_end(clips, name):
    source = open_source(clips / name)
    seconds = [image.seconds for image in source]
    count, note = INTACT[name]
    assert len(seconds) == count and source.notes == ([f"{name} {note}"] if note else [])
    assert min(np.diff(seconds)) > 0.039  # in the order of their display: no image would be left out


@pytest.mark.parametrize("name", ["whole.mp4", "late.mp4", "late.mkv", "late.ts", "whole.mkv"])
def test_the_duration_counts_from_the_first_image(clips, name):
    source = open_source(clips / name)
    assert source.seconds == pytest.approx(4)
    assert [image.seconds for image in source] == pytest.approx(np.arange(100) / 25)


@pytest.mark.parametrize("name", ["b_frames.avi", "clock_of_600.avi"])
def test_avi_shows_the_images_at_an_even_rate_in_their_order(clips, name):
    source, reference = open_source(clips / name), open_source(clips / "whole.mp4")
    assert source.frames_per_second == 25
    for image, want in zip(source, reference, strict=True):
        assert image.seconds == pytest.approx(want.seconds)
        assert np.abs(image.rgb_u8.astype(int) - want.rgb_u8).mean() < 5


def cut_off(file, folder, share):
    content = file.read_bytes()
    (folder / file.name).write_bytes(content[: int(share * len(content))])
    return folder / file.name


@pytest.mark.parametrize("share", [pytest.param(0.5, marks=pytest.mark.slow), 0.9])
@pytest.mark.parametrize("name", INTACT)
def test_a_file_cut_off_in_the_middle_is_rejected(clips, tmp_path, name, share):
    if (name, share) == ("clock_of_600.avi", 0.9):
        share = 0.6  # a third of the file is its index
    with pytest.raises(InputError, match=r"expected \d+ images, got \d+, then .*--end") as error:
        list(open_source(cut_off(clips / name, tmp_path, share)))
    assert "\n" not in str(error.value)


def test_a_file_without_its_table_is_rejected(clips, tmp_path):
    at_end = ffmpeg("-i", clips / "whole.mp4", "-c", "copy", tmp_path / "clip.mp4")
    at_end.write_bytes(at_end.read_bytes()[:-2000])
    with pytest.raises(InputError, match="expected a video"):
        list(open_source(at_end))


@pytest.mark.parametrize("name", ["whole.webm", "mjpeg.avi"])
def test_the_loss_of_the_last_image_is_noted(clips, tmp_path, name):
    cut = cut_off(clips / name, tmp_path, 0.97)
    source = open_source(cut)
    assert len(list(source)) == 24
    assert source.notes == [f"{name} announces 25 images, 24 can be decoded; the last 0.04 s are missing"]
