"""Correcting tool masks in the viewer: the brush, undo, carrying, saving, and the same over the viewer's protocol."""

from __future__ import annotations

import json
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from view_client import Client, at_work, wait_until

from endoprior.cli.view import open_viewable
from endoprior.core.checks import InputError
from endoprior.data import edit, load_sequence
from endoprior.tool_masks.clicked_tools import SearchStep, ToolClick, check_clicks
from endoprior.view import layers
from endoprior.view.incoming import JobQueue
from endoprior.view.mask_editor import MaskEditor, MaskEdits, stroke
from endoprior.view.server import Viewer
from endoprior.view.viewable import ViewSettings
from endoprior.view.viewable_sequence import ViewableSequence

SHAPE = (48, 64)


@pytest.fixture
def edits(tiny_sequence):
    """Corrections of the tiny sequence."""
    return MaskEdits(load_sequence(tiny_sequence))


def tool(folder, name: str) -> np.ndarray:
    """What a mask file holds."""
    pixels = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(pixels)) <= {0, 255}
    return pixels == 255


@pytest.mark.parametrize("points", [[(20.5, 30.5)], [(10.0, 12.0), (50.0, 30.0)], [(5, 5), (40, 9), (30, 44)]])
@pytest.mark.parametrize("radius", [1, 4, 9.0])
def test_a_stroke_equals_a_slow_loop(points, radius):
    drawn = stroke(np.zeros(SHAPE, bool), points, radius, True)
    ends = np.array(points, float)
    for row in range(SHAPE[0]):
        for column in range(SHAPE[1]):
            here, distance = np.array([column + 0.5, row + 0.5]), np.inf
            for a, b in zip(ends, [*ends[1:], ends[-1]], strict=True):
                along = np.clip((here - a) @ (b - a) / max((b - a) @ (b - a), 1e-9), 0, 1)
                distance = min(distance, float(np.hypot(*(a + along * (b - a) - here))))
            if abs(distance - radius) > 1:  # OpenCV rounds outlines
                assert drawn[row, column] == (distance < radius), (row, column, distance)
    erased = stroke(np.ones(SHAPE, bool), points, radius, False)
    assert np.array_equal(erased, ~drawn)


def test_a_stroke_changes_a_copy_and_may_leave_the_image():
    mask = np.zeros(SHAPE, bool)
    assert stroke(mask, [(-1e9, 20), (30, 20)], 3, True)[20, :30].all() and not mask.any()
    assert not stroke(mask, [(1e9, 1e9)], 3, True).any()


def test_undo_goes_back_by_one_stroke_or_one_carrying(edits):
    first = edits.tool(2)
    edits.begin()
    edits.draw(2, [(10, 10)], 4, True)
    edits.draw(2, [(10, 10), (20, 10)], 4, True)
    painted = edits.tool(2)
    assert painted[10, 20] and edits.unsaved == [2]
    changed = edits.carry(2).masks
    assert 1 in changed and 3 in changed and edits.unsaved == sorted([2, *changed])
    assert edits.undo() and edits.unsaved == [2] and np.array_equal(edits.tool(2), painted)
    assert edits.undo() and edits.unsaved == [] and np.array_equal(edits.tool(2), first)
    assert not edits.undo()


def test_carrying_takes_only_what_was_corrected_since_the_last_time(edits):
    edits.begin()
    edits.draw(2, [(12, 12)], 5, True)
    edits.carry(2)
    assert edits.tool(3)[12, 12]
    edits.begin()
    edits.draw(3, [(12, 12)], 8, False)
    before = edits.tool(2)
    assert not edits.carry(2).masks and np.array_equal(edits.tool(2), before)  # nothing new in frame 2
    edits.carry(3)
    assert not edits.tool(2)[12, 12] and not edits.tool(4)[12, 12]


@pytest.mark.parametrize("tool_value", [255, 0])
def test_saving_keeps_the_first_original_and_notes_what_changed(tiny_sequence, tool_value):
    if tool_value == 0:
        file = tiny_sequence / "sequence.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | {"mask_tool_value": 0}))
        for mask in (tiny_sequence / "masks").iterdir():
            cv2.imwrite(str(mask), 255 - cv2.imread(str(mask), cv2.IMREAD_UNCHANGED))
    edits = MaskEdits(load_sequence(tiny_sequence))
    kept, name = tiny_sequence / "masks_before", "000002.png"
    original = (tiny_sequence / "masks" / name).read_bytes()
    assert edits.save() == [] and not kept.exists()
    for point in ((10, 10), (10, 14)):
        edits.begin()
        edits.draw(2, [point], 3, True)
        assert edits.save() == [2] and edits.unsaved == []
    assert (kept / name).read_bytes() == original
    assert sorted(file.name for file in kept.iterdir()) == [name, "changes.json"]
    assert not list((tiny_sequence / "masks").glob(".*"))
    again = load_sequence(tiny_sequence)
    assert np.array_equal(~again.frame(2).tissue_mask, edits.tool(2)) and edits.tool(2)[14, 10]
    noted = json.loads((kept / "changes.json").read_text())[name]
    assert noted["added_px"] > 40 and noted["removed_px"] == 0
    edits.undo()  # after saving, the file is the newer one
    assert edits.unsaved == [2] and edits.save() == [2]
    assert not edits.tool(2)[16, 10] and tool(tiny_sequence / "masks", name)[16, 10] == (tool_value == 0)


def test_a_read_only_folder_is_one_clear_line(edits, monkeypatch, tiny_sequence):
    edits.begin()
    edits.draw(0, [(10, 10)], 3, True)
    monkeypatch.setattr(edit.os, "access", lambda path, mode: False)
    with pytest.raises(InputError, match=r"read-only one\. Fix: Copy the data folder") as error:
        edits.save()
    assert "\n" not in str(error.value) and not (tiny_sequence / "masks_before").exists()
    assert edits.unsaved == [0]


def test_the_overlay_shows_the_corrected_mask_and_points_leave_it_out(tiny_sequence):
    viewable = ViewableSequence(load_sequence(tiny_sequence))
    settings, camera = ViewSettings(frame=2, layer="frame", correcting=True), viewable.cameras[2]
    before, original = viewable.picture(settings, camera), viewable.sequence.frame(2).rgb_u8
    mask = viewable.mask_edits.tool(2)
    assert (before[mask] != original[mask]).any(-1).all() and np.array_equal(before[~mask], original[~mask])
    points = len(viewable.cloud(ViewSettings(frame=2, layer="frame")).points)
    viewable.mask_edits.begin()
    viewable.mask_edits.draw(2, [(15, 25)], 5, True)
    now = viewable.picture(settings, camera)
    assert (now[25, 15] != before[25, 15]).any() and np.array_equal(now[5, 40], before[5, 40])
    assert len(viewable.cloud(ViewSettings(frame=2, layer="frame")).points) < points
    assert np.array_equal(layers.with_mask(original, mask & False), original)


def test_only_folders_with_mask_files_can_be_corrected(tiny_sequence):
    for file in (tiny_sequence / "masks").iterdir():
        file.unlink()
    (tiny_sequence / "masks").rmdir()
    (tiny_sequence / "poses_bounds.npy").unlink()
    viewable = ViewableSequence(load_sequence(tiny_sequence))
    assert viewable.mask_edits is None
    Viewer(viewable).close()


def found_in(monkeypatch, frames: dict[int, tuple[slice, slice]], clicks: list) -> None:
    """Replace the search by one that finds a box in these frames."""

    def steps(sequence, click, tool, finder=None):
        check_clicks(sequence, click, tool)
        clicks.extend(click)
        return one_by_one(sequence, tool)

    def one_by_one(sequence, tool):
        total = len(sequence)
        for i in range(total):
            added = np.zeros(tool(i).shape, bool)
            if i in frames:
                added[frames[i]] = True
            yield SearchStep(i + 1, total, i, added)

    monkeypatch.setattr("endoprior.view.mask_editor.find_clicked", steps)


def test_a_search_is_one_edit_that_can_be_undone_and_saved(edits, monkeypatch, tiny_sequence):
    found_in(monkeypatch, {1: np.s_[5:9, 5:9], 3: np.s_[5:9, 30:35]}, [])
    before = [edits.tool(i) for i in range(4)]
    steps = list(edits.find(ToolClick(1, 6, 6)))
    assert edits.unsaved == []  # searching changes nothing
    edits.change({step.frame: step.region for step in steps if step.region.any()}, True)
    assert edits.unsaved == [1, 3] and edits.tool(3)[6, 32] and (edits.tool(1) >= before[1]).all()
    assert edits.undo() and edits.unsaved == [] and not edits.undo()
    edits.change({3: steps[3].region}, True)
    assert edits.save() == [3] and tool(tiny_sequence / "masks", "000003.png")[6, 32]


def test_a_click_finds_a_tool_in_all_frames_over_the_protocol(tiny_sequence, capfd, monkeypatch):
    viewable, _ = open_viewable(tiny_sequence, None)
    clicks: list = []
    found_in(monkeypatch, {0: np.s_[5:9, 5:9], 2: np.s_[5:9, 30:35]}, clicks)
    with at_work(Viewer(viewable)) as viewer:
        panel, edits = viewer.panel, viewable.mask_edits
        client = Client(viewer.url)
        client.send_camera()
        client.set(panel.correct, True)
        client.set(panel.find, True)
        client.image()
        before = edits.tool(0)
        client.click(0.3, 0.3)
        wait_until(lambda: "Found in frames 0, 2." in panel.corrected.content)
        height, width = before.shape
        assert (clicks[0].frame, clicks[0].x) == (0, pytest.approx(0.3 * width, abs=2)) and clicks[0].y < 0.4 * height
        assert edits.unsaved == [0, 2] and edits.tool(2)[6, 32] and "Not saved" in panel.corrected.content
        client.set(panel.undo, True)
        wait_until(lambda: not edits.unsaved)
        client.set(panel.find, False)
        client.click(0.3, 0.3)  # paints again
        wait_until(lambda: edits.unsaved == [0])
        client.set(panel.find, True)
        client.click(0.3, 0.3)
        wait_until(lambda: "a masked pixel" in capfd.readouterr().err)
        assert client.connected and edits.unsaved == [0]
        client.socket.close()


def test_between_two_frames_of_a_search_other_jobs_run_and_undo_stops_it(edits, monkeypatch):
    found_in(monkeypatch, {0: np.s_[5:9, 5:9]}, [])
    jobs, controls, turns = JobQueue(), SimpleNamespace(corrected=SimpleNamespace(content="")), []
    editor = MaskEditor(edits, controls, None, jobs, lambda client, screen: None, lambda: None)

    def work() -> None:
        """One turn of the viewer: it draws after it."""
        for job in jobs.take(0):
            job()
            turns.append(controls.corrected.content)

    editor.find(0, (3.0, 3.0))
    jobs.put(lambda: None)  # a browser asks for something
    assert "1 of" in controls.corrected.content
    work()
    assert len(turns) == 2 and "2 of" in turns[-1]  # one frame of the search, and what the browser asked for
    editor.undo()
    for _ in range(3):
        work()
    assert controls.corrected.content == "Stopped." and edits.unsaved == []
    editor.find(0, (3.0, 3.0))
    editor.find(0, (3.0, 3.0))  # takes the place of the first
    while "Found in frame 0." not in controls.corrected.content:
        work()
    work()
    assert edits.unsaved == [0] and not jobs.take(0)
    assert edits.undo() and not edits.undo()


def test_a_click_that_erases_frees_tissue_in_all_frames(edits):
    jobs, controls = JobQueue(), SimpleNamespace(corrected=SimpleNamespace(content=""))
    editor = MaskEditor(edits, controls, None, jobs, lambda client, screen: None, lambda: None)
    y, x = np.argwhere(edits.tool(0))[0]
    before = [edits.tool(i) for i in range(4)]
    editor.find(0, (float(x), float(y)), paint=False)
    while "Freed in" not in controls.corrected.content:
        for job in jobs.take(0):
            job()
    assert not edits.tool(0)[y, x] and 0 in edits.unsaved
    assert all((edits.tool(i) <= before[i]).all() for i in range(4))
    with pytest.raises(InputError, match="tissue that is masked"):
        editor.find(0, (float(x), float(y)), paint=False)


def test_an_error_ends_a_search(edits, monkeypatch):
    jobs, controls = JobQueue(), SimpleNamespace(corrected=SimpleNamespace(content=""))
    editor = MaskEditor(edits, controls, None, jobs, lambda client, screen: None, lambda: None)

    def broken(*args):
        yield SearchStep(1, 9)
        raise OSError("no such frame")

    monkeypatch.setattr("endoprior.view.mask_editor.find_clicked", broken)
    editor.find(0, (3.0, 3.0))
    with pytest.raises(OSError, match="no such frame"):
        [job() for job in jobs.take(0)]
    assert controls.corrected.content == "" and not jobs.take(0)
    editor.undo()
    assert controls.corrected.content == "Nothing to undo."


def test_painting_carrying_undoing_and_saving_over_the_protocol(tiny_sequence, capfd):
    viewable, _ = open_viewable(tiny_sequence, None)
    with at_work(Viewer(viewable)) as viewer:
        panel, edits = viewer.panel, viewable.mask_edits
        client = Client(viewer.url)
        client.send_camera()
        plain = client.image()
        client.drag([(0.3, 0.3), (0.5, 0.3)])  # the pointer belongs to the camera
        client.set(panel.correct, True)
        assert np.abs(client.image().astype(int) - plain).max() > 20
        assert not edits.unsaved
        before = edits.tool(0)
        client.set(panel.radius, 3)
        client.drag([(0.3, 0.3), (0.4, 0.3), (0.5, 0.3)])
        wait_until(lambda: edits.unsaved == [0])
        top = viewer.viewable.cameras[0].height
        client.image()
        added = np.argwhere(edits.tool(0) & ~before)
        width = viewer.viewable.cameras[0].width
        assert np.ptp(added[:, 1]) == pytest.approx(0.2 * width + 6, abs=2) and np.ptp(added[:, 0]) <= 7
        assert added[:, 1].mean() == pytest.approx(0.4 * width, abs=1) and added[:, 0].mean() < 0.4 * top
        client.drag([(0.3, 0.3), (0.5, 0.3)], modifier="shift")
        wait_until(lambda: not (edits.tool(0) & ~before).any())
        client.set(panel.undo, True)
        wait_until(lambda: (edits.tool(0) & ~before).any())
        client.click(0.2, 0.7)
        wait_until(lambda: (edits.tool(0) & ~before).sum() > len(added))
        client.set(panel.carry, True)
        wait_until(lambda: "Forward until" in panel.corrected.content)
        assert 1 in edits.unsaved and "Changed frames: 1" in panel.corrected.content
        client.set(panel.save_masks, True)
        wait_until(lambda: "Saved: frames 0-" in panel.corrected.content)
        assert np.array_equal(tool(tiny_sequence / "masks", "000000.png"), edits.tool(0))
        bad = {"phase": "start", "button": "left", "name": "/points", "owner": "", "instance_index": None}
        places = dict.fromkeys(("start_screen_pos", "end_screen_pos"), (0.5, 0.5))
        ends = dict.fromkeys(("start_position", "end_position"), (0, 0, 1))
        saved = edits.tool(0)
        client.send("SceneNodeDragMessage", modifier=None, **bad, **places, **ends)
        nowhere = dict.fromkeys(places, (float("nan"), 0.5))
        client.send("SceneNodeDragMessage", modifier=None, **bad | {"name": "/brush"}, **nowhere, **ends)
        client.set(panel.radius, -5)
        client.set(panel.correct, False)
        time.sleep(0.4)
        assert client.connected and edits.tool(0) is saved and panel.radius.value == 3
        client.socket.close()
    assert not capfd.readouterr().err
