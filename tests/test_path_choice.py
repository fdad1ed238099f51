"""Which program finds the camera path, and what it takes: values of --poses, and the time of COLMAP."""

from dataclasses import replace

import numpy as np
import pytest
from relief import HEIGHT, WIDTH, lens, path, view

from endoprior.prepare.camera_path import choose, colmap
from endoprior.prepare.camera_path.own import own_path
from endoprior.prepare.camera_path.sequence_path import sequence_path


def test_colmap_takes_time_where_it_takes_part(monkeypatch):
    monkeypatch.setattr(choose, "SECONDS_AN_IMAGE", 1.0)
    monkeypatch.setattr(choose, "is_installed", lambda: True)
    seconds = {(how, n): choose.colmap_seconds(how, n) for how in ("best", "own", "colmap") for n in (60, 300, 2000)}
    assert seconds == {
        ("best", 60): 60, ("best", 300): 150, ("best", 2000): 0, ("own", 60): 0, ("own", 300): 0, ("own", 2000): 0,
        ("colmap", 60): 60, ("colmap", 300): 150, ("colmap", 2000): 500,
    }  # fmt: skip
    monkeypatch.setattr(choose, "is_installed", lambda: False)
    assert choose.colmap_seconds("best", 60) == 0


def test_a_mapping_that_was_stopped_is_told_whichever_path_is_taken(monkeypatch):
    assert not colmap.time_note(59.9, 60.0) and "stopped after 60 s" in colmap.time_note(60.2, 60.0)[0]
    frames = [view(pose) for pose in path(10, 2.0)]
    args = frames.__getitem__, len(frames), lens(), (WIDTH, HEIGHT)
    monkeypatch.setattr(choose, "is_installed", lambda: True)
    own, _ = own_path(*args)
    at_rest = np.tile(np.eye(4), (len(frames), 1, 1))
    for poses, how, taken in ((at_rest, "best", own.method), (own.camera_to_world, "colmap", "COLMAP")):
        stopped = replace(own, method="COLMAP", camera_to_world=poses, notes=colmap.time_note(60.0, 60.0))
        monkeypatch.setattr(choose, "colmap_path", lambda *args, found=stopped, **options: found)
        found = choose.find_path(*args, how)
        assert found.method == taken and sum("stopped after 60 s" in note for note in found.notes) == 1


@pytest.mark.parametrize("moves", [True, False])
def test_auto_own_decides_as_auto_and_leaves_colmap_out(moves, monkeypatch):
    monkeypatch.setattr(choose, "is_installed", lambda: True)
    monkeypatch.setattr(choose, "colmap_path", lambda *args, **options: pytest.fail("COLMAP was asked"))
    frames = [view(pose) for pose in path(10, 2.0)] if moves else [view(path(1)[0])] * 10
    found, notes = sequence_path(
        "auto-own", frames.__getitem__, lambda: ([f.rgb_u8 for f in frames], [f.tissue_mask for f in frames]),
        len(frames), lens(), (WIDTH, HEIGHT), has_depth=True, refine_focal=False,
    )  # fmt: skip
    assert (found is not None) == moves and ("the camera moves" in notes[0]) == moves
    assert not moves or found.method == "our own tracks"
