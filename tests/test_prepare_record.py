"""`prepare.json`: what it holds, from frame to source, and damaged files. Ranges of frames as text."""

import json
from pathlib import Path

import pytest

from endoprior.core.checks import InputError, read_ranges
from endoprior.core.config import DataConfig
from endoprior.core.shell import changed_options, command_of
from endoprior.data import load_sequence
from endoprior.data.description import PrepareRecord, read_record
from endoprior.prepare import PrepareConfig

PLAIN = PrepareRecord("/v.mp4", {}, (1280, 720), (((0.0, 0.0), (1280.0, 0.0)), ((0.0, 720.0), (1280.0, 720.0))))


def test_a_record_comes_back(tmp_path):
    record = PrepareRecord(
        "/手術 b/caf\udce9.mp4", {"--crop": ("1,2,3,4",), "--swap-eyes": ()}, PLAIN.source_size, PLAIN.source_px
    )
    record.save(tmp_path)
    assert read_record(tmp_path) == record
    assert read_record(tmp_path / "nowhere") is None


@pytest.mark.parametrize(
    "change",
    [
        {"video": 3},
        {"options": {"--crop": "1"}},
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
