"""A video that fits into memory is decoded once, and steps hand on what they computed; the results are the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from video_files import write_video

from endoprior.prepare import PrepareConfig, prepare
from endoprior.prepare.video import Video
from endoprior.system import parallel

CFG = PrepareConfig(layout="mono", border="keep", masks="none", poses="still")


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = np.random.default_rng(0).integers(60, 200, (96, 160, 3), np.uint8)
    images = [np.roll(np.repeat(np.repeat(base[::4, ::4], 4, 0), 4, 1), k, 1) for k in range(12)]
    return write_video(tmp_path_factory.mktemp("video") / "clip.mp4", images)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The positions of all images that are decoded."""
    positions, usual = list[int](), Video.__iter__

    def counted(self: Video):
        for image in usual(self):
            positions.append(image.index)
            yield image

    monkeypatch.setattr(Video, "__iter__", counted)
    return positions


def files(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def test_a_clip_that_fits_into_memory_is_decoded_once(video, tmp_path, decoded, monkeypatch):
    monkeypatch.setenv("ENDOPRIOR_CACHE_GB", "1")
    once = prepare(video, tmp_path / "once", CFG).out
    assert decoded.count(5) == 1
    monkeypatch.setenv("ENDOPRIOR_CACHE_GB", "0")
    twice = prepare(video, tmp_path / "twice", CFG).out
    assert decoded.count(5) == 3
    assert files(once) == files(twice) and len(files(once)) > 3 * 12


def test_a_sequence_does_not_depend_on_the_number_of_threads(video, tmp_path, monkeypatch):
    found = []
    for num in (1, 4):
        monkeypatch.setattr(parallel, "workers", lambda _bytes_each, num=num: num)
        found.append(files(prepare(video, tmp_path / str(num), CFG).out))
    assert found[0] == found[1]
