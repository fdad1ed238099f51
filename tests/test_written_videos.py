"""Videos that we write: colors are stored as browsers and players read them, and the table comes first."""

from __future__ import annotations

import av
import numpy as np
import pytest

from endoprior.visualization.video import write_video

RED, BLUE = {"601": 0.299, "709": 0.2126}, {"601": 0.114, "709": 0.0722}
"""Share of red and of blue in the luma of BT.601 and BT.709."""
TAGS = {"601": 6, "709": 1}
"""ISO numbers of SMPTE 170M, which has the matrix of BT.601, and of BT.709."""


def stored(color, kind):
    """Y, Cb, Cr of 8 bits and limited range for red, green, blue of 0..255."""
    red, green, blue = np.array(color) / 255
    luma = RED[kind] * red + (1 - RED[kind] - BLUE[kind]) * green + BLUE[kind] * blue
    cb, cr = (blue - luma) / (2 - 2 * BLUE[kind]), (red - luma) / (2 - 2 * RED[kind])
    return 16 + 219 * luma, 128 + 224 * cb, 128 + 224 * cr


@pytest.mark.parametrize(("height", "kind"), [(64, "601"), (716, "601"), (720, "709")])
def test_colors_are_stored_as_players_read_them(tmp_path, height, kind):
    color = (200, 60, 50)
    path = tmp_path / "v.mp4"
    write_video(path, (np.full((height, 64, 3), color, np.uint8) for _ in range(3)), 25)
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    planes = frames[1].to_ndarray(format="yuv420p")
    y, cb, cr = planes[:height], *np.split(planes[height:], 2)
    assert [plane.mean() for plane in (y, cb, cr)] == pytest.approx(stored(color, kind), abs=1.5)
    told = frames[0].colorspace, frames[0].color_primaries, frames[0].color_trc
    assert [int(each) for each in told] == [TAGS[kind]] * 3 and int(frames[0].color_range) == 1 and len(frames) == 3


def test_the_table_stands_before_the_images(tmp_path):
    write_video(tmp_path / "v.mp4", (np.zeros((32, 32, 3), np.uint8) for _ in range(3)), 25)
    content = (tmp_path / "v.mp4").read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")
