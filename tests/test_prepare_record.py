"""`prepare.json`: what it holds, from frame to source, and damaged files. Ranges of frames as text."""

import json
from contextlib import suppress
from pathlib import Path

import pytest

from endoprior.check.remake import find_remakes
from endoprior.core.checks import InputError, read_ranges
from endoprior.core.config import DataConfig
from endoprior.core.shell import changed_options, command_of
from endoprior.data import load_sequence
from endoprior.data.prepare_record import PrepareRecord, read_record
from endoprior.prepare import PrepareConfig

PLAIN = PrepareRecord("/v.mp4", {}, (1280, 720), (((0.0, 0.0), (1280.0, 0.0)), ((0.0, 720.0), (1280.0, 720.0))))


def test_a_part_of_the_frame_in_pixels_of_the_source():
    assert PLAIN.crop(0, 0, 1, 413 / 480) == (0, 0, 1280, 619)  # 640x480 px shown of 1280x720
    grid = (((100.0, 50.0), (900.0, 50.0)), ((100.0, 650.0), (900.0, 650.0)))  # an earlier crop
    assert PrepareRecord("/v.mp4", {}, (1280, 720), grid).crop(0.25, 0, 1, 0.5) == (300, 50, 600, 300)
    bent = (((0.0, 5.0), (50.0, 0.0), (100.0, 5.0)), ((0.0, 95.0), (50.0, 100.0), (100.0, 95.0)))
    assert PrepareRecord("/v.mp4", {}, (100, 90), bent).crop(0, 0, 1, 1) == (0, 5, 100, 85), "cut at its edges"


def test_a_record_comes_back(tmp_path):
    record = PrepareRecord(
        "/a b/v.mp4", {"--crop": ("1,2,3,4",), "--swap-eyes": ()}, PLAIN.source_size, PLAIN.source_px
    )
    record.save(tmp_path)
    assert read_record(tmp_path) == record
    assert read_record(tmp_path / "nowhere") is None


@pytest.mark.parametrize(
    ("name", "is_text"),
    [
        ("Screen Recording 9.41\u202fAM.mp4", True),
        ("手術\u30001.mp4", True),
        ("a\xa0b.mp4", True),
        ("caf\udce9.mp4", False),
    ],
)
def test_names_of_videos_are_read_as_they_are(tiny_sequence, tmp_path, name, is_text):
    video = tmp_path / name
    with suppress(OSError):  # macOS has no names that are no text
        video.touch()
    record = PrepareRecord(str(video), {}, PLAIN.source_size, PLAIN.source_px)
    record.save(tiny_sequence)
    assert read_record(tiny_sequence) == record
    remakes = find_remakes(load_sequence(tiny_sequence), {}, DataConfig())
    assert bool(remakes.from_video) == is_text
    assert remakes.best.command({}).encode("utf-8")  # can be printed


@pytest.mark.parametrize(
    "change",
    [
        {"video": 3},
        {"video": "a\nb"},
        {"video": "a\u2028b"},
        {"options": {"crop": ["1"]}},
        {"options": {"--crop": "1"}},
        {"options": {"--crop": ["\x1b[2J"]}},
        {"source_px": [[[0, 0]]]},
        {"source_px": [[[0, 0], [1, 0]], [[0, 1]]]},
        {"source_px": [[[0, 0], [1, 0]], [[0, 1], [1, 1, 1]]]},
        {"source_size": [0, 5]},
        {"more": 1},
    ],
)
def test_a_damaged_record_is_named(tmp_path, change):
    PLAIN.save(tmp_path)
    file = tmp_path / "prepare.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(InputError) as caught:
        read_record(tmp_path)
    assert str(caught.value).startswith(f"{file}: ")


def test_options_as_they_are_typed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cfg = PrepareConfig(calibration=Path("c.yaml"), swap_eyes=True, blank=("1,2,3,4", "5,6,7,8"), end=2.5)
    options = changed_options(cfg)
    assert options == {
        "--calibration": (f"{tmp_path}/c.yaml",),
        "--swap-eyes": (),
        "--end": ("2.5",),
        "--blank": ("1,2,3,4", "5,6,7,8"),
    }
    assert command_of("x", (Path("a b"),), options).startswith(
        f"endoprior x 'a b' --calibration {tmp_path}/c.yaml --swap"
    )
    assert changed_options(DataConfig(stride=2, lift_missing_depth=True), "data.") == {
        "--data.lift-missing-depth": (),
        "--data.stride": ("2",),
    }


def test_ranges_of_frames():
    assert read_ranges("frames", " 3-5, 9") == {3, 4, 5, 9}
    assert read_ranges("frames", "") == set()
    for text in ("a", "3-", "-3", "1,,2", "3-4-5", "0-9999999", "²"):
        with pytest.raises(ValueError, match="skip_frames must"):
            DataConfig(skip_frames=text)


def test_skipped_frames_are_counted_after_striding(tiny_sequence):
    frames = [frame.rgb_u8.tobytes() for frame in load_sequence(tiny_sequence).frames("video")]
    sequence = load_sequence(tiny_sequence, DataConfig(stride=2, first_frames=6, skip_frames="1,3-4,99"))
    assert [frames.index(frame.rgb_u8.tobytes()) for frame in sequence.frames("video")] == [0, 4, 10]
    assert sequence.fingerprint() != load_sequence(tiny_sequence).fingerprint()
    with pytest.raises(InputError, match=r"shorten data\.skip_frames"):
        load_sequence(tiny_sequence, DataConfig(skip_frames="1-16"))
    with pytest.raises(InputError, match=r"data\.skip_frames: expected frames that leave some of 0 to 16, got 0-99\."):
        load_sequence(tiny_sequence, DataConfig(skip_frames="0-99"))
