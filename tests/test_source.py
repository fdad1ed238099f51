"""Video files and image folders: all images, in order, with their times; errors for damaged files."""

import cv2
import numpy as np
import pytest
from video_files import write_video

from endoprior.core.checks import InputError
from endoprior.prepare.source import open_source
from endoprior.prepare.video import SourceFrame
from endoprior.prepare.video_clip import FrameSelection


def pictures_of(count, height=24, width=32):
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (height, width, 3), np.uint8) for _ in range(count)]


def test_video_is_decoded_losslessly(tmp_path):
    written = pictures_of(7)
    source = open_source(write_video(tmp_path / "a.mkv", written, rate=10))
    assert (source.width, source.height, source.frames_per_second) == (32, 24, 10)
    for _ in range(2):  # as often as needed
        found = list(source)
        assert [p.index for p in found] == list(range(7))
        assert np.allclose([p.seconds for p in found], np.arange(7) / 10)
        assert all(np.array_equal(p.rgb_u8, want) for p, want in zip(found, written, strict=True))


def test_odd_sizes_are_kept(tmp_path):
    source = open_source(write_video(tmp_path / "a.mkv", pictures_of(3, 25, 33)))
    assert (source.width, source.height) == (33, 25)


def test_folder_in_numeric_order(tmp_path):
    for number, image in zip((1, 2, 10), pictures_of(3), strict=True):
        cv2.imwrite(str(tmp_path / f"f{number}.png"), image[..., ::-1])
    source = open_source(tmp_path, 5.0)
    found = list(source)
    assert [p.seconds for p in found] == [0, 0.2, 0.4]
    assert all(np.array_equal(p.rgb_u8, want) for p, want in zip(found, pictures_of(3), strict=True))


def cut(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    return path


BROKEN = {
    "missing": (lambda d: d / "no.mp4", "no such file"),
    "empty": (lambda d: (d / "e.mp4").touch() or d / "e.mp4", "an empty file"),
    "text": (lambda d: (d / "t.mp4").write_text("not a video") and d / "t.mp4", "Invalid data"),
    "no images": (lambda d: d, "none"),
    "header only": (lambda d: cut(write_video(d / "h.mp4", pictures_of(20)), 0.05), ""),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_sources_give_one_error_line(tmp_path, kind):
    make, says = BROKEN[kind]
    path = make(tmp_path)
    with pytest.raises(InputError) as error:
        list(open_source(path))
    assert str(path) in str(error.value) and says in str(error.value) and "\n" not in str(error.value)


def test_an_image_of_another_size_is_named(tmp_path):
    for number, size in enumerate((32, 32, 30)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.zeros((24, size, 3), np.uint8))
    with pytest.raises(InputError, match=r"2\.png: expected 32x24 px like the first image, got 30x24"):
        list(open_source(tmp_path))


def test_an_image_of_16_bits_among_those_of_8_is_named(tmp_path):
    for number, kind in enumerate((np.uint8, np.uint8, np.uint16)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((24, 32, 3), 200, kind))
    with pytest.raises(InputError, match=r"2\.png: expected 8 bits a channel like the first image, got 16"):
        list(open_source(tmp_path))


def taken(times, **options):
    selection = FrameSelection(**options)
    stereo_frames = list(selection.pick(SourceFrame(i, t, np.zeros((1, 1, 3), np.uint8)) for i, t in enumerate(times)))
    return [stereo_frame.index for stereo_frame in stereo_frames], selection


def test_an_even_clip_is_used_completely():
    found, selection = taken(np.arange(50) / 30, frames_per_second=30, source_rate=30)
    assert found == list(range(50)) and selection.gaps == selection.uneven_steps == 0


def test_range_and_rate():
    assert taken(np.arange(60) / 30, frames_per_second=10, start=0.5, end=1.5, source_rate=30)[0] == list(
        range(15, 45, 3)
    )


def test_a_rate_that_does_not_divide_uses_the_nearest_frames():
    found, selection = taken(np.arange(300) / 30, frames_per_second=25, source_rate=30)
    wanted = np.arange(len(found)) / 25
    assert np.abs(np.array(found) / 30 - wanted).max() <= 0.5 / 30 + 1e-9 and selection.gaps == 0


def test_variable_rate_is_counted_and_no_image_is_used_twice():
    times = np.r_[np.arange(10) / 25, 0.4 + 0.2 + np.arange(10) / 25]  # five images dropped in the middle
    found, selection = taken(times, frames_per_second=25, source_rate=25)
    assert found == list(range(20))
    assert selection.gaps == 5 and selection.uneven_steps == 1


def test_jitter_within_half_a_step_loses_nothing():
    rng = np.random.default_rng(1)
    times = np.arange(200) / 25 + rng.uniform(-0.4, 0.4, 200) / 25
    times[0] = 0
    found, _ = taken(times, frames_per_second=25, source_rate=25)
    assert found == list(range(200))


def write_series(folder, numbers, name="f{}.png", channels=3):
    """Images whose levels are their positions among `numbers`."""
    folder.mkdir()
    for level, number in enumerate(numbers):
        pixels = np.full((24, 32, channels), level, np.uint8)
        if channels == 4:
            pixels[..., 3] = np.where(np.arange(32) < 8, 0, 255)
        cv2.imwrite(str(folder / (name[number % 2] if isinstance(name, tuple) else name).format(number)), pixels)
    return folder


def test_names_that_differ_by_capitals_are_one_series(tmp_path):
    source = open_source(write_series(tmp_path / "a", range(12), ("IMG_{:04d}.PNG", "img_{:04d}.png")))
    assert [int(image.rgb_u8[0, 0, 0]) for image in source] == list(range(12)) and source.notes == []
    (tmp_path / "a/IMG_0004.png").write_bytes((tmp_path / "a/IMG_0004.PNG").read_bytes())
    assert len(list((tmp_path / "a").iterdir())) == 13
    with pytest.raises(InputError, match="one series of images, one file per frame"):
        open_source(tmp_path / "a")


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ([0, 1, 2, 5, 6, 9], "4 numbers are missing, between f2.png and f5.png, and in 1 more places"),
        ([10, 15, 20, 30, 35], "1 numbers are missing, between f20.png and f30.png"),
        ([0, 33, 67, 100, 133, 200], "1 numbers are missing, between f133.png and f200.png"),
        ([0, 33, 67, 100, 133, 167], ""),
        ([3, 8, 13, 18], ""),
        ([7, 6, 5], ""),
    ],
)
def test_numbers_that_a_series_leaves_out_are_said(tmp_path, numbers, said):
    source = open_source(write_series(tmp_path / "a", numbers))
    assert source.notes == ([f"a: {said}; the files count as evenly spaced in time"] if said else [])


def test_transparent_parts_are_said(tmp_path):
    source = open_source(write_series(tmp_path / "a", range(5), channels=4))
    assert [image.rgb_u8.shape for image in source] == [(24, 32, 3)] * 5
    said = "5 images have transparent parts; their color is used there, whatever it is"
    fix = f"To leave it out: `--masks {tmp_path / 'a'} --mask-tool-value low`"
    assert source.notes == [f"a: {said}. {fix}"]
    for path in (tmp_path / "a").iterdir():
        cv2.imwrite(str(path), np.full((24, 32, 4), 255, np.uint8))
    source = open_source(tmp_path / "a")
    list(source)
    assert source.notes == []
